"""Who crashes less often: how often the sign is wrong where both crash as often, and what else ends a comparison.

Pairs are drawn, not driven: of each stratum a multinomial. docs/compare.md has the shares of this command:
``HARNESS_REPLICATIONS=500 python -m pytest tests/estimators/test_pairs.py -rP``.
"""

import json
import os
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.campaign.campaign import Campaign
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
from harness.estimators.stopping import PairRule
from harness.sampling.shells import PairRounds
from harness.strata import Reference, ShellDesign
from tests.estimators.small_blocks import RARE as DESIGN
from tests.estimators.small_blocks import SHELLS, in_shells

N = int(os.environ.get("HARNESS_REPLICATIONS", "50"))
P = np.array([7.3e-9, 2.5e-8, 4.9e-8, 6.7e-8, 7.5e-8, 2.1e-7, 5.4e-5])
EXACT = ShellDesign(
    pool="0" * 24, strata=(*"abcdef", "outside"), cell_stratum=tuple(range(7)), cell_p=P, n_paths=10**12,
    cell_references=(0,) * 7, boundary="e", assumes="keeps to e", n_inside=5, p_event=6e-5, p_unreachable=0,
    references=(Reference("r157-cc", "a competent driver"),), reference_rate=np.array([1e-7]),
    reference_square=np.array([1e-14]),
)  # fmt: skip
"""Strata as default traffic has them, of a pool that is known exactly."""
KEPT = np.array([25_000] * 6 + [30_000])
ENDS = ((CRASH, CRASH), (CRASH, NO_CRASH), (NO_CRASH, CRASH), (NO_CRASH, NO_CRASH))


def population(both, only_a, only_b):
    """Shares of the four ends in each stratum, (7, 4), given by the first letter of its name."""
    shares = np.array([[of.get(name[0], 0.0) for name in EXACT.strata] for of in (both, only_a, only_b)])
    return np.column_stack([*shares, 1.0 - shares.sum(0)])


_EACH = {"a": 0.5, "b": 0.3, "c": 0.3, "d": 0.2, "e": 0.2}
_HALF = {"b": 0.2, "o": 5e-4}
EQUAL = {
    "both alone outside": ("assumption_free", population({"a": 1.0}, {"o": 1e-3}, {"o": 1e-3})),
    "all shares uncertain": ("assumption_free", population({}, *[{**_EACH, "f": 0.1, "o": 1e-3}] * 2)),
    "B by a rare hole": ("assumption_free", population({"a": 1.0}, {"b": 0.4}, {"o": 0.4 * P[1] / P[6]})),
    "within the library": ("library", population({}, _EACH, _EACH)),
    "A in one scenario, B in another": (
        "assumption_free",
        [population({"a": 1.0}, {"b": 0.4, "o": 1e-3}, {}), population({}, {}, _HALF)],
    ),
    "within it, two shells": ("library", population({"a": 1.0}, {"b": 0.04}, {"e": 0.04 * P[1] / P[4]})),
}
"""Vehicles of equal rates: what is tested, and how their pairs end."""
QUICK = "both alone outside", "within the library"
MET_PER_HOUR = (1.0, 2.0)
"""Tests per hour of two scenarios of these strata."""


def rounds_of(statement, shares, seed, *args, **stop):
    """Rule and pairs after each round of a comparison, until there is enough; ``shares`` are those of each scenario."""
    settings = {"testing": {"shells": {"statement": statement}}, "stop": {"episodes": 100_000, **stop}}
    campaign, rng = Campaign.model_validate({"name": "x", **settings}), np.random.default_rng(seed)
    several = isinstance(shares, list)
    shares = shares if several else [shares]
    rule, each = PairRule(campaign, *args), [no_pairs(EXACT).each[0] for _ in shares]
    pairs = Pairs(tuple(each), MET_PER_HOUR if several else None)
    rounds = PairRounds(campaign, pairs, [KEPT for _ in shares], rule)
    while np.concatenate(added := rounds.next_round(pairs)).any():
        for of, ends, more in zip(each, shares, added, strict=True):
            for end, n in zip(ENDS, rng.multinomial(more, ends).T, strict=True):
                of.ends[:, *end] += n
        pairs = Pairs(tuple(each), MET_PER_HOUR if several else None)
        enough = rule.observe(pairs)
        yield rule, pairs
        if enough:
            break


def signs(name, seed):
    """What a comparison decides that asks for the sign alone; and one that takes the first interval without 0."""
    allowed, first = "open", "open"
    for rule, pairs in rounds_of(*EQUAL[name], seed, 0.0):
        allowed = rule.decision.verdict
        if first == "open":
            watched = pairs.within() if rule.conditional else pairs
            first = watched.verdict(0.0, Level.two_sided(0.9))
    return allowed, first


