"""Check an AV before a campaign: what it does in a few tests, whether it does the same again, and how fast it is."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.arguments import AtLeastTwo, checked
from harness.campaign.campaign import Campaign
from harness.campaign.files import campaign_of
from harness.campaign.vehicle import AutomatedVehicle
from harness.controllers.find import build_host, has_foreign_code, tried_script
from harness.controllers.hosts import ControllerHost, Failures
from harness.controllers.protocol import BatchObservation
from harness.loop.loop import EpisodeLoop, Shard
from harness.records.reader import by_kind
from harness.report.av_check import AvCheck, Behaviour, Cause, Follows, Speed
from harness.resolved import require_world, resolve
from harness.runner.again import Bits, bits_of, run_elsewhere
from harness.sampling import prepare
from harness.sampling.protocol import Source
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M
from harness.vocabulary import CRASH, FAILED, FloatArray
from harness.worlds import build_world
from harness.worlds.twin import TwinWorld

EPISODES = 48
CELLS, OTHER_CELLS = 16, 5
"""Two layouts in which every episode has other neighbours, and mostly another cell."""
SHORTEST_TIMING_S = 0.3
BRAKING_MPS2 = -0.1
"""Acceleration below which the AV has reacted to the event."""
AT_LIMIT_MPS2 = 1e-9
WARM_UP_EPISODES, LONGER, LONGEST_S = 12, 10.0, 60.0
"""Tests in which the warm-up is left out, or made ten times as long, up to a minute."""


@checked("harness.av_check")
def check_av(campaign: Campaign | str | Path, n_episodes: AtLeastTwo = EPISODES) -> AvCheck:
    """Run a few dozen episodes with a campaign's AV, twice, and report what it does.

    The second run has other cells, begins in the middle, and follows episodes of its own: a controller that remembers
    an earlier episode, shares state between instances or draws from a global stream gives other bits there.

    Parameters
    ----------
    campaign : Campaign, str or Path
        Whose AV; its method, engine and records are replaced by what the check needs, its AV and seed are not.
    n_episodes : int
        At least 2.

    Raises `HarnessError`: the campaign is wrong, or the AV cannot be found, made or started.
    """
    campaign = campaign_of(campaign)
    tested = _as_checked(campaign)
    require_world(tested)
    source = prepare(resolve(tested, "av-check"))
    first, own_speed = _timed_run(source, n_episodes)
    if own_speed.constructions > 1:  # one for each cell
        own_speed = replace(own_speed, constructions=campaign.world.cells)
    again = _run_in_another_order(source, n_episodes)
    idm = tested.model_copy(update={"av": AutomatedVehicle(before_event=tested.av.before_event)})
    of_idm, idm_speed = _timed_run(prepare(resolve(idm, "av-check")), n_episodes)
    bounds = tested.av.limits if isinstance(tested.av.parameters, dict) else tested.av.parameters
    limits = bounds.min_acceleration_mps2, bounds.max_acceleration_mps2
    if script := tried_script(tested.av):  # clipped by its type's, see docs/controllers.md
        a = np.concatenate([[], *(trace[:-1, -1, 2] for trace in first.traces.values())])  # it may change its own type
        low, high = -script.decel_mps2, script.accel_mps2
        limits = float(np.fmin.reduce(a, initial=low)), float(np.fmax.reduce(a, initial=high))
    differing = tuple(i for i in range(n_episodes) if bits_of(first, i) != again[i])
    cause, clock_read_at = _likely_cause(source, differing[0]) if differing else (None, ())
    family = source.resolved.family
    early, acted = tested.av.acts_before_event or family.follows, "braked" if family.follows else "took_over"
    return AvCheck(
        source=tested.av.source, engine=tested.world.engine, method=tested.testing.method,
        shows=source.scenario.shows, n_episodes=n_episodes, failures=dict(by_kind(Counter(first.failures.values()))),
        differing=differing, likely_cause=cause, clock_read_at=clock_read_at, limits_mps2=limits,
        moved_mps2={} if family.follows else _moved_by_warm_up(source, min(n_episodes, WARM_UP_EPISODES)),
        behaviour=_behaviour(first, limits, acted, early=early),
        idm_behaviour=_behaviour(of_idm, limits, acted, early=early),
        speed=own_speed, idm_speed=idm_speed, scenario=family.name,
        follows=_follows(first) if family.follows else None,
        idm_follows=_follows(of_idm) if family.follows else None, script=script and script._asdict(),
    )  # fmt: skip


def _as_checked(campaign: Campaign) -> Campaign:
    """The campaign with cut-ins in (nearly) every episode, all motion kept, and the twin where it can drive the AV."""
    holds = campaign.av.before_event == "hold_speed"
    environment = campaign.environment if holds else campaign.environment.replaced(("cut_in_lead_s",), 0.0)
    testing = campaign.testing.model_copy(update={"method": "forced" if holds else "step_mixture"})
    engine = "sumo" if campaign.av.source in ("sumo", "traci") else "twin"
    world = campaign.world.model_copy(update={"engine": engine, "cells": CELLS})
    records = campaign.records.model_copy(update={"moments": "none", "traces": "all"})
    surrogates = campaign.surrogates or Campaign(name="default").surrogates
    sections = {"environment": environment, "surrogates": surrogates, "testing": testing, "world": world}
    return campaign.model_copy(update={**sections, "records": records})


class FirstAnswers:
    """A host that notes, by test, the first answer of its controllers (m/s²)."""

    def __init__(self, host: ControllerHost) -> None:
        self._host, self.noted = host, dict[int, float]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._host, name)

    def act(self, seen: BatchObservation, *, warms_up: bool = False) -> tuple[FloatArray, Failures]:
        """As `VehicleHost.act`."""
        answer, failures = self._host.act(seen, warms_up=warms_up)
        if not warms_up:
            self.noted = {**dict(zip(seen.episode.tolist(), answer.tolist(), strict=True)), **self.noted}
        return answer, failures


@contextmanager
def _opened(source: Source, n_cells: int | None = None) -> Iterator[EpisodeLoop]:
    with closing(build_world(source.campaign, n_cells)) as world, closing(source.loop(world)) as loop:
        yield loop


def _timed_run(source: Source, n_episodes: int) -> tuple[Shard, Speed]:
    """The first run of the episodes, and the speed of the fastest of several runs."""
    with _opened(source) as loop:
        loop.run(0, source.tests(0, min(CELLS, n_episodes)))  # compiles, and constructs for every cell
        tests = source.tests(0, n_episodes)
        began = time.perf_counter()
        shard, elapsed_s = loop.run(0, tests), time.perf_counter() - began
        until = began + SHORTEST_TIMING_S
        while (again := time.perf_counter()) < until:
            loop.run(0, tests)
            elapsed_s = min(elapsed_s, time.perf_counter() - again)
        made_s = loop.construction_s
    steps = max(1, int(shard.episode["n_steps"].sum()))
    median_s = float(np.median(made_s)) if made_s else 0.0
    return shard, Speed(1e6 * elapsed_s / steps, n_episodes / elapsed_s, median_s, len(made_s))


def _run_in_another_order(source: Source, n_episodes: int) -> dict[int, Bits]:
    """Results of every episode run in another cell, the second half first; a user's code in a fresh process."""
    half = n_episodes // 2
    order = [*range(half, n_episodes), *range(half)]
    parts = order[: n_episodes - half], order[n_episodes - half :]
    halves = [(part[0], source.tests(part[0], len(part))) for part in parts]
    if has_foreign_code(source.campaign.av):
        return dict(zip(order, run_elsewhere(source, halves, OTHER_CELLS).bits, strict=True))
    with _opened(source, OTHER_CELLS) as loop:
        shards = [loop.run(*tests) for tests in halves]
    bits = [bits_of(shard, row) for shard in shards for row in range(shard.episode.size)]
    return dict(zip(order, bits, strict=True))


