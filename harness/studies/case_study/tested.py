"""Steps that test a vehicle, and the crashes that they leave behind: all that rates and their errors follow from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.arrays import BoolArray, FloatArray, IntArray
from harness.campaign.loading import load_campaign
from harness.campaign.models import Campaign
from harness.errors import HarnessError
from harness.estimators.block import Block
from harness.estimators.intervals import clopper_pearson
from harness.outcomes import CRASH, FAILED
from harness.records.folder import read_table, write_atomically
from harness.resolved import resolve
from harness.runner.campaign_run import run_campaign
from harness.runner.prepare import prepare
from harness.runner.stored_estimates import stored_blocks
from harness.studies.case_study.context import Context, Made
from harness.studies.case_study.figures import exactly, figure, tests_for, z_of
from harness.studies.case_study.study_file import Run, TwinTests
from harness.studies.run import worker_processes
from harness.studies.weighted_campaign import prepared_twin

PART, AT_ONCE = 500_000, 50_000
"""Tests of a file that a killed step goes on from, and of a call of the twin."""
GROUPS = 20
CRASHES = "crashes.parquet"
_IN_THE_TWIN = ("world.engine=twin", "records.moments=none", "records.traces=none", "records.trace_share=0.0")
_COLUMNS = ("episode", "weight", "n_control_steps", "failed")


@dataclass(frozen=True)
class Tests:
    """Tests of a step: ``n`` of them, and (k,) rows in index order of those that crashed or failed."""

    n: int
    episode: IntArray
    weight: FloatArray
    n_control_steps: IntArray
    failed: BoolArray

    @property
    def y(self) -> FloatArray:
        """Weighted crashes (k,); a failed test counts as none."""
        return np.where(self.failed, 0.0, self.weight)


def campaign_of(step: TwinTests | Run) -> Campaign:
    """The campaign that a step tests.

    Raises
    ------
    HarnessError
        It is wrong, or draws from shells where crashes alone are to be kept.
    """
    campaign = load_campaign(step.campaign, [*step.set, *(_IN_THE_TWIN if isinstance(step, TwinTests) else ())])
    if isinstance(step, TwinTests) and campaign.testing.method == "shells":
        raise HarnessError(
            step.campaign,
            found="testing.method shells",
            expected="nde, forced, step_mixture or episode_mixture for a step of kind twin_tests",
            mend="Make it a step of kind run.",
        )
    return campaign


def test_in_twin(step: TwinTests, context: Context) -> dict[str, Any]:
    """Test in worker processes, part by part; parts on disk are taken as they are."""
    campaign = campaign_of(step)
    prepare(resolve(campaign), context.progress)  # tables and kernels are built once, before the workers start
    file, parts = campaign.model_dump_json(), context.folder / "parts"
    parts.mkdir(exist_ok=True)
    places = {first: parts / f"{first:012d}.parquet" for first in range(0, step.tests, PART)}
    missing = [(first, min(PART, step.tests - first)) for first, place in places.items() if not place.is_file()]
    context.progress.stage(context.name, step.tests, done=step.tests - sum(n for _, n in missing))
    with worker_processes(context.workers) as executor:
        for (first, n), table in zip(missing, executor.map(partial(crashes_in_twin, file), missing), strict=True):
            write_table(places[first], table)
            context.progress.advance(n)
    whole = pa.concat_tables([read_table(place) for place in places.values()])
    result = _kept(context, step.tests, whole)
    for place in places.values():
        place.unlink()
    parts.rmdir()
    return result


def crashes_in_twin(campaign_json: str, part: tuple[int, int]) -> pa.Table:
    """Crashed and failed ones of the tests ``first … first + n - 1``."""
    prepared, loop = prepared_twin(campaign_json)
    (first, n), tables = part, []
    for start in range(first, first + n, AT_ONCE):
        size = min(AT_ONCE, first + n - start)
        rows = loop.run(start, prepared.states(start, size)).results.episode
        at = np.flatnonzero((rows["outcome"] == CRASH) | (rows["outcome"] == FAILED))
        failed = rows["outcome"][at] == FAILED
        tables.append(_rows(start + at, rows["log_weight"][at], rows["n_control_steps"][at], failed))
    return pa.concat_tables(tables)


def keep_run(step: Run, context: Context) -> dict[str, Any]:
    """Run the campaign, or go on with it."""
    campaign, run = campaign_of(step), context.folder / "run"
    begun = (run / "manifest.json").is_file()
    done = run_campaign(campaign, run, workers=context.workers, resume=begun, progress=context.progress)
    if campaign.testing.method != "shells":
        blocks = list(_crashes_of(stored_blocks(run, moments=False)))
        n = int(done.estimates["n_episodes"])
        return {"engine": campaign.world.engine, **_kept(context, n, pa.concat_tables(blocks))}
    found = done.estimates["estimates"]["shells"]
    rate = figure(found["crash_rate"], found["ci_low"], found["ci_high"])
    figures = {"tests": exactly(found["n_episodes"]), "crashes": exactly(found["n_crashes"]), "crash_rate": rate}
    reached = found["rhw"] is not None and found["rhw"] <= context.rhw
    tests = exactly(found["n_episodes"]) if reached else figure(None)
    return {"engine": campaign.world.engine, "figures": {**figures, "tests_for_rhw": tests}}


def _crashes_of(blocks: Iterator[Block]) -> Iterator[pa.Table]:
    for block in blocks:
        at = np.flatnonzero(block.crash | block.failed)
        yield _rows(block.first_episode + at, block.log_weight[at], block.n_control_steps[at], block.failed[at])


def _rows(episode: IntArray, log_weight: FloatArray, n_control_steps: IntArray, failed: BoolArray) -> pa.Table:
    known = np.where(np.isfinite(log_weight), log_weight, 0.0)
    columns = episode.astype(np.int64), np.exp(known), n_control_steps.astype(np.int64), failed
    return pa.table(dict(zip(_COLUMNS, columns, strict=True)))


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table of results."""
    write_atomically(path, lambda file: pq.write_table(table, file, compression="zstd"))


