"""Running moments: those of numpy, whatever the blocks, and of the zeros that were never added."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.estimators.weighted import Moments


def moments(*blocks: list[float]) -> Moments:
    return sum((Moments.of(np.array(values, dtype=np.float64)) for values in blocks), Moments())


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=40), st.integers(0, 40), st.integers(0, 40))
def test_are_those_of_numpy_however_the_numbers_are_cut_and_whatever_zeros_are_left_out(values, cut, zeros):
    sums = moments(values[:cut], values[cut:])
    array = np.array([*values, *[0.0] * zeros])
    n = len(array)
    assert sums.total == pytest.approx(math.fsum(values), abs=1e-9)
    assert sums.squares == pytest.approx(np.sum(array**2), rel=1e-12, abs=1e-300)
    assert sums.mean(n) == pytest.approx(np.mean(array), abs=1e-12)
    assert sums.variance(n) == pytest.approx(np.var(array, ddof=1), rel=1e-9, abs=1e-9)
    expected = np.sum((array - array.mean()) ** 3) / n**3
    assert sums.third_moment(n) == pytest.approx(expected, rel=1e-9, abs=1e-6)


@pytest.mark.parametrize("size", [1, 10, 1_000])
def test_weights_over_many_decades_keep_twelve_digits_in_blocks_of_any_size(size):
    values = np.exp(np.random.default_rng(7).normal(-20.0, 3.0, 3_000))
    sums, n = moments(*np.split(values, range(size, len(values), size))), 10 * len(values)
    total, squares, cubes = (sum(Fraction(v) ** power for v in values.tolist()) for power in (1, 2, 3))
    mean = total / n
    assert sums.mean(n) == pytest.approx(float(mean), rel=1e-13)
    assert sums.variance(n) == pytest.approx(float((squares - total * mean) / (n - 1)), rel=1e-12)
    third = (cubes - 3 * mean * squares + 2 * n * mean**3) / n**3
    assert sums.third_moment(n) == pytest.approx(float(third), rel=1e-12)


@pytest.mark.parametrize(
    ("blocks", "n", "mean", "variance"),
    [
        ([[1.0, math.inf]], 3, math.inf, math.inf),
        ([[math.inf], [1.0], []], 3, math.inf, math.inf),
        ([[1e200], [0.0]], 2, 5e199, math.inf),
        ([[1.0]], 1, 1.0, math.inf),
        ([], 5, 0.0, 0.0),
    ],
)
def test_infinite_numbers_and_squares_decide_and_nothing_has_no_spread(blocks, n, mean, variance):
    sums = moments(*blocks)
    assert (sums.mean(n), sums.variance(n), sums.third_moment(n)) == (mean, variance, 0.0)
    assert sums.third_moment(0) == 0.0
    assert math.isnan(moments([math.inf], [-math.inf]).total)