def _moved_by_warm_up(source: Source, n: int) -> dict[float, float]:
    """Largest change of first answers (m/s²), by another length of the warm-up (s); empty for an AV without one."""
    av = source.campaign.av
    if not av.warm_up_steps:
        return {}
    usual = _first_answers(source, av, n)
    moved = {}
    for seconds in (0.0, min(LONGER * av.warm_up_s, LONGEST_S)):
        other = _first_answers(source, av.model_copy(update={"warm_up_s": seconds}), n)
        moved[seconds] = max((abs(usual[i] - other[i]) for i in usual.keys() & other.keys()), default=0.0)
    return moved


def _first_answers(source: Source, av: AutomatedVehicle, n: int) -> dict[int, float]:
    host = build_host(av, n_cells=1, seed=source.scenario.seed, names=source.scenario.shown)
    answers: Any = FirstAnswers(host) if host is not None else None
    world = TwinWorld(1, source.scenario.vehicles)
    with closing(EpisodeLoop(world, source.scenario, source.records(), answers)) as loop:
        failed = loop.run(0, source.tests(0, n)).failures
    return {i: answer for i, answer in answers.noted.items() if i not in failed}


def _likely_cause(source: Source, episode: int) -> tuple[Cause | None, Sequence[str]]:
    """Why an episode is not the same again, by what brings that about; and where a clock was read, if that is it."""

    def bits_after(before: Sequence[int]) -> Bits:
        with _opened(source, 1) as loop:
            for earlier in before:
                loop.run(earlier, source.tests(earlier, 1))
            return bits_of(loop.run(episode, source.tests(episode, 1)), 0)

    if has_foreign_code(source.campaign.av):
        test = [(episode, source.tests(episode, 1))]
        one, other, later = (run_elsewhere(source, test, held=held) for held in (True, True, False))
        if one.bits != other.bits:
            return "process", ()
        if one.bits != later.bits:  # the clock is the same in the first two, and another in the last
            return "clock", later.clock_read_at
        elsewhere = one.bits[0]
    alone = bits_after([])
    if any(bits_after([]) != alone for _ in range(2)):
        return "random", ()
    if any(bits_after(before) != alone for before in (range(max(0, episode - OTHER_CELLS), episode), [episode])):
        return "remembers", ()
    if has_foreign_code(source.campaign.av) and alone != elsewhere:
        return "process", ()  # as hash() of a text, which is the same in all fresh processes of one server
    return "shares", ()


