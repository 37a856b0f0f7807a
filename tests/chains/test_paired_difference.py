"""The difference of two vehicles from pairs: unbiased, covered as claimed, and worth the pairing.

Two vehicles in a world of one maneuver: the same random numbers give the same maneuver, and B crashes in one of those
in which A does. Both rates are known exactly.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.estimators.block import Block
from harness.estimators.difference import Difference, difference_statement, paired_difference
from studies.chains.named import overtaking
from studies.chains.sampler import draw
from studies.chains.single_choice import with_optimal_function

from .seed import SEED

REPLICATIONS = 400
N = 2_000
CONFIDENCE = 0.9
FALSE_ALARM = 1e-4

A = with_optimal_function(0.5)
B = replace(A, crash=np.array([False, False, False, False, True]))
TRUTH = A.crash_rate - B.crash_rate


def pair(k: int, *, shared: bool = True) -> tuple[Block, Block]:
    seeds = [SEED, k], ([SEED, k] if shared else [SEED, k, 1])
    return tuple(
        world.draw("episode_mixture", N, np.random.default_rng(seed)) for world, seed in zip((A, B), seeds, strict=True)
    )


def replications(*, shared: bool = True) -> list[Difference]:
    return [paired_difference([pair(k, shared=shared)], CONFIDENCE) for k in range(REPLICATIONS)]


@pytest.fixture(scope="module")
def paired():
    return replications()


def test_the_difference_is_unbiased(paired):
    found = np.array([one.difference for one in paired])
    assert abs(found.mean() - TRUTH) < 4.0 * found.std(ddof=1) / math.sqrt(REPLICATIONS)
    claimed = math.sqrt(np.mean([one.std_error**2 for one in paired]))
    assert claimed == pytest.approx(found.std(ddof=1), rel=0.15)


def covers(held: list[bool]) -> bool:
    return binomtest(sum(held), REPLICATIONS, CONFIDENCE).pvalue > FALSE_ALARM


def test_intervals_of_difference_and_ratio_cover(paired):
    ratio = A.crash_rate / B.crash_rate
    assert covers([one.ci_low <= TRUTH <= one.ci_high for one in paired])
    assert covers([one.ratio_low <= ratio <= one.ratio_high for one in paired])


def test_the_variance_of_independent_runs_would_be_wrong_for_pairs(paired):
    """Mutant: errors of A and B added in quadrature, as if the runs were independent."""
    half = [1.6449 * math.hypot(one.a.std_error, one.b.std_error) for one in paired]
    assert not covers([abs(one.difference - TRUTH) <= wide for one, wide in zip(paired, half, strict=True)])


def test_what_pairing_saves_is_what_independent_runs_cost(paired):
    independent = np.var([one.difference for one in replications(shared=False)], ddof=1)
    saved = independent / np.var([one.difference for one in paired], ddof=1)
    assert np.mean([one.variance_ratio for one in paired]) == pytest.approx(saved, rel=0.3)
    assert saved > 1.5


def test_vehicles_with_a_will_of_their_own_are_covered_too():
    """Chains whose episodes share paths and weights, and part after the cut-in."""
    a, b = (overtaking("x", skill=skill, surrogates=[0.5], level=0.02, horizon=8) for skill in (0.5, 0.6))
    truth, held = a.crash_rate - b.crash_rate, []
    for k in range(REPLICATIONS):
        blocks = (draw(chain, "forced", N, np.random.default_rng([SEED, 7, k])) for chain in (a, b))
        found = paired_difference([tuple(blocks)], CONFIDENCE)
        held.append(found.ci_low <= truth <= found.ci_high)
    assert covers(held)


def test_blocks_in_pieces_give_the_same():
    a, b = pair(0)
    pieces = [slice(0, 700), slice(700, N)]
    one = paired_difference([(a, b)], 0.9)
    other = paired_difference([(a.take(rows), b.take(rows)) for rows in pieces], 0.9)
    for name in ("difference", "std_error", "ci_low", "ci_high", "ratio_low", "ratio_high", "n_effective"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-12), name
    assert (one.n_pairs, one.n_differing) == (other.n_pairs, other.n_differing)


def test_other_episodes_are_no_pairs():
    a, b = pair(0)
    with pytest.raises(ValueError, match="no pairs"):
        paired_difference([(a, b.take(slice(1, N)))], 0.9)


def test_equal_vehicles_have_a_bound_and_not_a_zero_width():
    a, _ = pair(0)
    found = paired_difference([(a, a)], CONFIDENCE)
    assert found.difference == 0.0
    assert found.ci_low < 0.0 < found.ci_high
    assert math.isinf(found.variance_ratio)
    assert found.to_json()["variance_ratio"] is None
    assert "the vehicles may be equal" in " ".join(found.warnings)
    text = difference_statement(found, "a", "b")
    assert "not distinguishable" in text
    assert "A/B = 1 (its interval is not known: no pair differs)" in text
    assert "times as many" not in text
    assert found.to_json()["ratio"] == 1.0
    assert found.to_json()["ratio_low"] is found.to_json()["ratio_high"] is None


def test_pairing_that_saves_nothing_is_said_in_words(paired):
    text = difference_statement(replace(paired[0], variance_ratio=1.0004), "a", "b")
    assert text.endswith("; independent runs would need as many.")
    assert "would need 2.5 times as many." in difference_statement(replace(paired[0], variance_ratio=2.5), "a", "b")


def test_the_statement_says_who_crashes_more(paired):
    assert "A (one) crashes" in (text := difference_statement(paired[0], "one", "two"))
    assert "A crashes more often" in text
    a, b = pair(0)
    assert "A crashes less often" in difference_statement(paired_difference([(b, a)], CONFIDENCE), "one", "two")
