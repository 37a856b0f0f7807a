"""Before tests that count: baseline runs, and tests of milder events.

A vehicle that acts before the event is driven along each path without one, to know where it is.

A test repeats the path with an event, and tells the vehicle the index of the baseline run, so that both see the same
random stream. What the vehicle did through the step of the event must be the same to the last bit, or the test fails.

Of events that are milder than those that count some are driven, so that it is said where the vehicle crashes there.
They enter no rate, and a vehicle that crashes on them is not accepted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.campaign.campaign import Campaign
from harness.errors import RunFolderError
from harness.families import family_named
from harness.families.protocol import Paths, Recorded
from harness.loop.loop import EpisodeLoop
from harness.pool.vehicle_pool import BaselinePaths
from harness.progress import Progress
from harness.records.folder import MILDER, SHADOW, Part, read_kept
from harness.records.schemas import baseline_table, episodes_table, padded
from harness.resolved import Resolved
from harness.sampling.own_path import ALL_MOTION, Forced, without_event
from harness.sampling.protocol import ShardRequest, Source

SHARD_RUNS = 50
"""Baseline runs of one task: half a second of a slow controller."""
IN_WORDS = {SHADOW: "baseline runs", MILDER: "milder events"}
"""Of each table."""
N_MILDER = 36
"""Tests of milder events: a vehicle that crashes on a tenth of them is found out 98 times in 100."""


@dataclass(frozen=True)
class BaselineResult:
    """A finished range: its table."""

    request: ShardRequest
    table: pa.Table

    @property
    def failures(self) -> Counter[str]:
        """Causes of failures."""
        return Counter(self.table.column("failure").drop_null().to_pylist())


def requests_before(name: str, n: int) -> Iterator[ShardRequest]:
    """So many baseline runs, or tests of milder events, in order."""
    firsts = enumerate(range(0, n, SHARD_RUNS))
    return (ShardRequest(index, first, min(SHARD_RUNS, n - first), before=name) for index, first in firsts)


def run_baseline(loop: EpisodeLoop, paths: BaselinePaths, resolved: Resolved, request: ShardRequest) -> BaselineResult:
    """Drive the loop's vehicle along a range of paths."""
    rows = slice(request.first_episode, request.first_episode + request.n_episodes)
    some = Paths(paths.index[rows], paths.start[rows])
    shard = without_event(loop, resolved, paths.seed, some, request.first_episode)
    return BaselineResult(request, baseline_table(shard, some.number, paths.weight[rows]))


def stored_table(folder: Path, before: Mapping[str, Part], name: str) -> pa.Table | None:
    """What an earlier run has made of a table, as the manifest lists it ``before`` tests; None of one that is gone."""
    there = name in before and (folder / before[name].files[name].path).exists()
    return read_kept(folder, before[name], name) if there else None


def stored_baseline(
    stored: pa.Table | None, paths: BaselinePaths | None, request: ShardRequest
) -> BaselineResult | None:
    """A range that is ``stored``, or None; a `RunFolderError` if that is of other paths."""
    if stored is None or stored.num_rows < request.first_episode + request.n_episodes:
        return None
    table = stored.slice(request.first_episode, request.n_episodes)
    if paths is None or request.before == MILDER:  # which they are the campaign says
        return BaselineResult(request, table)
    rows = slice(request.first_episode, request.first_episode + request.n_episodes)
    if not np.array_equal(table.column("path").to_numpy(), paths.index[rows]):
        expected = "those of this campaign and this version of the harness"
        mend = "Use a new folder, or the version that the run was begun with (manifest.json)."
        raise RunFolderError(request.before, "runs on other paths", expected, mend)
    return BaselineResult(request, table)


def begin(source: Source, drive: Callable[[str, int], pa.Table]) -> tuple[pa.Table, Recorded]:
    """Let a campaign's tests follow from baseline runs, whose table ``drive`` gives: as it is, and as arrays."""
    table = drive(SHADOW, len(source.baseline_paths or ()))
    runs = as_recorded(table, source.scenario.max_steps)
    source.begin_after(runs)
    return table, runs


def read_stored(folder: Path, paths: BaselinePaths, before: Mapping[str, Part], name: str, n: int) -> pa.Table:
    """All of a run folder's; a `RunFolderError` if some are missing or damaged."""
    stored = stored_table(folder, before, name)
    if stored is None or any(stored_baseline(stored, paths, request) is None for request in requests_before(name, n)):
        there = f"{0 if stored is None else stored.num_rows} {IN_WORDS[name]}"
        expected = f"all {n}: they say what is tested, and how probable it is"
        raise RunFolderError(str(folder / name), there, expected, "Let `harness run` go on with --resume.")
    return stored


def as_recorded(table: pa.Table, max_steps: int) -> Recorded:
    """All baseline runs of a campaign as arrays."""
    n_steps = table.column("n_steps").to_numpy().astype(np.int64)
    failed = np.asarray(pc.equal(table.column("outcome").cast(pa.string()), "failed"))
    motion = (padded(table.column(name), max_steps + 1)[0] for name in ("av_position_m", "av_speed_mps"))
    return Recorded(n_steps, failed, *motion)


def run_milder(loop: EpisodeLoop, resolved: Resolved, request: ShardRequest) -> BaselineResult:
    """Drive the loop's vehicle in a range of the milder events, of which there are `N_MILDER`."""
    milder = replace(resolved, environment=resolved.family.milder(resolved.environment))
    tests = Forced(milder, Progress()).tests(0, N_MILDER)
    rows = slice(request.first_episode, request.first_episode + request.n_episodes)
    shard = loop.beside(keep=ALL_MOTION).run(request.first_episode, tests.rows(rows))
    return BaselineResult(request, episodes_table(shard, resolved.campaign.seed))


def milder_of(resolved: Resolved, table: pa.Table) -> dict[str, Any]:
    """Tests, crashes and failures, by their table of episodes, and how many such events an hour of driving has."""
    family, crashes = resolved.family, pc.equal(table.column("outcome").cast(pa.string()), "crash")
    if above := resolved.campaign.crash.counts_above_mps:
        crashes = pc.and_(crashes, pc.fill_null(pc.greater(table.column("impact_speed_mps"), above), fill_value=False))
    exposure = family.exposure(family.milder(resolved.environment), resolved.parameters)
    counts = {"n_tests": len(table), "n_crashes": pc.sum(crashes).as_py()}
    return {**counts, "n_failed": len(table) - table.column("failure").null_count, "per_hour": exposure.per_hour}


def n_left_out(campaign: Campaign, n_before_event: int) -> int:
    """Crashes before the event, where a vehicle that follows is tested around events alone: it needs none to crash.

    Where somebody changes lanes it is not known: a vehicle may see that before the event is done.
    """
    family = family_named(campaign.scenario)
    at_once = family.follows and family.crosses < 0
    return n_before_event if at_once and campaign.testing.method != "nde" else 0


def beyond_scope(milder: Mapping[str, Any] | None) -> int:
    """How many of the milder tests speak against a vehicle: one that has failed may have hidden a crash."""
    return 0 if milder is None else milder["n_crashes"] + milder["n_failed"]
