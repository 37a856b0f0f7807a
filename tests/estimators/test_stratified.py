"""Likelihood-ratio limits: against the definition, by identities, and by their coverage."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.special import betaincinv, xlogy
from scipy.stats import binom

from harness.estimators.limit_search import Level
from harness.estimators.stratified import likelihood_limit

COUNTS = st.lists(
    st.tuples(st.floats(0.01, 100.0), st.integers(0, 60), st.integers(0, 60)).map(
        lambda t: (t[0], min(t[1:]), max(t[1:]))
    ),
    min_size=1,
    max_size=6,
)
"""Weight, crashes, tests of each stratum."""
MANY = 1e6
"""A quantile so large that the threshold for few crashes always holds."""


def both(weights, crashes, tests, level, variance=0.0):
    w, k, n = np.array(weights, float), np.array(crashes), np.array(tests)
    return tuple(likelihood_limit(w, k, n, level, side, variance) for side in (-1.0, 1.0))


def divergence(share, other):
    return xlogy(share, share) - xlogy(share, other) + xlogy(1 - share, 1 - share) - xlogy(1 - share, 1 - other)


@pytest.mark.parametrize(("crashes", "tests"), [(0, 20), (1, 20), (7, 20), (20, 20)])
def test_limits_of_one_stratum_are_where_the_divergence_meets_the_threshold(crashes, tests):
    level = Level(2.6, MANY)
    low, high = both([1.0], [crashes], [tests], level)
    for limit, at_end in ((low, crashes == 0), (high, crashes == tests)):
        if at_end:
            assert limit == pytest.approx(crashes / tests, abs=1e-12)
        else:
            assert tests * divergence(crashes / tests, limit) == pytest.approx(level.threshold, rel=1e-9)


def test_the_limit_is_the_largest_sum_that_shares_within_the_threshold_give():
    w, k, n, level = np.array([3.0, 1.0, 0.2]), np.array([1, 0, 9]), np.array([40, 90, 10]), Level(2.6, MANY)
    allowed = {"type": "ineq", "fun": lambda x: level.threshold - (n * divergence(k / n, x)).sum()}
    for side in (-1.0, 1.0):
        found = minimize(
            lambda x, s=side: -s * w @ x, [0.03, 0.005, 0.9], bounds=[(1e-9, 1 - 1e-9)] * 3, constraints=allowed
        )
        assert likelihood_limit(w, k, n, level, side) == pytest.approx(w @ found.x, rel=2e-4)


def test_without_a_crash_the_one_sided_bound_is_the_exact_one():
    bound = likelihood_limit(np.ones(1), np.zeros(1, int), np.array([50]), Level.one_sided(0.95, 50), 1.0)
    assert bound == pytest.approx(betaincinv(1, 50, 0.95), rel=1e-9)


@given(COUNTS, st.sampled_from([0.9, 0.95, 0.99]), st.floats(0.0, 0.1))
@settings(deadline=None)
def test_identities(counts, confidence, relative):
    w, k, n = (np.array(column) for column in zip(*counts, strict=True))
    level, variance = Level.two_sided(confidence), relative * float(w @ w)
    low, high = both(w, k, n, level, variance)
    rate, slack = float(w @ (k / np.maximum(n, 1))), 1e-9 * float(w.sum())
    assert low - slack <= rate if n.all() else low <= high
    assert high + slack >= rate
    assert both(5.0 * w, k, n, level, 25.0 * variance) == pytest.approx((5.0 * low, 5.0 * high), rel=1e-6, abs=slack)
    assert both(-w, k, n, level, variance) == pytest.approx((-high, -low), rel=1e-6, abs=slack)
    one_more = np.minimum(k + np.eye(len(n), dtype=int)[0], n)
    more_low, more_high = both(w, one_more, n, level, variance)
    assert more_low >= low - slack
    assert more_high >= high - slack


def test_a_stratum_without_a_test_may_crash_always():
    low, high = both([1.0, 0.5], [10, 0], [100, 0], Level.two_sided(0.9))
    alone = both([1.0], [10], [100], Level.two_sided(0.9))
    assert (low, high) == pytest.approx((alone[0], alone[1] + 0.5))


def test_an_error_of_the_weights_alone_gives_the_normal_interval():
    level = Level.two_sided(0.9)
    many = 10**12
    low, high = both([1.0], [many // 4], [many], level, variance=0.01)
    assert (low, high) == pytest.approx((0.25 - 1.6449 * 0.1, 0.25 + 1.6449 * 0.1), abs=2e-3)


def coverage(share, tests, weights, limits):
    """Exact, over all pairs of counts that are likely enough to matter."""
    truth = float(np.dot(weights, share))
    chances = [binom.pmf(np.arange(n + 1), n, x) for n, x in zip(tests, share, strict=True)]
    covered = 0.0
    for a in np.flatnonzero(chances[0] > 1e-7):
        for b in np.flatnonzero(chances[1] > 1e-7):
            low, high = limits([int(a), int(b)], tests, weights)
            covered += chances[0][a] * chances[1][b] * (low <= truth * (1 + 1e-9) and truth <= high * (1 + 1e-9))
    return covered


def squares(confidence):
    """Separate exact limits, their distances combined by squares: what these limits took the place of."""

    def limits(crashes, tests, weights):
        k, n, w, tail = np.array(crashes), np.array(tests), np.array(weights), (1 - confidence) / 2
        low = np.where(k > 0, betaincinv(np.maximum(k, 0.5), n - k + 1, tail), 0.0)
        high = np.where(k < n, betaincinv(k + 1.0, np.maximum(n - k, 0.5), 1 - tail), 1.0)
        c = k / n
        return w @ c - math.sqrt(((w * (c - low)) ** 2).sum()), w @ c + math.sqrt(((w * (high - c)) ** 2).sum())

    return limits


RARE = [
    ((1.3 / 40, 1.7 / 40), (40, 40), (1.0, 1.0)),
    ((0.12, 0.004), (30, 400), (1.0, 12.0)),
    ((0.9, 0.02), (20, 60), (1.0, 2.0)),
]


@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.99])
@pytest.mark.parametrize(("share", "tests", "weights"), RARE)
def test_limits_cover_where_few_crashes_decide(confidence, share, tests, weights):
    level = Level.two_sided(confidence)
    assert coverage(share, tests, weights, lambda k, n, w: both(w, k, n, level)) >= confidence


def test_eight_strata_with_few_crashes_each_at_99_percent():
    """4,000 replications: 0.0042 is three standard errors at 0.99, so that 1.6 % fewer tell squares apart."""
    rng, shells, tests, expected = np.random.default_rng(11), 8, 100, 1.6
    weights, counts = np.ones(shells), np.full(shells, tests)
    crashes = rng.binomial(tests, expected / tests, (4_000, shells))
    truth = shells * expected / tests

    def covered(limits):
        found = [limits(k, counts, weights) for k in crashes]
        return np.mean([low <= truth <= high for low, high in found])

    assert covered(lambda k, n, w: both(w, k, n, Level.two_sided(0.99))) >= 0.99 - 0.0042
    assert covered(squares(0.99)) < 0.98
