"""Pairs within shells: their counts, limits both ways of failed tests, what the pool's error adds, and the verdict."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.estimators.likelihood import Level
from harness.estimators.pairs import (
    A_CRASHES,
    B_CRASHES,
    CRASH,
    DIFFERENCE,
    FAILED,
    NO_CRASH,
    PairCounts,
    PairedShells,
    Pairs,
    contrast,
    no_pairs,
    paired_estimate,
)
from tests.estimators.small_blocks import RARE as DESIGN
from tests.estimators.small_blocks import SHELLS, in_shells
from tests.estimators.test_sign import DESIGN as EXACT
from tests.estimators.test_sign import ENDS, population

LEVEL = Level.two_sided(0.9)


def pairs_of(*strata, mass=0.0):
    """Counts of both, only A, only B, neither for each stratum; ``mass`` of every path in its own stratum."""
    (own,) = (pairs := no_pairs(DESIGN)).each
    for s, counts in enumerate(strata):
        for (a, b), n in zip(((1, 1), (1, 0), (0, 1), (0, 0)), counts, strict=True):
            own.ends[s, a, b] += n
            own.mass[s, a, b, s] += n * mass
    return pairs


PAIRS = pairs_of((30, 10, 2, 8), (0, 5, 0, 45), (0, 0, 0, 4000))


def test_rates_are_those_of_each_and_intervals_hold_what_was_seen():
    found = paired_estimate(PAIRS, 0.9)
    a, b = (found[side]["crash_rate"] for side in "ab")
    assert (a, b) == pytest.approx((1e-7 * 0.8 + 2e-7 * 0.1, 1e-7 * 0.64))
    assert found["difference"] == pytest.approx(a - b)
    assert found["only_a"]["value"] - found["only_b"]["value"] == pytest.approx(found["difference"])
    assert found["ratio"] == pytest.approx(a / b)
    assert [found[key] for key in ("n_pairs", "n_only_a", "n_only_b")] == [4100, 15, 2]
    free, inside = found, found["conditional"]
    assert (inside["n_pairs"], inside["n_pairs_outside"], inside["refuted"]) == (100, 4000, False)
    assert free["ci_low"] < inside["ci_low"] < free["difference"] < inside["ci_high"] < free["ci_high"]
    assert free["ratio_low"] < inside["ratio_low"] < free["ratio"] < inside["ratio_high"] < free["ratio_high"]
    assert 0.0 < free["only_a"]["ci_low"] < free["only_a"]["value"] < free["only_a"]["ci_high"]
    # What was not seen outside, in 4,000 tests, may be 2.6 of 4,000 on either side.
    assert free["ci_high"] - inside["ci_high"] < 3e-5 * 2.6 / 4000


def test_failed_tests_widen_both_ways():
    """A fails 3 times where B does not crash, B twice where A does."""
    failed = pairs_of((30, 8, 2, 5), (0, 5, 0, 45), (0, 0, 0, 4000))
    failed.each[0].ends[0, FAILED, NO_CRASH] = 3
    failed.each[0].ends[0, CRASH, FAILED] = 2
    worst_a = pairs_of((30, 13, 2, 5), (0, 5, 0, 45), (0, 0, 0, 4000))
    worst_b = pairs_of((32, 8, 2, 8), (0, 5, 0, 45), (0, 0, 0, 4000))
    found = failed.difference(LEVEL)
    assert found.ci_high == pytest.approx(worst_a.difference(LEVEL).ci_high)
    assert found.ci_low == pytest.approx(worst_b.difference(LEVEL).ci_low)
    ratio = failed.ratio(LEVEL)
    assert ratio.ci_high == pytest.approx(worst_a.ratio(LEVEL).ci_high)
    assert ratio.ci_low == pytest.approx(worst_b.ratio(LEVEL).ci_low)
    estimate = paired_estimate(failed, 0.9)
    assert [estimate[side]["details"]["n_failed"] for side in "ab"] == [3, 2]
    assert estimate["shells"][0]["n_failed_tests"] == 5


def test_the_pool_adds_the_error_of_pairs_that_differ():
    """One stratum, every path of mass m in it: the variance of p·c has E[x²] = p c m, and cuts-ins of both cancel."""
    mass, n_paths = 4e-4, 10**9
    only = pairs_of((0, 40, 0, 60), mass=mass)
    expected = (1e-7 * 0.4 * mass - (1e-7 * 0.4) ** 2) / n_paths
    assert only.pool_variance(A_CRASHES - B_CRASHES) == pytest.approx(expected)
    both = pairs_of((40, 0, 0, 60), mass=mass)
    assert both.pool_variance(A_CRASHES - B_CRASHES) == 0.0
    assert both.pool_variance(A_CRASHES) == pytest.approx(expected)
    each = pairs_of((0, 40, 40, 20), mass=mass)
    assert each.pool_variance(A_CRASHES - B_CRASHES) == pytest.approx(2 * 1e-7 * 0.4 * mass / n_paths, rel=1e-3)


def test_a_margin_is_where_the_ratio_ends():
    low, high = PAIRS.ratio(LEVEL)[1:]
    for factor, verdict in ((1.001, "proven"), (0.999, "open")):
        assert PAIRS.verdict(factor / low - 1.0, LEVEL) == verdict
    assert PAIRS.verdict(1.001 / high - 1.0, LEVEL) == "open"
    (own,) = PAIRS.each
    swapped = Pairs((PairCounts(DESIGN, own.ends.transpose(0, 2, 1), own.mass.transpose(0, 2, 1, 3)),))
    assert swapped.within().verdict(0.1, LEVEL) == "refuted"


def test_equal_vehicles_are_not_told_apart_and_json_has_no_infinity():
    found = paired_estimate(pairs_of((0, 0, 0, 50), (0, 0, 0, 50), (0, 0, 0, 400)), 0.9)
    assert found["ci_low"] < 0.0 < found["ci_high"]
    assert found["ratio"] is None
    content = json.loads(json.dumps(found, allow_nan=False))
    assert content["ratio_high"] is None
    assert content["only_a"]["ci_low"] == 0.0


def test_the_ith_test_of_a_stratum_belongs_to_the_ith_of_the_other_whatever_the_shards():
    rng = np.random.default_rng(4)
    stratum = np.sort(rng.integers(0, 3, 40))
    a, b = rng.random((2, 40)) < 0.5
    pairs = PairedShells(SHELLS)
    for side, crash, edges in ((0, a, (0, 7, 40)), (1, b, (0, 20, 33, 40))):
        for first, end in pairwise(edges):
            pairs.add(side, in_shells(stratum[first:end].tolist(), crash[first:end].tolist(), first=first))
    n = np.minimum(pairs.tests(0), 9)
    counted = pairs.first(n)
    for s in range(3):
        first = np.flatnonzero(stratum == s)[:9]
        assert counted.ends[s, CRASH, NO_CRASH] == np.count_nonzero(a[first] & ~b[first])
        assert counted.ends[s, CRASH, CRASH] == np.count_nonzero(a[first] & b[first])
    assert counted.tests.tolist() == n.tolist()


def test_a_crash_of_either_outside_refutes_the_assumption():
    found = paired_estimate(pairs_of((30, 10, 2, 8), (0, 5, 0, 45), (0, 0, 1, 3999)), 0.9)
    assert found["conditional"]["refuted"] is True


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
