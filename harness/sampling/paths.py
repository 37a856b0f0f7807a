"""What is driven along given paths: naturalistic and forced tests; before tests, baseline runs and milder events.

A vehicle that acts before the event is driven along each path without one, to know where it is: its baseline run. A
test repeats the path with an event, and tells the vehicle the index of the baseline run, so that both see the same
random stream. What the vehicle does through the step of the event must be the same to the last bit, or the test fails.

Some events are driven that are milder than those that count: they enter no rate, but a vehicle that crashes on them is
not accepted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness import elementary
from harness.campaign.campaign import Campaign
from harness.errors import RunFolderError
from harness.families import family_named
from harness.families.protocol import HOLDING, Paths, Recorded
from harness.families.script import Script
from harness.loop.judge import motion_hashes
from harness.loop.loop import EpisodeLoop, RecordPolicy, Shard
from harness.loop.repeat import Traffic
from harness.pool.vehicle_pool import BaselinePaths
from harness.progress import Progress
from harness.random_stream import EVENT, uniforms
from harness.records.folder import MILDER, SHADOW, Part, read_kept
from harness.records.schemas import baseline_table, episodes_table, padded
from harness.resolved import Resolved
from harness.sampling.protocol import ShardRequest, Source
from harness.vehicles.drivers import Followers, driver_records

SHARD_RUNS = 50
"""Baseline runs of one task: half a second of a slow controller."""
IN_WORDS = {SHADOW: "baseline runs", MILDER: "milder events, in no rate"}
"""What the rows of each table are."""
N_MILDER = 36
"""Tests of milder events: a vehicle that crashes on a tenth of them is found out 98 times in 100."""
EVENT_DRAW = 1
"""Index within the event's stream."""
NOBODY = Followers(driver_records([]))
AT_ONCE = 1000
"""Baseline runs whose motion is held in memory at once: some 15 MB."""
ALL_MOTION = RecordPolicy("all", 0.0)


class Naturalistic(Source):
    """At most one event, by its probability, from one uniform: each test weighs 1."""

    def tests(self, first_episode: int, n_episodes: int) -> Traffic:
        paths = self.paths(first_episode, n_episodes)
        family, environment, seed = self.resolved.family, self.resolved.environment, self.campaign.seed
        cumulative = np.cumsum(family.events(environment, seed, paths, NOBODY).probability, axis=1)
        u = uniforms(seed, first_episode, n_episodes, EVENT, EVENT_DRAW + 1)[:, EVENT_DRAW]
        event = np.where(u < cumulative[:, -1], (cumulative <= u[:, None]).sum(1), -1)
        chosen = family.choose(environment, seed, paths, event, of_pool=False)
        return Traffic(family.script(environment, chosen), chosen.facts)


class Forced(Source):
    """Every test has an event, drawn given that there is one; its weight is the probability of one on its path.

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

    Where that fails there is no event: the test fails as well, and weighs the events that may have come after.
    """
    parts = []
    for begin in range(0, len(paths.number), AT_ONCE):
        chunk = Paths(*(column[begin : begin + AT_ONCE] for column in paths))
        runs = recorded(without_event(loop, resolved, resolved.campaign.seed, chunk))
        parts.append(forced(resolved, chunk, runs))
    script = Script._make(np.concatenate(columns) for columns in zip(*(part.script for part in parts), strict=True))
    return Traffic(script, np.concatenate([part.facts for part in parts]))


def forced(resolved: Resolved, paths: Paths, runs: Recorded = HOLDING) -> Traffic:
    """Tests (n,) with an event on each path, along which the vehicle holds its speed or moves as in its ``runs``."""
    family, environment, seed = resolved.family, resolved.environment, resolved.campaign.seed
    n = len(paths.number)
    events = family.events(environment, seed, paths, NOBODY, runs)
    u = uniforms(seed, int(paths.number[0]), n, EVENT, EVENT_DRAW + 1)[:, EVENT_DRAW]
    cumulative = np.cumsum(events.probability, axis=1)
    total, log_weight = cumulative[:, -1], events.log_any
    event = np.minimum((cumulative <= (u * total)[:, None]).sum(1), (cumulative < total[:, None]).sum(1))
    if runs.failed.size:
        event[runs.failed], log_weight = -1, elementary.log(total + events.after_failure)
    chosen = family.choose(environment, seed, paths, event, of_pool=False)
    script = family.script(environment, chosen)._replace(log_weight=log_weight, log_p_event=log_weight)
    if runs.failed.size:
        onset = np.maximum(chosen.at - chosen.lead, 0)
        motion = motion_hashes(runs.x_m, runs.v_mps)[np.arange(n), onset]
        script = script._replace(announced_index=paths.number, motion_hash=motion)
    return Traffic(script, chosen.facts)


def without_event(loop: EpisodeLoop, resolved: Resolved, seed: int, paths: Paths, first: int | None = None) -> Shard:
    """Drive the loop's vehicle along paths (n,) without an event.

    The first run is episode ``first``, by default the number of its path.
    """
    no_event = np.full(len(paths.number), -1, np.int64)
    chosen = resolved.family.choose(resolved.environment, seed, paths, no_event)
    traffic = Traffic(resolved.family.script(resolved.environment, chosen), chosen.facts)
    return loop.beside(keep=ALL_MOTION).run(int(paths.number[0]) if first is None else first, traffic)


def recorded(shard: Shard) -> Recorded:
    """Arrays of baseline runs that the loop has just driven."""
    row = np.arange(shard.episode.size)
    return as_recorded(baseline_table(shard, row, np.ones(row.size)), shard.scenario.max_steps)


