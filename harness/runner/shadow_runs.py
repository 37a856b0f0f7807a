"""Shadow runs: a vehicle that acts before the cut-in is driven along each path without one, to know where it is.

A test repeats the path with a cut-in, and tells the vehicle the index of the shadow run, so that both see the same
random stream. What the vehicle did through the step of the cut-in must be the same to the last bit, or the test fails.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from harness.episode.cells import PrescribedTraffic, drawn_traffic
from harness.episode.decide import CUT_IN_DRAW
from harness.episode.judge import motion_hashes
from harness.episode.loop import EpisodeLoop, RecordPolicy, Shard
from harness.episode.path import Followers
from harness.errors import RunFolderError
from harness.pool.cut_ins import onset_steps
from harness.pool.enumeration import ShadowRuns, enumerate_cut_ins, write_script
from harness.pool.storage import padded
from harness.pool.vehicle_pool import ShadowPaths
from harness.random_stream import CUT_IN, uniforms
from harness.records.folder import COMPRESSION, read_table
from harness.records.schemas import shadow_table
from harness.traffic.laws import Environment
from harness.vehicles.drivers import driver_records
from harness.vocabulary import AV, FAILED, IntArray, RecordArray

SHADOW = "shadow"
"""Folder of the shadow runs within a run folder."""
SHARD_RUNS = 50
"""Shadow runs of one file and one task: half a second of a slow controller."""
ALL_MOTION = RecordPolicy(0, "all", 0.0)
AT_ONCE = 1000
"""Shadow runs whose motion is held in memory at once: some 15 MB."""
_MEND = "Delete this file and run again with --resume: the same shadow runs are made anew."


@dataclass(frozen=True)
class ShadowSpec:
    """A fixed range of shadow runs."""

    index: int
    first_episode: int
    n_episodes: int


@dataclass(frozen=True)
class ShadowDone:
    """A finished range: its table, as a file where it is not on disk yet, and the causes of failures."""

    spec: ShadowSpec
    table: pa.Table
    parquet: bytes
    failures: Counter[str]


def shadow_specs(n: int) -> Iterator[ShadowSpec]:
    """All shadow runs of a campaign, in order."""
    return (ShadowSpec(i, first, min(SHARD_RUNS, n - first)) for i, first in enumerate(range(0, n, SHARD_RUNS)))


def shadow_file(folder: Path, spec: ShadowSpec) -> Path:
    """Where a range of shadow runs is kept."""
    return folder / SHADOW / f"shard-{spec.index:06d}.parquet"


def run_shadows(loop: EpisodeLoop, paths: ShadowPaths, environment: Environment, spec: ShadowSpec) -> ShadowDone:
    """Drive the loop's vehicle along a range of paths."""
    rows = slice(spec.first_episode, spec.first_episode + spec.n_episodes)
    shard = without_cut_in(loop, paths.seed, spec.first_episode, paths.index[rows], paths.state[rows], environment)
    table = shadow_table(shard, paths.index[rows], paths.weight[rows])
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression=COMPRESSION)
    return ShadowDone(spec, table, sink.getvalue().to_pybytes(), _causes(table))


def stored_shadows(folder: Path, paths: ShadowPaths, spec: ShadowSpec) -> ShadowDone | None:
    """A range that an earlier run has finished, or None; a `RunFolderError` if it is damaged, or of other paths."""
    file = shadow_file(folder, spec)
    if not file.exists():
        return None
    table = _read(file)
    rows = slice(spec.first_episode, spec.first_episode + spec.n_episodes)
    if not np.array_equal(table.column("path").to_numpy(), paths.index[rows]):
        raise RunFolderError(
            str(file),
            found="shadow runs on other paths",
            expected="those of this campaign and this version of the harness",
            mend="Use a new folder, or the version that the run was begun with (manifest.json).",
        )
    return ShadowDone(spec, table, b"", _causes(table))


def _read(file: Path) -> pa.Table:
    try:
        return read_table(file)
    except RunFolderError as error:
        raise RunFolderError(error.where, found=error.found, expected=error.expected, mend=_MEND) from error


def _causes(table: pa.Table) -> Counter[str]:
    return Counter(table.column("failure").drop_null().to_pylist())