def _kept(context: Context, n: int, table: pa.Table) -> dict[str, Any]:
    write_table(context.folder / CRASHES, table)
    tests = _tests(n, table)
    relvar = relative_variance(tests)
    per_relvar = tests_for(1.0, context.rhw, context.confidence)
    figures = {
        "tests": exactly(n),
        "crashes": exactly(int(np.count_nonzero(~tests.failed))),
        "failed": exactly(int(np.count_nonzero(tests.failed))),
        "crash_rate": crash_rate(tests, context.confidence),
        "relvar": relvar,
        "tests_for_rhw": figure(*(None if x is None else x * per_relvar for x in relvar.values())),
    }
    return {"n": n, "figures": figures}


def _tests(n: int, table: pa.Table) -> Tests:
    return Tests(n, *(table.column(name).to_numpy() for name in _COLUMNS))


def read_tests(made: Made) -> Tests:
    """Tests of a finished step.

    Raises
    ------
    HarnessError
        They were drawn from shells, each with a probability of its own.
    """
    if "n" not in made.result:
        raise HarnessError(
            str(made.folder),
            found="tests drawn from shells, of which each has its own probability",
            expected="tests that can be averaged: drawn by nde, forced, step_mixture or episode_mixture",
            mend="Name another step.",
        )
    return _tests(made.result["n"], read_table(made.folder / CRASHES))


def crash_rate(tests: Tests, confidence: float) -> dict[str, Any]:
    """Mean of Y with the paper's normal interval; of tests without weights with that of Clopper and Pearson."""
    y, n = tests.y, tests.n
    rate = float(y.sum()) / n
    if np.all(y[~tests.failed] == 1.0):
        low, high = map(float, clopper_pearson(np.count_nonzero(y), n, (1.0 - confidence) / 2.0))
        return figure(rate, low, high)
    half = z_of(confidence) * np.sqrt(max(float(y @ y) / n - rate * rate, 0.0) / max(n - 1, 1))
    return figure(rate, max(rate - half, 0.0), rate + half)


def relative_variance(tests: Tests) -> dict[str, Any]:
    """Var(Y)/μ² per test, with two standard errors from leaving out one of 20 groups of tests at a time.

    What rare large weights not seen yet would add is in neither.
    """
    y = tests.y
    group = np.minimum(tests.episode * GROUPS // tests.n, GROUPS - 1)
    sums = np.array([np.bincount(group, weights=power, minlength=GROUPS) for power in (y, y * y)])
    value = _relvar(sums.sum(axis=1), tests.n)
    if value is None:
        return figure(None)
    left = [_relvar(sums.sum(axis=1) - sums[:, k], tests.n * (GROUPS - 1) / GROUPS) for k in range(GROUPS)]
    if any(each is None for each in left):
        return figure(value)
    error = float(np.std(np.array(left, dtype=np.float64))) * np.sqrt(GROUPS - 1)
    return figure(value, max(value - 2.0 * error, 0.0), value + 2.0 * error)


def _relvar(sums: FloatArray, n: float) -> float | None:
    total, squares = sums
    return float(n * squares / (total * total) - 1.0) if total > 0.0 else None
