"""RNoT as published: known answers, the rules at the edges, and that nothing but seed and records decides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.estimators.nade import Nade
from harness.estimators.scv import Scv
from harness.studies.chains.named import overtaking
from harness.studies.chains.sampler import blocks
from harness.studies.required_tests import (
    Procedure,
    RequiredTests,
    acceleration,
    plain_rhw,
    required_tests,
    rows_of,
    scv_rhw,
    shuffled,
)
from tests.chains.seed import SEED
from tests.estimators.small_blocks import fed

CHAIN = overtaking("two surrogates", skill=0.5, surrogates=[0.5, 0.2], level=0.02, horizon=6)
GRID = np.array([10, 20, 30, 40, 50])
QUICK = Procedure(rhw=0.6, n_shuffles=5, ratio=1.3, seed=3)


def first_below(rhw: np.ndarray, grid: np.ndarray, threshold: float) -> np.ndarray:
    """The wrong rule that is easily taken for the right one: first below, not stays below."""
    below = rhw <= threshold
    return grid[np.where(below.any(axis=1), np.argmax(below, axis=1), len(grid) - 1)]


def read(*rhw: float, threshold: float = 0.3) -> RequiredTests:
    return required_tests(np.array([rhw]), GRID, threshold)


def test_a_dip_below_the_threshold_does_not_count():
    rhw = (0.9, 0.2, 0.5, 0.3, 0.1)
    assert read(*rhw).n.tolist() == [40]
    assert first_below(np.array([rhw]), GRID, 0.3).tolist() == [20]


def test_at_the_threshold_is_low_enough():
    assert read(0.9, 0.3, 0.3, 0.3, 0.3).n.tolist() == [20]


def test_where_nothing_is_above_the_n_of_the_largest_counts():
    found = read(0.1, 0.15, 0.25, 0.2, 0.1)
    assert (found.n.tolist(), found.never_above.tolist(), found.is_lower_limit) == ([30], [True], False)
    assert read(0.2, 0.2, 0.1, 0.2, 0.1).n.tolist() == [10]


@pytest.mark.parametrize("last", [0.31, np.inf, np.nan])
def test_above_at_the_total_counts_as_the_total_and_is_told(last):
    found = read(0.1, 0.1, 0.1, 0.1, last)
    assert found.n.tolist() == [50]
    assert found.never_reached.tolist() == [True]
    assert found.is_lower_limit
    settled_at_the_last_look = read(0.9, 0.9, 0.9, 0.9, 0.3)
    assert (settled_at_the_last_look.n.tolist(), settled_at_the_last_look.is_lower_limit) == ([50], False)


def test_mean_and_quantiles_are_over_shuffles():
    rhw = np.where(np.array([[20], [30], [30], [50]]) > GRID, 0.9, 0.1)
    found = required_tests(rhw, GRID, 0.3)
    assert found.n.tolist() == [20, 30, 30, 50]
    assert (found.mean, found.quantile(0.05), found.quantile(0.5), found.quantile(0.95)) == (32.5, 20, 30, 50)


def test_the_acceleration_says_on_which_side_of_the_truth_it_is():
    slow, fast = read(0.9, 0.9, 0.9, 0.1, 0.1), read(0.9, 0.1, 0.1, 0.1, 0.1)
    never = read(0.9, 0.9, 0.9, 0.9, 0.9)
    assert acceleration(slow, fast) == (2.0, "equal")
    assert acceleration(never, fast) == (2.5, "at least")
    assert acceleration(fast, never) == (0.4, "at most")
    assert acceleration(never, never)[1] == "unknown"


@pytest.mark.parametrize(
    ("procedure", "n_tests", "grid"),
    [
        (Procedure(first=10, ratio=2.0), 100, [10, 20, 40, 80, 100]),
        (Procedure(first=10, ratio=1.01, total=13), 100, [10, 11, 12, 13]),
        (Procedure(first=10, ratio=2.0, total=1_000), 20, [10, 20]),
        (Procedure(first=10), 4, [4]),
    ],
)
def test_the_grid_rises_to_the_total(procedure, n_tests, grid):
    assert procedure.grid(n_tests).tolist() == grid


@pytest.mark.parametrize("weight", [1.0, 0.3, 1e-200])
def test_equal_weighted_crashes_have_no_width_at_all(weight):
    """Y constant: RHW is exactly 0 everywhere, nothing is above, and the first of equals is the largest."""
    rhw = plain_rhw(np.full(1_000, weight), 1_000, QUICK)
    assert (rhw == 0.0).all()
    found = required_tests(rhw, QUICK.grid(1_000), 0.3)
    assert found.never_above.all()
    assert found.mean == QUICK.first


@pytest.mark.parametrize("p", [0.05, 0.2])
def test_bernoulli_crashes_need_what_the_formula_says(p):
    """RHW of a share is z·sqrt((1-p)/(p·n)), so that 0.1 takes z²(1-p)/(p·0.1²) tests.

    After so many tests the share is off by 6 % (one standard deviation), and the RNoT in proportion: its mean over 50
    shuffles by 1 %. "Stays" takes the last of several crossings, some crashes later. The mean must lie between 0.95 and
    1.1 of the formula, five standard deviations on either side (error probability below 1e-6).
    """
    procedure = Procedure(rhw=0.1, n_shuffles=50, ratio=1.00001)
    expected = procedure.z**2 * (1 - p) / (p * 0.1**2)
    n = int(10 * expected)
    grid, rhw = procedure.grid(n), plain_rhw(np.ones(int(n * p)), n, procedure)
    assert (np.diff(grid) == 1).all()
    found = required_tests(rhw, grid, 0.1)
    assert 0.95 < found.mean / expected < 1.1
    too_few = first_below(rhw, grid, 0.1)
    assert (too_few <= found.n).all()
    assert (too_few < found.n).any()


def test_the_width_on_a_prefix_is_that_of_its_mean_and_sample_variance():
    tests = next(iter(blocks(CHAIN, "step_mixture", [800], SEED)))
    procedure = replace(QUICK, first=2)
    grid = procedure.grid(800)
    rhw = plain_rhw(tests.weighted_crashes()[tests.crash], 800, procedure)
    for shuffle in range(procedure.n_shuffles):
        y = tests.weighted_crashes()[shuffled(procedure.seed, shuffle, tests.crash)]
        for at, n in enumerate(grid):
            mean, error = np.mean(y[:n]), np.std(y[:n], ddof=1) / np.sqrt(n)
            expected = procedure.z * error / mean if mean else np.inf
            assert rhw[shuffle, at] == pytest.approx(expected, rel=1e-9)
        assert sorted(shuffled(procedure.seed, shuffle, tests.crash)) == list(range(800))


def test_places_of_crashes_are_uniform():
    """Each of 5 tests, 2 crashed, must come first in a fifth of 5,000 shuffles: within 5 standard deviations (1e-5)."""
    crash = np.array([True, False, False, True, False])
    first = np.bincount([shuffled(1, shuffle, crash)[0] for shuffle in range(5_000)], minlength=5)
    assert np.abs(first - 1_000).max() < 5 * np.sqrt(5_000 * 0.2 * 0.8)


def test_without_a_crash_the_threshold_is_never_reached():
    found = required_tests(plain_rhw(np.empty(0), 500, QUICK), QUICK.grid(500), 0.3)
    assert found.never_reached.all()
    assert found.mean == 500


def test_algorithm_1_grown_look_by_look_is_algorithm_1_on_each_prefix():
    (tests,) = blocks(CHAIN, "step_mixture", [3_000], SEED)
    procedure = replace(QUICK, ratio=3.0, n_shuffles=2)
    grown = scv_rhw(tests, procedure)
    for shuffle in range(2):
        order = shuffled(procedure.seed, shuffle, tests.crash)
        for at, n in enumerate(procedure.grid(3_000)):
            anew = fed(Scv(), [rows_of(tests, order[:n])])
            assert grown[shuffle, at] == anew.result(procedure.confidence).rhw


def test_scv_claims_the_width_of_nade_where_it_has_no_columns_and_less_where_it_has():
    (tests,) = blocks(CHAIN, "step_mixture", [3_000], SEED)
    plain = plain_rhw(tests.weighted_crashes()[tests.crash], 3_000, QUICK)
    uncontrolled = replace(tests, n_control_steps=np.zeros(3_000, dtype=np.int64))
    np.testing.assert_allclose(scv_rhw(uncontrolled, QUICK), plain, rtol=1e-9)
    claimed = scv_rhw(tests, QUICK)
    assert (claimed[:, -1] < plain[:, -1]).all()
    assert plain[0, -1] == pytest.approx(claimed[0, -1] * _nade_over_scv(tests), rel=1e-9)


def _nade_over_scv(tests) -> float:
    return fed(Nade(), [tests]).result(0.9).std_error / fed(Scv(), [tests]).result(0.9).std_error
