"""Exact sums: no rounding, no order, no grouping."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.estimators.exact_sum import ExactSum, MomentSums, SkewedSums

finite = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e300, max_value=1e300)
lists = st.lists(finite, max_size=30)


def exact(values: list[float]) -> ExactSum:
    total = ExactSum()
    total.add(np.array(values, dtype=np.float64))
    return total


@given(lists)
def test_is_the_exact_sum(values):
    assert exact(values).fraction() == sum(map(Fraction, values), Fraction(0))
    assert exact(values).value() == math.fsum(values)


@given(lists, lists, lists)
def test_merging_is_associative_and_commutative_to_the_last_bit(a, b, c):
    left, right = exact(a), exact(b)
    left.merge(exact(b))
    left.merge(exact(c))
    right.merge(exact(c))
    right.merge(exact(a))
    assert left.value() == right.value() == exact(c + b + a).value()


@pytest.mark.parametrize("value", [5e-324, 2.2250738585072014e-308, 1.7976931348623157e308, -0.1, 0.0])
def test_extreme_numbers_survive(value):
    assert exact([value]).value() == value


def test_cancellation_leaves_the_small_part():
    assert exact([1e300, 1e-300, -1e300]).value() == 1e-300


def test_infinite_and_undefined_numbers_decide_the_value():
    assert exact([1.0, math.inf]).value() == math.inf
    assert math.isnan(exact([math.inf, -math.inf]).value())


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=40))
def test_moments_are_those_of_numpy(values):
    sums = MomentSums()
    sums.add(np.array(values))
    n = len(values)
    scale = max(1.0, *map(abs, values)) ** 2
    assert sums.mean(n) == pytest.approx(np.mean(values), abs=1e-9)
    assert sums.variance(n) == pytest.approx(np.var(values, ddof=1), rel=1e-9, abs=1e-12 * scale)


def test_variance_keeps_its_digits_where_the_mean_is_large():
    sums = MomentSums()
    sums.add(np.array([2.0**25, 2.0**25 + 1.0, 2.0**25 + 2.0]))
    assert sums.variance(3) == 1.0


@given(st.lists(st.floats(-1e100, 1e100).filter(lambda x: x == 0.0 or abs(x) > 1e-100), min_size=2, max_size=20))
def test_squares_are_summed_without_rounding(values):
    sums = MomentSums()
    sums.add(np.array(values))
    assert sums.squares.fraction() == sum((Fraction(v) ** 2 for v in values), Fraction(0))


@given(st.floats(1e-12, 1e3), st.integers(2, 50))
def test_equal_numbers_have_no_variance(value, n):
    sums = MomentSums()
    sums.add(np.full(n, value))
    assert sums.variance(n) == 0.0


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40), st.integers(0, 40))
def test_third_moments_are_those_of_numpy_however_they_are_merged(values, cut):
    array = np.array(values)
    sums, rest = SkewedSums(), SkewedSums()
    sums.add(array[cut:])
    rest.add(array[:cut])
    sums.merge(rest)
    expected = np.sum((array - array.mean()) ** 3) / len(values) ** 3
    assert sums.third_moment(len(values)) == pytest.approx(expected, rel=1e-9, abs=1e-6)
    whole = SkewedSums()
    whole.add(array)
    assert whole.third_moment(len(values)) == sums.third_moment(len(values))


def test_third_moments_of_what_is_not_finite_say_nothing():
    sums = SkewedSums()
    sums.add(np.array([1.0, math.inf]))
    assert sums.third_moment(2) == 0.0
