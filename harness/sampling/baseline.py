"""Before tests that count: baseline runs, and tests of milder events.

A vehicle that acts before the event is driven along each path without one, to know where it is.

A test repeats the path with an event, and tells the vehicle the index of the baseline run, so that both see the same
random stream. What the vehicle did through the step of the event must be the same to the last bit, or the test fails.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.errors import RunFolderError
from harness.families.protocol import Paths, Recorded
from harness.loop.loop import EpisodeLoop, RecordPolicy, Shard
from harness.loop.repeat import Traffic
from harness.pool.vehicle_pool import BaselinePaths
from harness.records.folder import MILDER, SHADOW, Part, read_kept
from harness.records.schemas import baseline_table, episodes_table, padded
from harness.resolved import Resolved
from harness.sampling.protocol import ShardRequest, Source
from harness.vocabulary import FAILED

SHARD_RUNS = 50
"""Baseline runs of one task: half a second of a slow controller."""
IN_WORDS = {SHADOW: "baseline runs", MILDER: "milder events"}
"""Of each table."""
ALL_MOTION = RecordPolicy("all", 0.0)


@dataclass(frozen=True)
class BaselineResult:
    """A finished range: its table."""

    request: ShardRequest
    table: pa.Table

    @property
    def failures(self) -> Counter[str]:
        """Causes of failures."""
        return Counter(self.table.column("failure").drop_null().to_pylist())


def baseline_requests(n: int) -> Iterator[ShardRequest]:
    """All baseline runs of a campaign, in order."""
    firsts = enumerate(range(0, n, SHARD_RUNS))
    return (ShardRequest(index, first, min(SHARD_RUNS, n - first), before=SHADOW) for index, first in firsts)


def milder_requests(prescribed: Traffic) -> Iterator[ShardRequest]:
    """All tests of milder events, in order."""
    for index, first in enumerate(range(0, len(prescribed), SHARD_RUNS)):
        of_rows = prescribed.rows(slice(first, first + SHARD_RUNS))
        yield ShardRequest(index, first, len(of_rows), before=MILDER, prescribed=of_rows)


def run_baseline(
    loop: EpisodeLoop, paths: BaselinePaths | None, resolved: Resolved, request: ShardRequest
) -> BaselineResult:
    """Drive the loop's vehicle along a range of paths, or in prescribed tests."""
    if request.prescribed is not None:
        shard = loop.beside(keep=ALL_MOTION).run(request.first_episode, request.prescribed)
        return BaselineResult(request, episodes_table(shard, resolved.campaign.seed))
    assert paths is not None
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


def begin(source: Source, drive: Callable[[str, Sequence[ShardRequest]], pa.Table]) -> tuple[pa.Table, Recorded]:
    """Let a campaign's tests follow from baseline runs, whose table ``drive`` gives: as it is, and as arrays."""
    table = drive(SHADOW, list(baseline_requests(len(source.baseline_paths or ()))))
    runs = as_recorded(table, source.scenario.max_steps)
    source.begin_after(runs)
    return table, runs


def read_stored(
    folder: Path, paths: BaselinePaths, before: Mapping[str, Part], name: str, requests: Sequence[ShardRequest]
) -> pa.Table:
    """All of a run folder's; a `RunFolderError` if some are missing or damaged."""
    stored = stored_table(folder, before, name)
    if stored is None or any(stored_baseline(stored, paths, request) is None for request in requests):
        there = f"{0 if stored is None else stored.num_rows} {IN_WORDS[name]}"
        expected = f"all {sum(each.n_episodes for each in requests)}: they say what is tested, and how probable it is"
        raise RunFolderError(str(folder / name), there, expected, "Let `harness run` go on with --resume.")
    return stored


def as_recorded(table: pa.Table, max_steps: int) -> Recorded:
    """All baseline runs of a campaign as arrays."""
    n_steps = table.column("n_steps").to_numpy().astype(np.int64)
    failed = np.asarray(pc.equal(table.column("outcome").cast(pa.string()), "failed"))
    motion = (padded(table.column(name), max_steps + 1)[0] for name in ("av_position_m", "av_speed_mps"))
    return Recorded(n_steps, failed, *motion)


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
