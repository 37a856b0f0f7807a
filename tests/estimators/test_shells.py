"""Shells: limits of the weighted sum; counts that merge; statements that say what they rest on."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from harness.estimators import Estimate, one_pass
from harness.estimators.likelihood_ratio import Level, likelihood_limit
from harness.estimators.shells import combined, pool_variance
from harness.estimators.statement import conditional_statement, statement

from .small_blocks import SHELLS, in_shells

P = SHELLS.p
EXACT = SHELLS.moments
"""Second moments of a pool that is known exactly."""


def shells_estimate(*rows: tuple[int, int, int, int], **settings) -> Estimate:
    """From rows of (stratum, crashes, failed tests, further tests)."""
    strata = np.repeat([stratum for stratum, *_ in rows], [sum(counts) for _, *counts in rows])
    end = np.concatenate([np.repeat(["crash", "failed", "passed"], counts) for _, *counts in rows])
    block = in_shells(strata, end == "crash", end == "failed")
    return one_pass([replace(block, **settings)], ("shells",)).headline_estimate


LEVEL = Level.two_sided(0.9)


def test_limits_without_an_error_of_the_pool_are_those_of_the_likelihood_ratio():
    crashes, tests, failed = np.array([5, 0, 0]), np.array([10, 10, 100]), np.array([1, 0, 2])
    limits = combined(P, crashes, tests, EXACT, 10**9, LEVEL, failed)
    assert limits.rate == pytest.approx(5e-5)
    assert limits.low == pytest.approx(likelihood_limit(P, crashes, tests, LEVEL, -1.0), rel=1e-6)
    assert limits.high == pytest.approx(likelihood_limit(P, crashes + failed, tests, LEVEL, 1.0), rel=1e-6)


def test_an_untested_stratum_may_hold_anything():
    limits = combined(P, np.array([5, 5, 0]), np.array([10, 10, 0]), EXACT, 10**9, LEVEL)
    assert limits.high >= P[2]


def test_the_error_of_the_pool_widens_the_interval():
    crashes, tests = np.array([5, 5, 5]), np.array([10, 10, 10])
    moments = np.diag(P * P) * 50.0
    exact = combined(P, crashes, tests, EXACT, 10**9, LEVEL)
    rough = combined(P, crashes, tests, moments, 100, LEVEL)
    assert rough.rate == exact.rate
    assert rough.high - rough.rate > 1.5 * (exact.high - exact.rate)


def test_the_variance_of_the_pool_bounds_that_of_vehicles_that_do_not_favour_heavy_paths():
    """Paths of a made-up pool; vehicles that crash on whole paths, on parts of them, or here and there."""
    rng = np.random.default_rng(3)
    n = 200_000
    mass = rng.exponential(size=(n, 3)) * P * (rng.random((n, 1)) < 0.2) * 5.0
    moments = mass.T @ mass / n
    for share in (np.array([1.0, 0.5, 0.0]), np.array([0.9, 0.3, 0.01]), np.array([1.0, 1.0, 1.0])):
        on_paths = np.where(rng.random((n, 1)) < share, mass, 0.0).sum(1)
        thinned = (mass * share).sum(1)
        nested = np.where(rng.random((n, 1)) < share[None, :], mass, 0.0).sum(1)
        rate = float(P @ share)
        bound = pool_variance(share, moments, rate, n)
        for crash_mass in (on_paths, thinned, nested):
            assert crash_mass.var() / n <= bound * 1.03  # the bound is itself estimated from the paths


def test_a_vehicle_that_favours_heavy_paths_may_exceed_it():
    """What the bound assumes is needed."""
    rng = np.random.default_rng(3)
    n = 200_000
    mass = rng.exponential(size=(n, 1))
    heavy = np.where(mass > np.quantile(mass, 0.99), mass, 0.0).sum(1)
    share = np.array([heavy.mean()])
    assert heavy.var() / n > 1.3 * pool_variance(share, mass.T @ mass / n, heavy.mean(), n)


def test_what_lies_outside_nothing_is_said_to_be_nothing():
    all_inside = replace(SHELLS, n_inside=3, boundary="outermost")
    estimate = shells_estimate((0, 9, 0, 0), (1, 0, 0, 9), (2, 0, 0, 9), shells=all_inside)
    assert conditional_statement(estimate).endswith("Nothing lies outside.")
    assert estimate.details["conditional"]["rhw"] == estimate.rhw


def test_failed_tests_outside_are_not_taken_for_safe_ones():
    estimate = shells_estimate((0, 8, 2, 0), (2, 0, 4, 396))
    conditional = estimate.details["conditional"]
    assert (conditional["n_failed"], conditional["n_failed_outside"]) == (2, 4)
    assert conditional["crash_rate_if_failed_had_crashed"] == pytest.approx(1e-4)
    assert conditional["upper_bound_outside"] == pytest.approx(
        likelihood_limit(P[2:], np.array([4]), np.array([400]), Level.one_sided(0.9, 400), 1.0)
    )
    text = conditional_statement(estimate)
    assert "2 FAILED: they count as no crash in the rate and as crashes in the upper limit. Had they all cras" in text
    assert "the rate would be 0.0001." in text
    assert "no crash in 400 tests outside, but 4 of them FAILED and are counted as crashes here: with" in text


def test_two_statements():
    strata = [0] * 10 + [1] * 20 + [2] * 400
    crash = [True] * 8 + [False] * 2 + [True] * 3 + [False] * 417
    found = one_pass([in_shells(strata, crash)], ("shells", "nade", "nde")).estimates
    estimate = found["shells"]
    assert isinstance(estimate, Estimate)
    assert estimate.crash_rate == pytest.approx(0.8e-4 + 0.15 * 3e-4)
    conditional = estimate.details["conditional"]
    assert conditional["crash_rate"] == pytest.approx(estimate.crash_rate)
    assert conditional["ci_high"] < estimate.ci_high
    assert conditional["n_episodes"] == 30
    assert conditional["upper_bound_outside"] == pytest.approx(2e-2 * -np.expm1(np.log(0.1) / 400))
    assert not conditional["refuted"]
    text = conditional_statement(estimate)
    assert "careless" in text
    assert "There was no crash in 400 tests outside" in text
    assert sum(shell["contribution"] for shell in estimate.details["shells"]) == pytest.approx(estimate.crash_rate)
    json.dumps(estimate.to_json(), allow_nan=False)
    assert "within shells" in found["nade"].reason
    assert "nde" in found["nde"].reason


def test_a_half_width_far_wider_than_the_rate_is_no_number():
    """Nothing was tested outside: all of its probability may be crashes."""
    estimate = shells_estimate((0, 10, 0, 0), (1, 0, 0, 20))
    assert estimate.rhw > 10.0
    text = statement(estimate, 1.0, None)
    assert f"to {estimate.ci_high:.3g}, still open upwards: far wider than the rate)" in text
    assert "half-width" not in text
    assert "relative half-width 50.0%)" in statement(replace(estimate, rhw=0.5), 1.0, None)


def test_a_crash_outside_refutes_the_assumption():
    estimate = shells_estimate((0, 1, 0, 0), (1, 0, 0, 1), (2, 1, 0, 1))
    assert estimate.details["conditional"]["refuted"]
    assert "crashed 1 times where the surrogate careless does not crash" in conditional_statement(estimate)
    assert any("does not hold" in warning for warning in estimate.warnings)


def test_others_are_refused():
    other = replace(in_shells([0], [True]), method="nde", shells=None)
    assert "testing.method shells" in one_pass([other], ("shells",)).estimates["shells"].reason


def coverage(tests: np.ndarray, share: np.ndarray) -> float:
    """Exact probability that the interval covers, by summing over all outcomes of three strata."""
    truth, covered = float(P @ share), 0.0
    for crashes in itertools.product(*(range(n + 1) for n in tests)):
        chance = np.prod(binom.pmf(crashes, tests, share))
        if chance > 1e-9:
            limits = combined(P, np.array(crashes), tests, EXACT, 10**9, LEVEL)
            covered += chance * (limits.low <= truth * (1 + 1e-12) and truth <= limits.high * (1 + 1e-12))
    return float(covered)


@pytest.mark.parametrize("share", [(1.0, 0.3, 0.0), (0.6, 0.1, 0.002), (0.9, 0.5, 0.1)])
def test_the_interval_covers_exactly_enough(share):
    """Known answers: coverage summed over all outcomes, nominal 0.90."""
    assert coverage(np.array([12, 12, 30]), np.array(share)) >= 0.90


def test_without_the_empty_stratum_it_does_not():
    """The sibling that must fail: a stratum that was tested without a crash is left out of the limits."""
    tests, share = np.array([12, 12, 30]), np.array([1.0, 0.3, 0.02])
    without = P * [1.0, 1.0, 0.0]
    truth, covered = float(P @ share), 0.0
    for b in range(13):
        limits = combined(without, np.array([12, b, 0]), tests, EXACT, 10**9, LEVEL)
        covered += binom.pmf(b, 12, 0.3) * (limits.low <= truth <= limits.high)
    assert covered < 0.5
