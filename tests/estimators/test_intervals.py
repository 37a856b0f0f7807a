"""Intervals against scipy and by exact enumeration of their coverage."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, binomtest

from harness.estimators.limits import _hall, capped_mean_upper, clopper_pearson, normal_half_width, skewed_distances

levels = st.floats(0.5, 0.999)


@given(st.integers(0, 60), st.integers(1, 60), levels)
def test_clopper_pearson_is_scipys_exact_interval(n_crashes, n, confidence):
    n = max(n, n_crashes)
    low, high = clopper_pearson(n_crashes, n, (1.0 - confidence) / 2.0)
    reference = binomtest(n_crashes, n).proportion_ci(confidence, method="exact")
    assert low == pytest.approx(reference.low, rel=1e-9, abs=1e-12)
    assert high == pytest.approx(reference.high, rel=1e-9)


@given(st.integers(1, 10**9), levels, st.floats(1e-12, 1.0))
def test_without_a_crash_the_capped_bound_is_clopper_pearson_times_the_cap(n, confidence, cap):
    upper = clopper_pearson(0, n, 1.0 - confidence)[1]
    assert capped_mean_upper(0.0, cap, n, confidence) == pytest.approx(cap * upper, rel=1e-12)
    assert upper == pytest.approx(1.0 - (1.0 - confidence) ** (1.0 / n), abs=1e-15)


@given(st.floats(1e-12, 1.0), st.floats(0.0, 1.0), st.integers(1, 10**9), levels)
def test_the_capped_bound_solves_hoeffdings_equation(cap, share, n, confidence):
    upper = capped_mean_upper(share * cap, cap, n, confidence)
    assert share * cap * (1.0 - 1e-12) <= upper <= cap * (1.0 + 1e-12)
    p = upper / cap
    if 1e-9 < share < 0.999 and p < 0.999 and share * n > 1e-3:
        entropy = share * math.log(share / p) + (1 - share) * (math.log1p(-share) - math.log1p(-p))
        assert n * entropy == pytest.approx(-math.log(1.0 - confidence), rel=1e-3)


@pytest.mark.parametrize("p", [0.003, 0.05, 0.4])
@pytest.mark.parametrize("n", [10, 200])
def test_the_capped_bound_holds_at_its_level_for_the_hardest_case(p, n):
    """Y is 0 or the cap: the exact probability that the bound fails, summed over all counts."""
    cap, confidence = 3e-4, 0.9
    counts = np.arange(n + 1)
    bounds = np.array([capped_mean_upper(cap * c / n, cap, n, confidence) for c in counts])
    assert binom.pmf(counts[bounds < cap * p], n, p).sum() <= 1.0 - confidence


@given(st.floats(-2.0, 2.0).filter(lambda k: k == 0.0 or abs(k) > 1e-9), st.floats(-3.0, 3.0))
def test_halls_transformation_is_inverted(skewness, z):
    t = _hall(z, skewness) if skewness else z
    assert t + skewness * t * t / 3.0 + skewness**2 * t**3 / 27.0 + skewness / 6.0 == pytest.approx(z, abs=1e-6)


@given(st.floats(1e-9, 1.0), st.floats(-1.0, 1.0), levels)
def test_limits_reach_as_far_as_the_normal_ones_and_lean_to_the_side_of_the_skew(std_error, skewness, confidence):
    below, above = skewed_distances(std_error, skewness * std_error**3, (1.0 - confidence) / 2.0)
    mirrored = skewed_distances(std_error, -skewness * std_error**3, (1.0 - confidence) / 2.0)
    assert (below, above) == pytest.approx(mirrored[::-1])
    assert min(below, above) >= normal_half_width(std_error, confidence) * (1.0 - 1e-12)
    if skewness > 1e-3 and confidence > 0.8:
        assert above > below
