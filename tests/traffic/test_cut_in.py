"""Hazard of the cut-in against its formula, and its limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.traffic import formulas
from tests.traffic.kernels import cut_in_terms

speeds = st.floats(0.0, 60.0)
gaps = st.floats(-0.001, 200.0)
rates = st.floats(-25.0, 25.0)
av_gaps = st.floats(-10.0, 110.0)
levels = st.sampled_from([1e-3, 1.0, 100.0, 350.0, 1e4, 1e6, 1e8])


@given(speeds, gaps, rates, av_gaps, rates, levels)
def test_the_hazard_is_the_formula(v, r1, r1dot, r2, r2dot, level):
    wish, accepted, hazard = cut_in_terms((v, r1, r1dot, r2, r2dot), level)[0]
    assert wish == pytest.approx(formulas.opportunity(v, r1, r1dot, level), rel=1e-12)
    assert accepted == pytest.approx(formulas.acceptance(r2, r2dot), rel=1e-12)
    p_1s = wish * accepted
    assert -np.expm1(-hazard) == pytest.approx(formulas.step_probability(p_1s), rel=1e-9, abs=1e-16)
    assert 0.0 <= hazard <= 0.1 * np.log(2.0) * (1.0 + 1e-15)  # never above one half a second
