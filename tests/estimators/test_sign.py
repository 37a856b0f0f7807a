"""Who crashes less often: how often the sign is wrong where both crash as often, and what else ends a comparison.

Pairs are drawn, not driven: of each stratum a multinomial. docs/compare.md has the shares of this command:
``HARNESS_REPLICATIONS=500 python -m pytest tests/estimators/test_sign.py -rP``.
"""

import os
import sys

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.campaign.campaign import Campaign
from harness.estimators.likelihood import Level
from harness.estimators.pairs import CRASH, NO_CRASH, Pairs, no_pairs
from harness.estimators.stopping import PairRule
from harness.sampling.shells import PairRounds
from harness.strata import Reference, ShellDesign

N = int(os.environ.get("HARNESS_REPLICATIONS", "50"))
P = np.array([7.3e-9, 2.5e-8, 4.9e-8, 6.7e-8, 7.5e-8, 2.1e-7, 5.4e-5])
DESIGN = ShellDesign(
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
    shares = np.array([[of.get(name[0], 0.0) for name in DESIGN.strata] for of in (both, only_a, only_b)])
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
PER_HOUR = (1.0, 2.0)
"""Tests per hour of two scenarios of these strata."""


def rounds_of(statement, shares, seed, *args, **stop):
    """Rule and pairs after each round of a comparison, until there is enough; ``shares`` are those of each scenario."""
    settings = {"testing": {"shells": {"statement": statement}}, "stop": {"episodes": 100_000, **stop}}
    campaign, rng = Campaign.model_validate({"name": "x", **settings}), np.random.default_rng(seed)
    several = isinstance(shares, list)
    shares = shares if several else [shares]
    rule, each = PairRule(campaign, *args), [no_pairs(DESIGN).each[0] for _ in shares]
    pairs = Pairs(tuple(each), PER_HOUR if several else None)
    rounds = PairRounds(campaign, pairs, [KEPT for _ in shares], rule)
    while np.concatenate(added := rounds.next_round(pairs)).any():
        for of, ends, more in zip(each, shares, added, strict=True):
            for end, n in zip(ENDS, rng.multinomial(more, ends).T, strict=True):
                of.ends[:, *end] += n
        pairs = Pairs(tuple(each), PER_HOUR if several else None)
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
    none = no_pairs(DESIGN)
    none.each[0].ends[:, NO_CRASH, NO_CRASH] = 100
    assert rule.more_pairs(none) == float("inf")
