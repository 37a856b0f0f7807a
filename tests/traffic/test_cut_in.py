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


@pytest.mark.parametrize(
    ("r2", "r2dot", "accepted"),
    [
        (50.0, 0.0, 1.0),  # not closing: every wish is carried out
        (50.0, 3.0, 1.0),
        (1e-9, 3.0, 1.0),
        (60.0, -7.5, 0.01 + 0.99 * 0.5),  # TTC of exactly 8 s
        (7.5, -7.5, 0.01 + 0.99 / (1.0 + np.exp(14.0))),  # TTC of 1 s: those who do not look
        (0.0, -7.5, 0.0),  # the lanes do not allow it
        (0.0, 7.5, 0.0),
        (-3.0, 7.5, 0.0),
    ],
)
def test_acceptance(r2, r2dot, accepted):
    terms = cut_in_terms((30.0, 35.0, 0.0, r2, r2dot), 1e4)[0]
    assert terms[1] == pytest.approx(accepted, rel=1e-13)
    assert (terms[2] > 0.0) == (r2 > 0.0)
