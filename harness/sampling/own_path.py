"""Tests whose event is drawn from those of their own path: as naturalistic traffic would have them, or forced."""

from __future__ import annotations

import numpy as np

from harness.families.protocol import HOLDING, Paths, Recorded
from harness.families.script import Script
from harness.loop.judge import motion_hashes
from harness.loop.loop import EpisodeLoop, RecordPolicy, Shard
from harness.loop.repeat import Traffic
from harness.random_stream import CUT_IN as EVENT
from harness.random_stream import uniforms
from harness.resolved import Resolved
from harness.sampling.protocol import ShardRequest, Source
from harness.vehicles.drivers import Followers, driver_records
from harness.vocabulary import FAILED

EVENT_DRAW = 1
"""Index within the event's stream."""
NOBODY = Followers(driver_records([]))
AT_ONCE = 1000
"""Baseline runs whose motion is held in memory at once: some 15 MB."""
ALL_MOTION = RecordPolicy("all", 0.0)


class Naturalistic(Source):
    """At most one event, by its probability, from one uniform: each test weighs 1."""

    def tests(self, first_episode: int, n_episodes: int) -> Traffic:
        resolved, paths = self.resolved, self.paths(first_episode, n_episodes)
        family, environment, seed = resolved.family, resolved.environment, self.campaign.seed
        cumulative = np.cumsum(family.events(environment, seed, paths, NOBODY).probability, axis=1)
        u = uniforms(seed, first_episode, n_episodes, EVENT, EVENT_DRAW + 1)[:, EVENT_DRAW]
        event = np.where(u < cumulative[:, -1], (cumulative <= u[:, None]).sum(1), -1)
        chosen = family.choose(environment, seed, paths, event, of_pool=False)
        return Traffic(family.script(environment, chosen), chosen.facts)


class Forced(Source):
    """Every test has an event, drawn given that there is one; its weight is the probability of that on its path.

    A vehicle that acts before the event is driven along the path without one first, which prescribes the test.
    """

    def tests(self, first_episode: int, n_episodes: int) -> Traffic:
        return forced(self.resolved, self.paths(first_episode, n_episodes))

    def run(self, loop: EpisodeLoop, request: ShardRequest) -> Shard:
        first, n = request.first_episode, request.n_episodes
        if not self.campaign.has_baseline_runs:
            return super().run(loop, request)
        return loop.run(first, forced_after_runs(loop, self.resolved, self.paths(first, n)))


def forced_after_runs(loop: EpisodeLoop, resolved: Resolved, paths: Paths) -> Traffic:
    """Tests (n,), each after a baseline run of its own on the same path.

    Where that fails there is no event; the test fails as well, and weighs what it may have hidden.
    """
    parts = []
    for begin in range(0, len(paths.number), AT_ONCE):
        some = Paths(*(column[begin : begin + AT_ONCE] for column in paths))
        parts.append(forced(resolved, some, recorded(without_event(loop, resolved, resolved.campaign.seed, some))))
    script = Script._make(np.concatenate(columns) for columns in zip(*(part.script for part in parts), strict=True))
    return Traffic(script, np.concatenate([part.facts for part in parts]))


def forced(resolved: Resolved, paths: Paths, runs: Recorded = HOLDING) -> Traffic:
    """Tests (n,), where the vehicle keeps its speed until the event, or did so in baseline runs."""
    family, environment, seed, n = resolved.family, resolved.environment, resolved.campaign.seed, len(paths.number)
    events = family.events(environment, seed, paths, NOBODY, runs)
    u = uniforms(seed, int(paths.number[0]), n, EVENT, EVENT_DRAW + 1)[:, EVENT_DRAW]
    cumulative = np.cumsum(events.probability, axis=1)
    total, log_weight = cumulative[:, -1], events.log_any
    event = np.minimum((cumulative <= (u * total)[:, None]).sum(1), (cumulative < total[:, None]).sum(1))
    if runs.failed.size:
        event[runs.failed], log_weight = -1, np.log(total + events.after_failure)
    chosen = family.choose(environment, seed, paths, event, of_pool=False)
    script = family.script(environment, chosen)._replace(log_weight=log_weight, log_p_event=log_weight)
    if runs.failed.size:
        onset = np.maximum(chosen.at - chosen.lead, 0)
        motion = motion_hashes(runs.x_m, runs.v_mps)[np.arange(n), onset]
        script = script._replace(announced_index=paths.number, motion_hash=motion)
    return Traffic(script, chosen.facts)


def without_event(loop: EpisodeLoop, resolved: Resolved, seed: int, paths: Paths, first: int | None = None) -> Shard:
    """Drive the loop's vehicle along paths (n,) on which nothing happens.

    The first is its episode ``first``, or of the path's own number.
    """
    none = np.full(len(paths.number), -1, np.int64)
    chosen = resolved.family.choose(resolved.environment, seed, paths, none)
    traffic = Traffic(resolved.family.script(resolved.environment, chosen), chosen.facts)
    return loop.beside(keep=ALL_MOTION).run(int(paths.number[0]) if first is None else first, traffic)


def recorded(shard: Shard) -> Recorded:
    """Baseline runs as they come from the loop."""
    episode = shard.episode
    x, v = np.zeros((2, episode.size, shard.scenario.max_steps + 1))
    for row, trace in shard.traces.items():
        x[row, : len(trace)], v[row, : len(trace)] = trace[:, -1, 0], trace[:, -1, 1]
    return Recorded(episode["n_steps"].astype(np.int64), episode["outcome"] == FAILED, x, v)
