"""Steps that test a vehicle, and the crashes that they leave behind: all that rates and their errors follow from."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.errors import HarnessError
from harness.estimators.limits import clopper_pearson, normal_half_width
from harness.records.folder import read_table
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.runner.run import RunResult, run_campaign
from harness.runner.stored import stored_blocks
from harness.vocabulary import CRASH, FAILED, BoolArray, FloatArray, IntArray, Method
from studies.case_study.figures import exactly, figure, is_settled, marked, tests_for, weights_are_in
from studies.case_study.study import Context, Made, Run, TwinTests
from studies.replication.weighted import prepared_twin
from studies.replication.work import write_table

PART, AT_ONCE = 500_000, 50_000
"""Tests of a file that a killed step goes on from, and of a call of the twin."""
GROUPS = 20
CRASHES = "crashes.parquet"
IN_THE_TWIN = ("world.engine=twin", "records.traces=none", "records.trace_share=0.0")
_WEIGHT = b"sum_of_weights"


class Tests(NamedTuple):
    """Tests of a step: ``n`` of them, and (k,) rows in index order of those that crashed or failed."""

    n: int
    episode: IntArray
    weight: FloatArray
    failed: BoolArray

    @property
    def y(self) -> FloatArray:
        """Weighted crashes (k,); a failed test counts as none."""
        return np.where(self.failed, 0.0, self.weight)


def campaign_of(step: TwinTests | Run) -> Campaign:
    """The campaign that a step tests.

    Raises `HarnessError`: it is wrong, or draws from shells where crashes alone are to be kept.
    """
    bare = (*IN_THE_TWIN, "records.moments=none") if isinstance(step, TwinTests) else ()
    campaign = load_campaign(step.campaign, [*step.set, *bare])
    if isinstance(step, TwinTests) and campaign.testing.method == "shells":
        expected = "nde, forced, step_mixture or episode_mixture for a step of kind twin_tests"
        raise HarnessError(step.campaign, "testing.method shells", expected, "Make it a step of kind run.")
    return campaign


def test_in_twin(step: TwinTests, context: Context) -> dict[str, Any]:
    """Test in worker processes, part by part; parts on disk are taken as they are."""
    campaign = campaign_of(step)
    prepare(resolve(campaign), context.progress)  # tables and kernels are built once, before the workers start
    make = partial(crashes_in_twin, campaign.model_dump_json())
    jobs = [(first, min(PART, step.tests - first)) for first in range(0, step.tests, PART)]
    return _kept(context, campaign.testing.method, step.tests, context.by_workers(jobs, make, size=lambda job: job[1]))


def crashes_in_twin(campaign_json: str, part: tuple[int, int]) -> pa.Table:
    """Crashed and failed ones of the tests ``first … first + n - 1``."""
    prepared, loop = prepared_twin(campaign_json)
    (first, n), tables = part, []
    for start in range(first, first + n, AT_ONCE):
        rows = loop.run(start, prepared.states(start, min(AT_ONCE, first + n - start))).results.episode
        ends = rows["outcome"] == CRASH, rows["outcome"] == FAILED
        tables.append(_crashes(start, *ends, rows["log_weight"], rows["n_control_steps"]))
    return pa.concat_tables(tables).replace_schema_metadata({_WEIGHT: repr(sum(map(_weight_of, tables)))})


def keep_run(step: Run, context: Context) -> dict[str, Any]:
    """Run the campaign, or go on with it."""
    campaign, run = campaign_of(step), context.folder / "run"
    begun = (run / "manifest.json").is_file()
    done = run_campaign(campaign, run, workers=context.workers, resume=begun, progress=context.progress)
    if campaign.testing.method != "shells":
        tables = [
            _crashes(block.first_episode, block.crash, block.failed, block.log_weight, block.n_control_steps)
            for block in stored_blocks(run, moments=False)
        ]
        n, method = int(done.estimates["n_episodes"]), campaign.testing.method
        return {"engine": campaign.world.engine, **_kept(context, method, n, tables)}
    return {"engine": campaign.world.engine, "figures": figures_of_shells(done, context.rhw)}


def figures_of_shells(done: RunResult, rhw: float) -> dict[str, Any]:
    """What a run of shells says."""
    found = done.estimates["estimates"]["shells"]
    known = found["rhw"] is not None
    return {
        "tests": exactly(found["n_episodes"]),
        "crashes": exactly(found["n_crashes"]),
        "crash_rate": figure(found["crash_rate"], found["ci_low"], found["ci_high"]),
        "tests_for_rhw": figure(found["n_episodes"] * (found["rhw"] / rhw) ** 2 if known else None),
    }


def _crashes(
    first: int, crash: BoolArray, failed: BoolArray, log_weight: FloatArray, n_control_steps: IntArray
) -> pa.Table:
    """Rows of tests (n,) from a first one on that crashed or failed, together with the sum of the weights of all."""
    at = np.flatnonzero(crash | failed)
    weight = np.exp(np.where(np.isfinite(log_weight[at]), log_weight[at], 0.0))
    columns = {"episode": first + at, "weight": weight, "n_control_steps": n_control_steps[at].astype(np.int64)}
    with np.errstate(over="ignore"):
        total = float(np.exp(log_weight).sum())
    return pa.table({**columns, "failed": failed[at]}).replace_schema_metadata({_WEIGHT: repr(total)})


def _weight_of(table: pa.Table) -> float:
    return float(table.schema.metadata[_WEIGHT])


def _kept(context: Context, method: Method, n: int, tables: list[pa.Table]) -> dict[str, Any]:
    mean_weight = math.fsum(map(_weight_of, tables)) / n
    table = pa.concat_tables(tables)
    write_table(context.folder / CRASHES, table)
    tests, is_in = _tests(n, table), weights_are_in(method, mean_weight)
    relvar = relative_variance(tests)
    per_relvar = tests_for(1.0, context.rhw, context.confidence)
    figures = {
        "tests": exactly(n),
        "crashes": exactly(int(np.count_nonzero(~tests.failed))),
        "failed": exactly(int(np.count_nonzero(tests.failed))),
        "crash_rate": marked(crash_rate(tests, context.confidence), settled=is_in),
        "relvar": marked(relvar, settled=is_in),
        "tests_for_rhw": marked(
            figure(*(None if x is None else x * per_relvar for x in relvar.values())), settled=is_in
        ),
        "mean_weight": exactly(mean_weight),
    }
    return {"n": n, "figures": figures}


def _tests(n: int, table: pa.Table) -> Tests:
    return Tests(n, *(table.column(name).to_numpy() for name in Tests._fields[1:]))


def read_tests(made: Made) -> Tests:
    """Tests of a finished step.

    Raises `HarnessError`: they were drawn from shells, each with a probability of its own.
    """
    if "n" not in made.result:
        found = "tests drawn from shells, of which each has its own probability"
        expected = "tests that can be averaged: drawn by nde, forced, step_mixture or episode_mixture"
        raise HarnessError(str(made.folder), found, expected, "Name another step.")
    return _tests(made.result["n"], read_table(made.folder / CRASHES))


def settled(made: Made) -> bool:
    """Whether the crash rate of a step means something."""
    return is_settled(made.result["figures"]["crash_rate"])


def crash_rate(tests: Tests, confidence: float) -> dict[str, Any]:
    """Mean of Y with the paper's normal interval; of tests without weights with that of Clopper and Pearson."""
    y, n = tests.y, tests.n
    rate = float(y.sum()) / n
    if np.all(y[~tests.failed] == 1.0):
        low, high = map(float, clopper_pearson(np.count_nonzero(y), n, (1.0 - confidence) / 2.0))
        return figure(rate, low, high)
    half = normal_half_width(np.sqrt(max(float(y @ y) / n - rate * rate, 0.0) / max(n - 1, 1)), confidence)
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
