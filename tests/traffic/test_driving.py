"""Laws of traffic: probabilities against the formulas, draws against the probabilities, noise, guard, cut-in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from harness.traffic.laws import t_table
from tests.traffic import formulas
from tests.traffic.kernels import car_following, cut_in_terms, free_driving, t_distribution

speeds = st.floats(0.0, 60.0)
gaps = st.floats(-0.001, 200.0)
rates = st.floats(-25.0, 25.0)
STATES = [
    (30.0, 35.0, 0.3),
    (24.0, 12.0, -2.5),
    (33.0, 4.0, -1.0),
    (28.0, 60.0, -9.0),
    (20.0, 110.0, 6.0),
    (38.0, 8.0, 0.0),
]
UNIFORMS = (np.arange(100_000) + 0.5) / 100_000
DEGREES_OF_FREEDOM = [1.5, 3.39, 4.98, 16.0, 200.0]


@given(speeds)
def test_free_driving_probabilities(speed):
    pmf = free_driving(speed)[0][0]
    assert pmf.sum() == pytest.approx(1.0, abs=1e-12)
    assert (pmf >= 0.0).all()
    np.testing.assert_allclose(pmf, formulas.free_driving_pmf(speed), rtol=0, atol=2e-8)


@given(speeds, gaps, rates)
def test_car_following_probabilities(speed, r1, r1dot):
    pmf, cap, _ = car_following((speed, r1, r1dot))
    assert pmf[0].sum() == pytest.approx(1.0, abs=1e-12)
    assert (pmf >= 0.0).all()
    np.testing.assert_allclose(pmf[0], formulas.car_following_pmf(speed, r1, r1dot, cap[0]), rtol=0, atol=2e-8)
    assert (pmf[0, cap[0] + 1 :] == 0.0).all()


@given(gaps, rates)
def test_the_guard_caps_at_the_largest_safe_acceleration(r1, r1dot):
    assert car_following((30.0, r1, r1dot))[1][0] in formulas.guard_caps(r1, r1dot)


def largest_difference(drawn, pmf):
    """Equal steps of the uniform give every acceleration its probability to within one step, 1e-5."""
    assert (np.diff(drawn) >= 0).all()
    return np.abs(np.bincount(drawn, minlength=31) / UNIFORMS.size - pmf).max()


@pytest.mark.parametrize("speed", [15.0, 22.0, 30.0, 45.0])
def test_free_driving_draws_invert_the_distribution(speed):
    pmf, drawn = free_driving(speed, UNIFORMS)
    assert largest_difference(drawn[0], pmf[0]) < 1.001e-5


@pytest.mark.parametrize("state", STATES)
def test_car_following_draws_invert_the_distribution(state):
    pmf, cap, drawn = car_following(state, UNIFORMS)
    assert largest_difference(drawn[0], pmf[0]) < 1.001e-5
    assert drawn.max() <= cap[0]


# -- Student's t as a table --


@pytest.mark.parametrize("df", DEGREES_OF_FREEDOM)
def test_noise_is_within_1e_8_of_scipys_and_rises_from_0_to_1(df):
    table = t_table(df)
    z = np.concatenate([np.random.default_rng(0).uniform(-70.0, 70.0, 200_000), np.linspace(-4.0, 4.0, 20_001)])
    z.sort()
    found, within = t_distribution(z, table), np.abs(z) <= 64.0
    assert np.abs(found - stats.t.cdf(z, df))[within].max() < 1e-8
    assert (np.diff(found) >= 0.0).all()
    assert t_distribution(np.array([-np.inf, -64.1, 64.1, np.inf]), table).tolist() == [0.0, 0.0, 1.0, 1.0]


# -- the hazard of the cut-in --


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
