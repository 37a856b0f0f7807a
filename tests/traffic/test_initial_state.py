"""Initial states against distribution functions by scipy, with the published numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from harness.traffic.laws import InitialStates
from tests.chains.seed import SEED
from tests.traffic.kernels import environment

N = 400_000
open_unit = st.floats(1e-9, 1.0 - 1e-9)
inside_v = st.floats(20.0, 40.0)


@pytest.fixture(scope="module")
def sampler():
    return InitialStates(environment().numbers)


@pytest.fixture(scope="module")
def states(sampler):
    return sampler.draw(SEED, 0, N)


def gap_distribution(v):
    """R1 at a speed: shift + LogNormal, as scipy has it, and its probabilities at 0 and 115 m."""
    u = (v - 30.0) / 10.0
    free = stats.lognorm(np.exp(-0.191 + 0.191 * u), 9.66 + 6.43 * u, np.exp(3.282 + 0.311 * u))
    return free, free.cdf(0.0), free.cdf(115.0)


def rate_distribution(v, r1):
    u, w = (v - 30.0) / 10.0, (r1 - 40.0) / 40.0
    location = 0.331 - 0.687 * u - 0.219 * w - 0.904 * u * w - 0.230 * u**2
    return stats.t(4.98, location, np.exp(-0.015 - 0.109 * u + 0.808 * w - 0.327 * w**2))


@pytest.mark.parametrize(
    ("column", "reference"),
    [("r2_m", stats.uniform(20.0, 80.0)), ("r2dot_mps", stats.uniform(-10.0, 5.0))],
    ids=["R2", "R2dot"],
)
def test_the_avs_part_is_uniform(states, column, reference):
    assert stats.kstest(states[column], reference.cdf).pvalue > 1e-4


def test_speeds_are_skew_normal(states):
    free = stats.skewnorm(-2.41, 33.86, 5.174)
    low, high = free.cdf(20.0), free.cdf(40.0)
    sample = states["v_bv_mps"][:20_000]
    assert stats.kstest(sample, lambda v: (free.cdf(v) - low) / (high - low)).pvalue > 1e-4


@given(inside_v, open_unit)
def test_gaps_invert_their_distribution(v, probability):
    found = InitialStates(environment().numbers).given_speed(v, np.array([probability]), np.array([0.5]))["r1_m"][0]
    free, low, high = gap_distribution(v)
    assert (free.cdf(found) - low) / (high - low) == pytest.approx(probability, abs=1e-9)


@given(inside_v, open_unit, open_unit)
def test_rates_invert_their_distribution_beyond_three_seconds_to_collision(v, gap_u, probability):
    state = InitialStates(environment().numbers).given_speed(v, np.array([gap_u]), np.array([probability]))[0]
    free = rate_distribution(v, state["r1_m"])
    low = free.cdf(-state["r1_m"] / 3.0)
    assert (free.cdf(state["r1dot_mps"]) - low) / (1.0 - low) == pytest.approx(probability, abs=1e-9)