def read_shadows(folder: Path, paths: ShadowPaths, environment: Environment) -> ShadowRuns:
    """All shadow runs of a run folder; a `RunFolderError` if some are missing or damaged."""
    found = [stored_shadows(folder, paths, spec) for spec in shadow_specs(len(paths))]
    if any(done is None for done in found):
        raise RunFolderError(
            str(folder / SHADOW),
            found=f"shadow runs of {sum(done is not None for done in found)} of {len(found)} files",
            expected="those of all paths: they say how probable each test is",
            mend="Let `harness run` go on with --resume.",
        )
    return as_recorded([done.table for done in found if done is not None], environment)


def as_recorded(tables: list[pa.Table], environment: Environment) -> ShadowRuns:
    """Consecutive shadow runs as arrays."""
    table = pa.concat_tables(tables, promote_options="none")
    width = int(environment.numbers["max_steps"]) + 1
    n_steps = table.column("n_steps").to_numpy().astype(np.int64)
    failed = np.asarray(pc.equal(table.column("outcome").cast(pa.string()), "failed"))
    motion = (padded(table.column(name), width)[0] for name in ("av_position_m", "av_speed_mps"))
    return ShadowRuns(n_steps, failed, *motion)


def without_cut_in(
    loop: EpisodeLoop, seed: int, first: int, index: IntArray, state: RecordArray, environment: Environment
) -> Shard:
    """Drive the loop's vehicle along paths (n,) on which nobody cuts in; the first is its episode ``first``."""
    none = np.full(len(index), -1, np.int64)
    lv, bv, *_ = write_script(seed, index, none, state, environment)
    traffic = drawn_traffic()._replace(lv=lv, bv=bv, cut_step=none, stratum=none, log_weight=np.zeros(len(index)))
    return loop.beside(keep=ALL_MOTION).run(first, state, traffic)


def forced_traffic(
    loop: EpisodeLoop, seed: int, first: int, state: RecordArray, environment: Environment
) -> PrescribedTraffic:
    """Scripts of consecutive forced cut-ins (n,), each after a shadow run of its own on the same path.

    The cut-in's step is drawn given that there is one, and its weight is the probability of that: both follow from the
    shadow run. Where that fails there is no cut-in; the test fails as well, and weighs what it may have hidden.
    """
    begins = range(0, len(state), AT_ONCE)
    parts = [_forced(loop, seed, first + begin, state[begin : begin + AT_ONCE], environment) for begin in begins]
    return PrescribedTraffic._make(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _forced(
    loop: EpisodeLoop, seed: int, first: int, state: RecordArray, environment: Environment
) -> PrescribedTraffic:
    n, index = len(state), first + np.arange(len(state))
    runs = recorded(without_cut_in(loop, seed, first, index, state, environment), environment)
    nobody = Followers(driver_records([]))
    probability, _, unknown = enumerate_cut_ins(seed, index, state, environment, nobody, runs)
    cumulative = np.cumsum(probability, axis=1)
    p_cut_in = cumulative[:, -1]
    u = uniforms(seed, first, n, CUT_IN, CUT_IN_DRAW + 1)[:, CUT_IN_DRAW]
    step = np.minimum((cumulative <= (u * p_cut_in)[:, None]).sum(1), (cumulative < p_cut_in[:, None]).sum(1))
    step[runs.failed] = -1
    lv, bv, _, _, lead = write_script(seed, index, step, state, environment, draws_per_cut_in=0)
    motion = motion_hashes(runs.x_m, runs.v_mps)[np.arange(n), onset_steps(step, lead)]
    return PrescribedTraffic(lv, bv, step, np.full(n, -1), np.log(p_cut_in + unknown), index, motion, lead)


def recorded(shard: Shard, environment: Environment) -> ShadowRuns:
    """Shadow runs as they come from the loop."""
    episode, width = shard.results.episode, int(environment.numbers["max_steps"]) + 1
    x, v = np.zeros((2, episode.size, width))
    for row, trace in shard.traces.items():
        x[row, : len(trace)], v[row, : len(trace)] = trace[:, AV, 0], trace[:, AV, 1]
    return ShadowRuns(episode["n_steps"].astype(np.int64), episode["outcome"] == FAILED, x, v)
