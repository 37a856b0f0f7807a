"""RNoT as published: known answers, rules at the edges, that nothing but seed and records decides."""

from dataclasses import replace

import numpy as np
import pytest

from harness.errors import HarnessError
from harness.estimators.scv import Scv
from studies import rnot
from studies.case_study.figures import figure
from studies.chains.chain import overtaking
from tests.chains import SEED
from tests.estimators.small_blocks import block, blocks, fed

CHAIN = overtaking("two surrogates", skill=0.5, surrogates=[0.5, 0.2], level=0.02, horizon=6)
GRID = np.array([10, 20, 30, 40, 50])
QUICK = rnot.Procedure(rhw=0.6, n_shuffles=5, ratio=1.3, seed=3)


@pytest.mark.parametrize(
    ("rhw", "n", "never_reached"),
    [
        ((0.9, 0.2, 0.5, 0.3, 0.1), 40, False),  # a dip below the threshold does not count
        ((0.1, 0.15, 0.25, 0.2, 0.1), 30, False),  # nothing above it: the n of the largest
        ((0.2, 0.2, 0.1, 0.2, 0.1), 10, False),
        ((0.9, 0.9, 0.9, 0.9, 0.3), 50, False),
        ((0.1, 0.1, 0.1, 0.1, 0.31), 50, True),
        ((0.1, 0.1, 0.1, 0.1, np.inf), 50, True),
        ((0.1, 0.1, 0.1, 0.1, np.nan), 50, True),
    ],
)
def test_the_required_number_is_the_first_look_from_which_on_the_width_stays_below(rhw, n, never_reached):
    found = rnot.required_tests(np.array([rhw]), GRID, 0.3)
    assert (found.n, found.never_reached) == (n, never_reached)
    assert found.is_lower_limit == never_reached


def test_the_acceleration_is_open_on_the_side_where_nothing_is_known():
    slow, fast, never = (
        rnot.required_tests(np.array([[0.9, *rhw]] * 2), GRID, 0.3)
        for rhw in ((0.9, 0.9, 0.1, 0.1), (0.1, 0.1, 0.1, 0.1), (0.9, 0.9, 0.9, 0.9))
    )
    assert slow.over(fast, 0.9) == figure(2.0, 2.0, 2.0)
    assert never.over(fast, 0.9) == figure(2.5, 2.5)
    assert fast.over(never, 0.9) == figure(0.4, None, 0.4)
    assert never.over(never, 0.9) == figure(None)


def test_tests_that_failed_are_refused():
    """The paper's counts know of none; who failed might have crashed."""
    assert rnot.Tests.of_block(block([True, False, True])).episode.tolist() == [0, 2]
    with pytest.raises(HarnessError, match="1 failed"):
        rnot.Tests.of_block(block([True, False, False], failed=[False, True, False]))


def test_the_grid_rises_to_the_total():
    assert rnot.Procedure(first=10, ratio=2.0).grid(100).tolist() == [10, 20, 40, 80, 100]
    assert rnot.Procedure(first=10, ratio=1.01).grid(13).tolist() == [10, 11, 12, 13]
    assert rnot.Procedure(first=10).grid(4).tolist() == [4]


def test_the_width_on_a_prefix_is_that_of_its_mean_and_sample_variance():
    tests = next(iter(blocks(CHAIN, "step_mixture", [800], SEED)))
    procedure = replace(QUICK, first=2)
    grid = procedure.grid(800)
    rhw = rnot.plain_rhw(tests.weighted_crashes()[tests.crash], 800, procedure)
    for shuffle in range(procedure.n_shuffles):
        y = tests.weighted_crashes()[rnot.shuffled(procedure.seed, shuffle, tests.crash)]
        for at, n in enumerate(grid):
            mean, error = np.mean(y[:n]), np.std(y[:n], ddof=1) / np.sqrt(n)
            expected = procedure.z * error / mean if mean else np.inf
            assert rhw[shuffle, at] == pytest.approx(expected, rel=1e-9)
        assert sorted(rnot.shuffled(procedure.seed, shuffle, tests.crash)) == list(range(800))


def test_algorithm_1_grown_look_by_look_is_algorithm_1_on_each_prefix():
    (tests,) = blocks(CHAIN, "step_mixture", [3_000], SEED)
    procedure = replace(QUICK, ratio=3.0, n_shuffles=2)
    grown = rnot.scv_rhw(tests, procedure)
    for shuffle in range(2):
        order = rnot.shuffled(procedure.seed, shuffle, tests.crash)
        for at, n in enumerate(procedure.grid(3_000)):
            anew = fed(Scv(), [tests.chosen(order[:n])])
            assert grown[shuffle, at] == anew.result(procedure.confidence).rhw
