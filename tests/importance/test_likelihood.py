"""Likelihood ratios: the predictive mixture telescopes to the mixture over whole episodes; fixed weights do not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp

from tests.importance.kernels import accumulated

ratio = st.one_of(st.just(0.0), st.floats(1e-6, 1e6))
weights = st.lists(st.floats(0.05, 1.0), min_size=4, max_size=4).map(lambda w: np.array(w) / sum(w))


@st.composite
def sequences(draw, possible=ratio):
    n = draw(st.integers(1, 30))
    ratios = np.array(draw(st.lists(st.lists(possible, min_size=4, max_size=4), min_size=n, max_size=n)))
    ratios[:, 3] = np.maximum(ratios[:, 3], 1e-3)  # what was drawn is possible under some component
    return ratios


def log(x):
    with np.errstate(divide="ignore"):
        return np.log(x)


@given(weights, sequences())
def test_the_episode_mixture_telescopes(alpha, ratios):
    """Π_t Σ_j w_j,t r_j,t with posterior weights is Σ_j α_j Π_t r_j,t: the ratio of whole episodes."""
    log_ratio, _, sampled = accumulated(True, alpha, ratios, np.zeros((len(ratios), 3)))
    np.testing.assert_allclose(log_ratio, log(ratios).sum(axis=0), rtol=1e-12, atol=1e-12)
    assert np.log(sampled).sum() == pytest.approx(logsumexp(log_ratio, b=alpha), rel=1e-10, abs=1e-10)


@given(weights, sequences())
def test_the_step_mixture_is_a_product_of_mixtures(alpha, ratios):
    log_ratio, _, sampled = accumulated(False, alpha, ratios, np.zeros((len(ratios), 3)))
    np.testing.assert_allclose(sampled, ratios @ alpha, rtol=1e-13)
    np.testing.assert_allclose(log_ratio, log(ratios).sum(axis=0), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("of_episodes", [False, True])
@given(weights, sequences(st.floats(0.1, 10.0)), st.integers(0, 2**32 - 1))
def test_martingale_terms(of_episodes, alpha, ratios, seed):
    """Σ_t W_{t-1} V_j (q_j/q_α - 1), W being one over the ratio sampled so far; V = 0 adds nothing."""
    v = np.random.default_rng(seed).random((len(ratios), 3))
    v[::3] = 0.0
    _, martingale, sampled = accumulated(of_episodes, alpha, ratios, v)
    weight_before = np.concatenate([[1.0], 1.0 / np.cumprod(sampled)[:-1]])
    terms = weight_before[:, None] * v * (ratios[:, 1:] / sampled[:, None] - 1.0)
    scale = np.abs(terms).sum(axis=0) + 1e-300
    assert (np.abs(martingale - terms.sum(axis=0)) <= 1e-9 * scale).all()
