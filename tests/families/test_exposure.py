"""How often there are events: what was counted, and its limits."""

import pytest
from scipy.stats import chi2

from harness.families.cut_in.family import CUT_IN


def test_a_counted_exposure_is_what_it_is_counted_from():
    """Exact Poisson limits at 90 %: half a quantile of χ² with 2 k and 2 k + 2 degrees of freedom."""
    told = CUT_IN.exposure(None, None)
    k, hours = told.counted
    low, high = 0.5 * chi2.ppf(0.05, 2 * k) / hours, 0.5 * chi2.ppf(0.95, 2 * k + 2) / hours
    assert (told.per_hour, told.low, told.high) == pytest.approx((k / hours, low, high), abs=5e-4)
