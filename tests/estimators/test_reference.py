"""Beside a reference driver: against the definition, identities, and coverage by enumeration and by replication."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.optimize import brentq

from harness.estimators.likelihood import Level, likelihood_limit
from harness.estimators.shells import preventable_share, rate_ratio_limits
from harness.estimators.tally import Tally

from .exact import coverage, tilted
from .small_blocks import EXACT, tally

LEVEL = Level.two_sided(0.9)
FEW = Level(2.6, 1e6)
"""The threshold for few crashes always holds."""
P = np.array([1e-7, 3e-7, 2e-6])


@pytest.mark.parametrize("crashes", [(5, 9, 0), (0, 0, 0)])
def test_the_ratio_to_a_known_rate_is_the_rate_over_it(crashes):
    found = tally(P, crashes, (10, 20, 300))
    low, high = (likelihood_limit(P, found.crashes, found.tests, LEVEL, side) / 2e-7 for side in (-1.0, 1.0))
    ratio = rate_ratio_limits(P, found, np.zeros(3), (2e-7, 4e-14), EXACT, LEVEL)
    assert ratio == pytest.approx((low, high), rel=1e-6)
    assert (ratio[0] == 0.0) == (sum(crashes) == 0)


def test_the_reference_itself_is_as_often_as_itself_whatever_the_pool():
    """It crashes on all cut-ins of its cells: the error of the pool cancels where both crash on the same paths."""
    mass = np.random.default_rng(1).exponential(P[:1], 4_000)
    crashed = mass[np.random.default_rng(2).choice(4_000, 1_000_000, p=mass / mass.sum())]
    found = Tally(*(np.array([x]) for x in (1_000_000, 1_000_000, 0)), crashed.sum()[None, None], np.zeros((1, 1)))
    p, square = mass.mean(), (mass**2).mean()
    alone = rate_ratio_limits(np.array([p]), found, np.zeros(1), (p, p * p), 4_000, LEVEL)
    beside = rate_ratio_limits(np.array([p]), found, np.array([crashed.sum()]), (p, square), 4_000, LEVEL)
    assert alone[1] - alone[0] > 0.04
    assert beside == pytest.approx((1.0, 1.0), abs=2e-3)


def least_cost(p, k, n, prevented, y):
    """Σ n KL at the shares nearest to those seen that have this share of crashes in the prevented cells."""
    weights, how = p * (prevented - y) / p.max(), {"xtol": 1e-14, "rtol": 1e-15, "maxiter": 1000}
    off = brentq(lambda nu: weights @ tilted(nu * weights / n, k, n)[0], -1e5, 1e5, **how)
    return tilted(off * weights / n, k, n)[1]


@pytest.mark.parametrize(("k", "n"), [((6, 9, 3), (40, 30, 200)), ((1, 20, 5), (25, 30, 400))])
def test_the_preventable_shares_are_those_that_some_crash_shares_explain(k, n):
    k, n, prevented = np.array(k), np.array(n), np.array([True, False, True])
    share, low, high = preventable_share(P, tally(np.zeros(3), k, n), prevented, EXACT, FEW)
    both = P * k / n
    assert share == pytest.approx(both[prevented].sum() / both.sum())
    assert low < share < high
    for limit in (low, high):
        assert least_cost(P, k, n, prevented, limit) == pytest.approx(FEW.threshold, rel=1e-5)


def test_a_share_stays_a_share():
    def found(crashes, tests):
        return preventable_share(P, tally(P, crashes, tests), np.array([True, False, True]), EXACT, LEVEL)

    assert found((0, 0, 0), (10, 10, 10))[1:] == (0.0, 1.0)
    share, low, high = found((9, 0, 9), (10, 50, 10))
    assert 0.5 < low < share == high == 1.0
    share, low, high = found((0, 45, 0), (90, 50, 900))
    assert share == low == 0.0 < high < 0.05


def test_failed_tests_count_as_whatever_is_worse():
    def found(crashes, failed=0):
        counts = tally(P[:2], crashes, (20, 30), failed)
        return preventable_share(P[:2], counts, np.array([True, False]), EXACT, LEVEL)

    plain, failed = found((8, 9)), found((8, 9), (3, 4))
    assert failed[0] == plain[0]
    for crashes in product(range(8, 12), range(9, 14)):
        _, low, high = found(crashes)
        assert failed[1] <= low + 1e-9
        assert high <= failed[2] + 1e-9
    assert failed[1] < plain[1] < plain[2] < failed[2]


@pytest.mark.parametrize("share", [(0.9, 0.4, 0.0), (0.3, 0.1, 0.01), (0.02, 0.9, 0.05)])
def test_the_preventable_share_is_held_often_enough_whatever_the_counts(share):
    """Known answers: coverage summed over outcomes, nominal 0.90; and too narrow a level does not hold it."""
    tests, prevented, true = (8, 9, 14), np.array([True, False, True]), P * share
    truth = true[prevented].sum() / true.sum()

    def covered(level):
        def limits(counts):
            return preventable_share(P, tally(P, counts[:, 0], tests), prevented, EXACT, level)[1:]

        return coverage([(each,) for each in share], tests, truth, limits)

    assert covered(LEVEL) >= 0.90
    assert covered(Level(0.3, 0.5)) < 0.85
