"""How often there are events: what was counted, and its limits."""

import pytest
from scipy.stats import chi2

from harness.campaign.sections import EnvironmentSettings
from harness.families.cut_in.family import CUT_IN
from harness.families.cut_out.family import CUT_OUT, CutOutParameters


def test_a_counted_exposure_is_what_it_is_counted_from():
    """Exact Poisson limits at 90 %: half a quantile of χ² with 2 k and 2 k + 2 degrees of freedom."""
    told = CUT_IN.exposure(None, None)
    k, hours = told.counted
    low, high = 0.5 * chi2.ppf(0.05, 2 * k) / hours, 0.5 * chi2.ppf(0.95, 2 * k + 2) / hours
    assert (told.per_hour, told.low, told.high) == pytest.approx((k / hours, low, high), abs=5e-4)


def test_a_file_that_says_what_was_counted_gives_a_counted_exposure_of_the_events_in_scope():
    counted = {"per_hour": {"value": 2.0, "source": "fitted", "range": [1.1, 3.4]}, "events": 10, "hours": 5.0}
    parameters = CutOutParameters.model_validate({"like": "cut-out-1", "exposure": counted})
    told = CUT_OUT.exposure(CUT_OUT.traffic(EnvironmentSettings(), parameters), parameters)
    assert told.counted[0] == 10
    assert told.counted[1] > 100 * 5.0  # few of them ask for braking
    assert told.per_hour == pytest.approx(10 / told.counted[1])
