"""Pairs of several scenarios: limits of one likelihood ratio over the strata of all, and how often they hold."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.estimators.likelihood import Level
from harness.estimators.pairs import A_CRASHES, B_CRASHES, DIFFERENCE, Pairs, contrast, no_pairs
from tests.estimators.test_paired_shells import PAIRS, pairs_of
from tests.estimators.test_sign import DESIGN as EXACT
from tests.estimators.test_sign import ENDS, population

LEVEL = Level.two_sided(0.9)
OTHER = pairs_of((3, 0, 9, 8), (1, 2, 3, 44), (0, 0, 1, 900), mass=1e-9)


def numbers(found):
    return np.array([found[key] for key in ("difference", "ci_low", "ci_high", "ratio", "ratio_low", "ratio_high")])


def test_one_scenario_that_is_met_once_an_hour_is_itself():
    found = contrast(Pairs(OTHER.each, (1.0,)), LEVEL)
    assert found == contrast(OTHER, LEVEL)
    tenfold = numbers(contrast(Pairs(OTHER.each, (10.0,)), LEVEL))
    assert tenfold == pytest.approx(numbers(found) * [10, 10, 10, 1, 1, 1], rel=1e-6)


def test_the_sum_is_that_of_all_strata_and_narrower_than_limits_added_up():
    both = Pairs((*PAIRS.each, *OTHER.each), (2.0, 5.0))
    found, alone = both.difference(LEVEL), [each.difference(LEVEL) for each in (PAIRS, OTHER)]
    assert found.value == pytest.approx(2.0 * alone[0].value + 5.0 * alone[1].value)
    low, high = (2.0 * alone[0][end] + 5.0 * alone[1][end] for end in (1, 2))
    assert low < found.ci_low < found.value < found.ci_high < high
    assert Pairs((*OTHER.each, *PAIRS.each), (5.0, 2.0)).difference(LEVEL) == pytest.approx(found)
    assert both.rate(A_CRASHES) / both.rate(B_CRASHES) == both.ratio(LEVEL).value


def test_what_is_not_known_of_an_event_s_probability_widens_the_sum():
    design = replace(OTHER.each[0].design, p_event=1e-5, p_event_se=2e-6)  # to 20 %
    unsure = Pairs((OTHER.each[0]._replace(design=design),), (3.0,))
    sure = Pairs(OTHER.each, (3.0,))
    more = unsure.pool_variance(DIFFERENCE) - sure.pool_variance(DIFFERENCE)
    assert more == pytest.approx((0.2 * sure.rate(DIFFERENCE)) ** 2)
    assert unsure.difference(LEVEL).half_width > sure.difference(LEVEL).half_width


def test_the_reference_is_that_of_all_scenarios():
    (one,) = no_pairs(EXACT).each
    wide = replace(EXACT, n_paths=100, reference_square=np.array([2e-14]), p_event_se=0.1 * EXACT.p_event)
    other = one._replace(design=wide)
    assert Pairs((one,), (4.0,)).reference == pytest.approx((4e-7, 0.0))
    rate, error = Pairs((one, other), (1.0, 4.0)).reference
    assert rate == pytest.approx(5e-7)
    assert error == pytest.approx(4.0 * np.hypot(1e-8, 1e-8))  # of 100 paths, and of the events' probability
    assert Pairs((one._replace(design=EXACT.without_references()),), (1.0,)).reference is None


SHARES = (
    population({"a": 0.8, "b": 0.2}, {"b": 0.3, "c": 0.1}, {"a": 0.1}),
    population({"b": 0.1, "c": 0.2}, {"d": 0.1, "f": 0.05}, {"e": 0.3}),
)
TESTS = np.array([200, 200, 300, 300, 400, 2_000, 50_000_000])
PER_HOUR = (3.0, 1.0)
RATES = [
    sum(n * float(EXACT.p @ of @ side) for n, of in zip(PER_HOUR, SHARES, strict=True))
    for side in (A_CRASHES, B_CRASHES)
]


def test_intervals_hold_as_often_as_they_say():
    """Of difference and ratio, at 90 %, in 100 draws; those of one scenario alone do not hold the sum's."""
    rng, n, held, of_one = np.random.default_rng(5), 100, np.zeros(2, int), 0
    for _ in range(n):
        each = []
        for shares in SHARES:
            (pairs,) = no_pairs(EXACT).each
            for end, drawn in zip(ENDS, rng.multinomial(TESTS, shares).T, strict=True):
                pairs.ends[:, *end] += drawn
            each.append(pairs)
        both = Pairs(tuple(each), PER_HOUR)
        difference, ratio = both.difference(LEVEL), both.ratio(LEVEL)
        held += [
            difference.ci_low <= RATES[0] - RATES[1] <= difference.ci_high,
            ratio.ci_low <= RATES[0] / RATES[1] <= ratio.ci_high,
        ]
        low, high = (PER_HOUR[0] * end for end in Pairs((each[0],)).difference(LEVEL)[1:])
        of_one += low <= RATES[0] - RATES[1] <= high
    for each_held in held.tolist():
        assert binomtest(each_held, n, 0.9, alternative="less").pvalue > 1e-3
    assert binomtest(int(of_one), n, 0.9, alternative="less").pvalue < 1e-6
