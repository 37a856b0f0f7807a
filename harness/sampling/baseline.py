"""Before tests that count: baseline runs, and the pilot tests that a surrogate is learned from.

A vehicle that acts before the cut-in is driven along each path without one, to know where it is.

A test repeats the path with a cut-in, and tells the vehicle the index of the baseline run, so that both see the same
random stream. What the vehicle did through the step of the cut-in must be the same to the last bit, or the test fails.
"""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.errors import RunFolderError
from harness.families.protocol import Paths, Recorded
from harness.loop.loop import EpisodeLoop, RecordPolicy, Shard
from harness.loop.repeat import Traffic
from harness.pool.learned import Following, Learned, learn
from harness.pool.vehicle_pool import BaselinePaths
from harness.records.folder import parquet, read_table
from harness.records.schemas import baseline_table, padded, pilot_table
from harness.resolved import Resolved
from harness.sampling.protocol import ShardRequest, Source
from harness.vocabulary import FAILED

SHADOW = "shadow"
"""Folder of the baseline runs within a run folder; it keeps its first name."""
SHARD_RUNS = 50
"""Baseline runs of one file and one task: half a second of a slow controller."""
PILOT = "pilot"
"""Folder of the pilot tests."""
BASELINE_RUNS, PILOT_TESTS = "baseline runs", "pilot tests"
IN_MANIFEST = {BASELINE_RUNS: ("shadow_runs", "baseline_crc32"), PILOT_TESTS: ("pilot_tests", "pilot_crc32")}
"""Keys of their numbers, and of their checksums."""
LEARNED = b"harness.learned"
"""Key in the metadata of the baseline runs as workers get them."""
ALL_MOTION = RecordPolicy("all", 0.0)
_MEND = "Delete this file and run again with --resume: the same baseline runs are made anew."


@dataclass(frozen=True)
class BaselineResult:
    """A finished range: its table, as a file where it is not on disk yet, and the causes of failures."""

    request: ShardRequest
    table: pa.Table
    parquet: bytes
    failures: Counter[str]


def baseline_requests(n: int) -> Iterator[ShardRequest]:
    """All baseline runs of a campaign, in order."""
    firsts = enumerate(range(0, n, SHARD_RUNS))
    return (ShardRequest(index, first, min(SHARD_RUNS, n - first), baseline=True) for index, first in firsts)


def pilot_requests(prescribed: Traffic) -> Iterator[ShardRequest]:
    """All pilot tests, in order."""
    for index, first in enumerate(range(0, len(prescribed), SHARD_RUNS)):
        of_rows = prescribed.rows(slice(first, first + SHARD_RUNS))
        yield ShardRequest(index, first, len(of_rows), baseline=True, prescribed=of_rows)


def baseline_file(folder: Path, request: ShardRequest) -> Path:
    """Where a range of baseline runs, or of pilot tests, is kept."""
    return folder / (PILOT if request.prescribed else SHADOW) / f"shard-{request.index:06d}.parquet"


def run_baseline(loop: EpisodeLoop, paths: BaselinePaths, resolved: Resolved, request: ShardRequest) -> BaselineResult:
    """Drive the loop's vehicle along a range of paths, or in pilot tests."""
    if request.prescribed is not None:
        table = pilot_table(loop.beside(keep=ALL_MOTION).run(request.first_episode, request.prescribed))
        return BaselineResult(request, table, parquet(table), _causes(table))
    rows = slice(request.first_episode, request.first_episode + request.n_episodes)
    some = Paths(paths.index[rows], paths.start[rows])
    shard = without_event(loop, resolved, paths.seed, some, request.first_episode)
    table = baseline_table(shard, some.number, paths.weight[rows])
    return BaselineResult(request, table, parquet(table), _causes(table))


def stored_baseline(
    folder: Path, paths: BaselinePaths, listed: Sequence[int], request: ShardRequest
) -> BaselineResult | None:
    """A range that an earlier run has finished, or None; a `RunFolderError` if it is damaged, or of other paths.

    ``listed`` are checksums of the files, as far as the manifest lists them.
    """
    file = baseline_file(folder, request)
    if not file.exists():
        return None
    crc32 = listed[request.index] if request.index < len(listed) else None
    table = read_table(file, crc32=crc32, mend=_MEND)
    rows = slice(request.first_episode, request.first_episode + request.n_episodes)
    name, wanted = "path", paths.index[rows]
    if request.prescribed is not None:
        name, wanted = "shadow", request.prescribed.script.announced_index
    if not np.array_equal(table.column(name).to_numpy(), wanted):
        expected = "those of this campaign and this version of the harness"
        mend = "Use a new folder, or the version that the run was begun with (manifest.json)."
        raise RunFolderError(str(file), "baseline runs on other paths", expected, mend)
    return BaselineResult(request, table, b"", _causes(table))


def _causes(table: pa.Table) -> Counter[str]:
    return Counter(table.column("failure").drop_null().to_pylist())


def begin(source: Source, drive: Callable[[str, Sequence[ShardRequest]], pa.Table]) -> tuple[pa.Table, Recorded]:
    """Let a campaign's tests follow from baseline runs and pilot tests, whose tables ``drive`` gives.

    Returns the baseline runs: as workers get them, with what was learned (`learned_in`), and as arrays.
    """
    table, learned = drive(BASELINE_RUNS, list(baseline_requests(len(source.baseline_paths or ())))), None
    runs = as_recorded(table, source.scenario.max_steps)
    source.begin_after(runs)
    if (pilot := source.pilot()) is not None:
        learned = learned_from(drive(PILOT_TESTS, list(pilot_requests(pilot))), runs)
        source.begin_after(runs, learned)
    return table.replace_schema_metadata({LEARNED: pickle.dumps(learned)}), runs


def learned_in(table: pa.Table) -> Learned | None:
    """What comes with baseline runs; see `begin`."""
    found: Learned | None = pickle.loads(table.schema.metadata[LEARNED])  # noqa: S301 - our own
    return found


def read_stored(
    folder: Path, paths: BaselinePaths, manifest: Mapping[str, Any], what: str, requests: Sequence[ShardRequest]
) -> pa.Table:
    """All of a run folder's; a `RunFolderError` if some are missing or damaged."""
    listed = manifest.get(IN_MANIFEST[what][1], ())
    found = [stored_baseline(folder, paths, listed, request) for request in requests]
    if any(done is None for done in found):
        there = f"{what} of {sum(done is not None for done in found)} of {len(found)} files"
        expected = "all of them: they say what is tested, and how probable each test is"
        where = str(baseline_file(folder, requests[0]).parent)
        raise RunFolderError(where, there, expected, "Let `harness run` go on with --resume.")
    return pa.concat_tables(done.table for done in found if done is not None)


def learned_from(table: pa.Table, runs: Recorded) -> Learned | None:
    """What all pilot tests teach that have not failed; None if those are none."""
    table = table.filter(pc.is_null(table.column("failure")))
    if not table.num_rows:
        return None
    width = runs.x_m.shape[1]
    names = "av_position_m", "av_speed_mps", "bv_position_m", "bv_speed_mps"
    (x_av, last), *others = (padded(table.column(name), width) for name in names)
    shadow, onset = (table.column(name).to_numpy().astype(np.int64) for name in ("shadow", "onset_step"))
    return learn(Following(shadow, onset + 1, last - 1, x_av, *(values for values, _ in others)), runs)


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