def _follows(shard: Shard) -> Follows:
    """How the AV follows the vehicle ahead, the first of the scenario's, until the onset."""
    headways, gaps, closing_speeds, n_hit = [], [], [], 0
    for row, trace in shard.traces.items():
        onset = int(shard.episode["onset_step"][row])
        until = min(onset if onset >= 0 else len(trace) - 1, len(trace) - 1)
        gap = trace[: until + 1, 0, 0] - VEHICLE_LENGTH_M - trace[: until + 1, -1, 0]
        gaps.append(float(gap.min()))
        n_hit += bool(shard.episode["outcome"][row] == CRASH and until == len(trace) - 1)
        if trace[until, -1, 1] > 0.0:
            headways.append(float(gap[-1] / trace[until, -1, 1]))
        closing_speeds.append(float(trace[until, -1, 1] - trace[until, 0, 1]))
    headway, speed = (float(np.median(values or [math.nan])) for values in (headways, closing_speeds))
    return Follows(headway, min(gaps, default=math.nan), speed, n_hit)


def _behaviour(shard: Shard, limits: tuple[float, float], did: str, *, early: bool) -> Behaviour:
    """What the AV does after the event; ``early``, from the start. ``did`` names the step that shows it looks."""
    episode, took_over = shard.episode, shard.episode[f"{did}_step"]
    acted, reactions = [], []
    for row, trace in sorted(shard.traces.items()):
        event, onset = int(episode["event_step"][row]), int(episode["onset_step"][row])
        if episode["outcome"][row] == FAILED:
            continue
        commanded = trace[:-1, -1, 2]  # the last row commands nothing
        if early or event >= 0:
            acted.append(commanded[0 if early else onset + 1 :])
        if event >= 0:
            braking = np.flatnonzero(commanded[onset + 1 :] < BRAKING_MPS2)
            reactions.append(float(braking[0]) * STEP_S if braking.size else np.inf)
    a = np.concatenate(acted) if any(part.size for part in acted) else np.array([np.nan])
    reaction = np.array(reactions)
    braked = np.isfinite(reaction)
    return Behaviour(
        mean_acceleration_mps2=float(a.mean()), min_acceleration_mps2=float(a.min()),
        max_acceleration_mps2=float(a.max()), share_at_min=float(np.mean(a <= limits[0] + AT_LIMIT_MPS2)),
        share_at_max=float(np.mean(a >= limits[1] - AT_LIMIT_MPS2)),
        reaction_s=float(np.median(reaction[braked])) if braked.any() else np.nan,
        braking_share=float(braked.mean()) if reaction.size else np.nan,
        n_events=len(reactions), n_crashes=int(np.count_nonzero(episode["outcome"] == CRASH)),
        n_took_over_early=int(np.count_nonzero((took_over >= 0) & (took_over <= episode["event_step"]))),
        n_braked_before=int(np.count_nonzero(episode["braked_before"])),
        n_asked_to_speed_up=int(np.count_nonzero(episode["asked_to_speed_up"])),
    )  # fmt: skip
