"""Failed tests: no crash in rate and lower limit, crashes in every upper limit, for every estimator."""

from dataclasses import replace

import numpy as np
import pytest

from harness.estimators.block import Block, joined
from harness.estimators.one_pass import ACCUMULATORS, one_pass
from harness.vocabulary import FAILED, TIMEOUT
from studies.chains.chain import overtaking
from studies.chains.sampler import blocks
from studies.rnot import Procedure, plain_rhw, scv_rhw
from tests.chains.seed import SEED
from tests.estimators.small_blocks import block, fed, in_shells

CHAIN = overtaking("short", skill=0.5, surrogates=[0.5, 0.2, 0.8], level=0.02, horizon=5)
METHOD = {"nde": "nde", "nade": "forced", "mixture_cv": "episode_mixture"}


def some_failed(parts: list[Block], share: float = 0.5, *, first: int = 1) -> list[Block]:
    """The blocks with a share of the crashes failed instead, from block ``first`` on."""
    rng = np.random.default_rng(SEED)
    changed = []
    for k, part in enumerate(parts):
        failed = part.crash & (rng.random(len(part)) < share) & (k >= first)
        changed.append(part.ending(failed, FAILED))
    return changed


def drawn(name: str) -> list[Block]:
    if name == "shells":
        rng = np.random.default_rng(SEED)
        shares = np.array([0.8, 0.3, 0.02])
        parts = []
        for k in range(4):
            strata = rng.integers(0, 3, 200)
            crash = rng.random(200) < shares[strata]
            parts.append(in_shells(strata.tolist(), crash.tolist(), first=200 * k))
        return parts
    size = 20_000 if name == "nde" else 1_000
    return list(blocks(CHAIN, METHOD.get(name, "step_mixture"), [size] * 4, SEED))


@pytest.mark.parametrize("name", ACCUMULATORS)
def test_lower_ends_without_upper_ends_with_the_failed_tests(name):
    parts = some_failed(drawn(name))
    found = one_pass(parts, (name,)).estimates[name]
    as_safe = [part.ending(part.failed, TIMEOUT) for part in parts]
    seen = fed(ACCUMULATORS[name](), as_safe).result(0.9)
    worst = fed(ACCUMULATORS[name](), [part.failed_as_crashes() for part in parts]).result(0.9)
    assert (found.crash_rate, found.std_error, found.ci_low) == (seen.crash_rate, seen.std_error, seen.ci_low)
    assert (found.n_crashes, found.n_effective) == (seen.n_crashes, seen.n_effective)
    assert (found.ci_high, found.upper_bound) == (worst.ci_high, worst.upper_bound)
    assert found.ci_high > seen.ci_high
    assert found.rhw == (worst.ci_high - seen.ci_low) / 2.0 / seen.crash_rate
    assert found.details["crash_rate_if_failed_had_crashed"] == worst.crash_rate
    assert found.details["n_failed"] == sum(int(part.failed.sum()) for part in parts)
    assert any("episodes failed" in warning for warning in found.warnings)


@pytest.mark.parametrize("name", ACCUMULATORS)
def test_nothing_changes_where_nothing_fails(name):
    parts = drawn(name)
    found, seen = one_pass(parts, (name,)).estimates[name], fed(ACCUMULATORS[name](), parts).result(0.9)
    none = {"n_failed": 0, "crash_rate_if_failed_had_crashed": seen.crash_rate}
    assert found == replace(seen, details={**none, **seen.details})


def test_a_failed_test_has_the_weight_that_it_had():
    some = block([True, False, False], [-2.0, -1.0, 0.0], failed=[False, True, False])
    assert one_pass([some], ("nade",)).headline_estimate.details["crash_rate_if_failed_had_crashed"] == pytest.approx(
        (np.exp(-2.0) + np.exp(-1.0)) / 3.0
    )


def test_required_numbers_of_tests_grow_with_failures():
    whole = joined(some_failed(list(blocks(CHAIN, "step_mixture", [500] * 4, SEED)), first=0))
    counted = whole.crash | whole.failed
    weights = np.exp(whole.log_weight[counted])
    procedure = Procedure(n_shuffles=3, first=200, ratio=2.0)
    with_failed = plain_rhw(weights, len(whole), procedure, failed=whole.failed[counted])
    without = plain_rhw(np.where(whole.failed[counted], 0.0, weights), len(whole), procedure)
    assert np.all(with_failed[:, -1] > 1.5 * without[:, -1])
    forgotten = whole.ending(whole.failed, TIMEOUT)
    assert np.all(scv_rhw(whole, procedure)[:, -1] > scv_rhw(forgotten, procedure)[:, -1])