@dataclass(frozen=True)
class BaselineResult:
    """The table of a finished range of baseline runs, or of tests of milder events."""

    request: ShardRequest
    table: pa.Table


def requests_before(name: str, n: int) -> Iterator[ShardRequest]:
    """Requests for ``n`` baseline runs, or tests of milder events, in order; ``name`` is that of their table."""
    firsts = enumerate(range(0, n, SHARD_RUNS))
    return (ShardRequest(index, first, min(SHARD_RUNS, n - first), before=name) for index, first in firsts)


def run_baseline(loop: EpisodeLoop, paths: BaselinePaths, resolved: Resolved, request: ShardRequest) -> BaselineResult:
    """Drive the loop's vehicle along a range of paths."""
    driven = Paths(paths.index[request.rows], paths.start[request.rows])
    shard = without_event(loop, resolved, paths.seed, driven, request.first_episode)
    return BaselineResult(request, baseline_table(shard, driven.number, paths.weight[request.rows]))


def stored_table(folder: Path, before: Mapping[str, Part], name: str) -> pa.Table | None:
    """A table that the manifest lists as ``before`` the tests; None where it lists none, or the file is gone."""
    exists = name in before and (folder / before[name].files[name].path).exists()
    return read_kept(folder, before[name], name) if exists else None


def stored_baseline(
    stored: pa.Table | None, paths: BaselinePaths | None, request: ShardRequest
) -> BaselineResult | None:
    """The requested range of a ``stored`` table, None where it is shorter; a `RunFolderError` if of other paths."""
    if stored is None or stored.num_rows < request.rows.stop:
        return None
    table = stored.slice(request.first_episode, request.n_episodes)
    if paths is None or request.before == MILDER:  # milder events follow from the campaign alone
        return BaselineResult(request, table)
    if not np.array_equal(table.column("path").to_numpy(), paths.index[request.rows]):
        expected = "those of this campaign and this version of the harness"
        mend = "Use a new folder, or the version that the run was begun with (manifest.json)."
        raise RunFolderError(request.before, "runs on other paths", expected, mend)
    return BaselineResult(request, table)


def begin(source: Source, drive: Callable[[str, int], pa.Table]) -> tuple[pa.Table, Recorded]:
    """Let a campaign's tests follow from the baseline runs that ``drive`` makes or reads: their table, and arrays."""
    table = drive(SHADOW, len(source.baseline_paths or ()))
    runs = as_recorded(table, source.scenario.max_steps)
    source.begin_after(runs)
    return table, runs


def read_stored(folder: Path, paths: BaselinePaths, before: Mapping[str, Part], name: str, n: int) -> pa.Table:
    """All ``n`` rows of a run folder's table; a `RunFolderError` if some are missing or damaged."""
    stored = stored_table(folder, before, name)
    if stored is None or any(stored_baseline(stored, paths, request) is None for request in requests_before(name, n)):
        found = f"{0 if stored is None else stored.num_rows} {IN_WORDS[name]}"
        expected = f"all {n}: they say what is tested, and how probable it is"
        raise RunFolderError(str(folder / name), found, expected, "Let `harness run` go on with --resume.")
    return stored


def as_recorded(table: pa.Table, max_steps: int) -> Recorded:
    """A table of baseline runs as arrays, shape (n,) or (n, max_steps + 1)."""
    n_steps = table.column("n_steps").to_numpy().astype(np.int64)
    failed = np.asarray(pc.equal(table.column("outcome").cast(pa.string()), "failed"))
    motion = (padded(table.column(name), max_steps + 1)[0] for name in ("av_position_m", "av_speed_mps"))
    return Recorded(n_steps, failed, *motion)


def run_milder(loop: EpisodeLoop, resolved: Resolved, request: ShardRequest) -> BaselineResult:
    """Drive the loop's vehicle in a range of the milder events, of which there are `N_MILDER`."""
    milder = replace(resolved, environment=resolved.family.milder(resolved.environment))
    tests = Forced(milder, Progress()).tests(0, N_MILDER)
    shard = loop.beside(keep=ALL_MOTION).run(request.first_episode, tests.rows(request.rows))
    return BaselineResult(request, episodes_table(shard, resolved.campaign.seed))


def milder_of(resolved: Resolved, table: pa.Table) -> dict[str, Any]:
    """Numbers of tests of milder events, their crashes and failures, and how often such events are met per hour."""
    family, crashes = resolved.family, pc.equal(table.column("outcome").cast(pa.string()), "crash")
    if above := resolved.campaign.crash.counts_above_mps:
        crashes = pc.and_(crashes, pc.fill_null(pc.greater(table.column("impact_speed_mps"), above), fill_value=False))
    exposure = family.exposure(family.milder(resolved.environment), resolved.parameters)
    counts = {"n_tests": len(table), "n_crashes": pc.sum(crashes).as_py()}
    return {**counts, "n_failed": len(table) - table.column("failure").null_count, "per_hour": exposure.per_hour}


def n_left_out(campaign: Campaign, n_before_event: int) -> int:
    """Crashes before the event, of whose like a rate leaves most out: the AV follows, and is tested around events."""
    follows = family_named(campaign.scenario).follows
    return n_before_event if follows and campaign.testing.method != "nde" else 0


def beyond_scope(milder: Mapping[str, Any] | None) -> int:
    """Milder tests that speak against a vehicle: crashes, and failures, which may have hidden one."""
    return 0 if milder is None else milder["n_crashes"] + milder["n_failed"]
