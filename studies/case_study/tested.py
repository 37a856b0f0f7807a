"""Steps that test a vehicle, and the crashes that they leave behind: all that rates and their errors follow from."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.errors import HarnessError
from harness.estimators.likelihood import Level
from harness.estimators.limits import clopper_pearson
from harness.records.folder import read_table
from harness.resolved import resolve
from harness.runner.run import run_campaign
from harness.runner.stored import stored_blocks
from harness.runner.underway import RunResult
from harness.sampling import prepare
from harness.vocabulary import Method
from studies.case_study.figures import exactly, figure, is_settled, marked, tests_for, weights_are_in
from studies.case_study.study import Context, Made, Run, TwinTests
from studies.replication.weighted import EpisodeSource, twin_episodes
from studies.rnot import Tests
from studies.work import write_table

AT_ONCE = 50_000
"""Tests of a call of the twin."""
GROUPS = 20
CRASHES = "crashes.parquet"
IN_THE_TWIN = ("world.engine=twin", "records.traces=none", "records.trace_share=0.0")


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
    """Test in worker processes, part by part."""
    campaign = campaign_of(step)
    prepare(resolve(campaign), context.progress)  # tables and kernels are built once, before the workers start
    make = partial(crashes_in_twin, twin_episodes(campaign, campaign.seed, ()), step.tests)
    found = context.by_workers(range(0, step.tests, AT_ONCE), make)
    return _kept(context, campaign.testing.method, Tests.joined(found))


def crashes_in_twin(source: EpisodeSource, n: int, first: int) -> Tests:
    """Crashed ones of n tests, from a first one on."""
    return Tests.of_block(source(first, min(AT_ONCE, n - first)))


def keep_run(step: Run, context: Context) -> dict[str, Any]:
    """Run the campaign, or go on with it."""
    campaign, run = campaign_of(step), context.folder / "run"
    done = run_campaign(campaign, run, workers=context.workers, resume=True, progress=context.progress)
    assert isinstance(done, RunResult)  # of one scenario
    method, engine = campaign.testing.method, {"engine": campaign.world.engine}
    if method != "shells":
        tests = Tests.joined(map(Tests.of_block, stored_blocks(run, moments=False)))
        return engine | _kept(context, method, tests)
    found = done.estimates["estimates"]["shells"]
    needed = None if found["rhw"] is None else found["n_episodes"] * (found["rhw"] / context.rhw) ** 2
    rate = figure(found["crash_rate"], found["ci_low"], found["ci_high"])
    figures = {"tests": exactly(found["n_episodes"]), "crash_rate": rate, "tests_for_rhw": figure(needed)}
    return {**engine, "figures": figures}


def _kept(context: Context, method: Method, tests: Tests) -> dict[str, Any]:
    write_table(context.folder / CRASHES, pa.table(dict(zip(Tests._fields[2:], tests[2:], strict=True))))
    mean_weight, rate = tests.sum_of_weights / tests.n, crash_rate(tests, context.confidence)
    per_relvar = tests_for(1.0, context.rhw, context.confidence)
    plain, most, least = (per_relvar * (1.0 / x - 1.0) if x else None for x in rate.values())
    figures = {
        "crash_rate": rate,
        "tests_for_rhw": figure(*(None if x is None else x * per_relvar for x in relative_variance(tests).values())),
        "plain_tests": figure(plain, least, most),  # of plain simulation at this crash rate: z²(1 - μ)/(RHW² μ)
    }
    is_in = weights_are_in(method, mean_weight)
    counts: dict[str, float] = {"tests": tests.n, "crashes": len(tests.y), "mean_weight": mean_weight}
    figures = {name: marked(each, settled=is_in) for name, each in figures.items()}
    return {"n": tests.n, "figures": {**figures, **{name: exactly(each) for name, each in counts.items()}}}


def tests_of(made: Made) -> Tests:
    """Tests of a finished step.

    Raises `HarnessError`: they were drawn from shells, each with a probability of its own.
    """
    if "n" not in made.result:
        found = "tests drawn from shells, of which each has its own probability"
        expected = "tests that can be averaged: drawn by nde, forced, step_mixture or episode_mixture"
        raise HarnessError(str(made.folder), found, expected, "Name another step.")
    n, table = made.result["n"], read_table(made.folder / CRASHES)
    weights = n * made.result["figures"]["mean_weight"]["value"]
    return Tests(n, weights, *(table.column(name).to_numpy() for name in Tests._fields[2:]))


def settled(made: Made) -> bool:
    """Whether the crash rate of a step means something."""
    return is_settled(made.result["figures"]["crash_rate"])


def crash_rate(tests: Tests, confidence: float) -> dict[str, Any]:
    """Mean of Y with the paper's normal interval; of tests without weights with that of Clopper and Pearson."""
    y, n = tests.y, tests.n
    rate = float(y.sum()) / n
    if np.all(y == 1.0):
        low, high = map(float, clopper_pearson(len(y), n, (1.0 - confidence) / 2.0))
        return figure(rate, low, high)
    half = Level.two_sided(confidence).z * float(np.sqrt(max(float(y @ y) / n - rate * rate, 0.0) / max(n - 1, 1)))
    return figure(rate, max(rate - half, 0.0), rate + half)


def relative_variance(tests: Tests) -> dict[str, Any]:
    """Var(Y)/μ² per test, with two standard errors from leaving out one of 20 groups of tests at a time.

    What rare large weights not seen yet would add is in neither.
    """
    y = tests.y
    group = np.minimum(tests.episode * GROUPS // tests.n, GROUPS - 1)
    sums = np.array([np.bincount(group, weights=power, minlength=GROUPS) for power in (y, y * y)])
    every = sums.sum(axis=1, keepdims=True)
    total, squares = np.hstack([every, every - sums])
    n = np.append(tests.n, np.full(GROUPS, tests.n * (GROUPS - 1) / GROUPS))
    value, *left = np.divide(n * squares, total * total, out=np.full(1 + GROUPS, np.nan), where=total > 0.0) - 1.0
    error = 2.0 * float(np.std(left)) * np.sqrt(GROUPS - 1)
    return figure(value, max(value - error, 0.0), value + error)