@pytest.mark.slow
@pytest.mark.parametrize("name", EQUAL if N >= 500 else [pytest.param(QUICK[0], marks=pytest.mark.slow), QUICK[1]])
def test_where_both_crash_as_often_a_sign_is_rare(name):
    """Either sign is wrong; a look after every round, until the budget or the pool is spent."""
    found = [signs(name, seed) for seed in range(N)]
    wrong = {side: [sum(each[k] == side for each in found) for k in (0, 1)] for side in ("proven", "refuted")}
    sys.stdout.write(f"{name}: of {N}, with the allowance and without {wrong}\n")
    for allowed, _ in wrong.values():
        assert binomtest(allowed, N, 0.05, alternative="greater").pvalue > 1e-3
    most = max(first for _, first in wrong.values())
    assert name not in QUICK or binomtest(most, N, 0.05, alternative="greater").pvalue < 1e-2


APART = population({"a": 1.0}, {"b": 0.9, "c": 0.3}, {})
ALIKE = population({"a": 1.0, "b": 0.6}, {"b": 0.04}, {})
SAFE = population({"a": 1.0}, {"b": 0.1}, {})


@pytest.mark.parametrize(
    ("statement", "shares", "args", "stop", "ended", "verdict"),
    [
        ("assumption_free", APART, (), {}, "accept", "proven"),
        ("assumption_free", APART[:, [0, 2, 1, 3]], (), {}, "accept", "refuted"),
        ("library", ALIKE, (), {}, "rhw", "open"),
        ("library", ALIKE, (0.0,), {}, "accept", "proven"),
        ("assumption_free", SAFE, (), {"rhw": 0.3, "below_reference": 0.3}, "below_reference", "open"),
        ("assumption_free", SAFE, (), {"rhw": 0.3, "below_reference": 0.3, "episodes": 2_000}, None, "open"),
        ("assumption_free", [SAFE, SAFE], (), {"rhw": 0.3, "below_reference": 0.3}, "below_reference", "open"),
        ("assumption_free", [SAFE, APART], (), {"rhw": 0.3, "below_reference": 0.3}, "accept", "proven"),
        ("library", APART, (None, 0.05), {"rhw": 0.3, "below_reference": 3.0}, "rhw", "proven"),
    ],
)
def test_what_ends_a_comparison(statement, shares, args, stop, ended, verdict):
    """The sign, half-width 0.1, or both far below the reference; what is asked by hand ends at that alone."""
    *_, (rule, pairs) = rounds_of(statement, shares, 3, *args, **stop)
    assert (rule.look.ended, rule.decision.verdict) == (ended, verdict)
    watched = pairs.within() if rule.conditional else pairs
    level = Level.two_sided(0.9)
    if ended == "rhw":
        assert watched.rhw(level) <= (0.05 if len(args) == 2 else 0.1)
    elif ended == "below_reference":
        assert watched.highest_rate(level) < 0.3 * pairs.reference[0] < 5 * watched.highest_rate(level)


def test_pairs_that_would_decide_do():
    *_, (rule, pairs) = rounds_of("library", ALIKE, 4)
    foreseen = rule.more_pairs(pairs) * pairs.tests.sum()
    *_, (rule, more) = rounds_of("library", ALIKE, 4, 0.0)
    assert pairs.tests.sum() < more.tests.sum() < 3 * foreseen
    assert foreseen < 3 * more.tests.sum()
    none = no_pairs(EXACT)
    none.each[0].ends[:, NO_CRASH, NO_CRASH] = 100
    assert rule.more_pairs(none) == float("inf")


@pytest.mark.parametrize(("of_looks", "least", "most"), [(False, 0.85, 1.01), (True, 0.3, 0.7)])
def test_pairs_that_would_decide_do_in_most_cases(monkeypatch, of_looks, least, most):
    """Where all ends as often as was seen; of limits as wide as those of a look it is some half."""
    *_, (rule, pairs) = rounds_of("library", ALIKE, 5)
    if of_looks:
        monkeypatch.setattr(Level, "likely", lambda level: level)
    (seen,), times, rng = pairs.each, rule.more_pairs(pairs), np.random.default_rng(1)
    decided = 0
    for _ in range(100):
        ends = np.array(
            [rng.multinomial(round(of.sum() * times), of.ravel() / max(of.sum(), 1)).reshape(3, 3) for of in seen.ends]
        )
        again = Pairs((PairCounts(seen.design, ends, seen.mass * times),)).within("library")
        decided += again.verdict(0.0, rule._level(again)) != "open"
    assert least < decided / 100 < most


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
