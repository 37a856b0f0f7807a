"""The paper's theory, by exact enumeration: Lemma 1's bound, Theorem 3's zero variance, unbiasedness of the columns."""

from __future__ import annotations

import numpy as np
import pytest

from harness.estimators.mixture_cv import MixtureCv
from harness.estimators.scv import Scv
from harness.studies.chains.enumeration import enumerate_episodes
from harness.studies.chains.named import overtaking, rare_decisive
from harness.studies.chains.single_choice import with_optimal_function

from .seed import SEED

SMALL = [
    overtaking("right and wrong", skill=0.6, surrogates=[0.6, 0.2], level=0.05, horizon=4),
    overtaking("all wrong", skill=0.9, surrogates=[0.1, 0.3], level=1e-4, horizon=4),
    rare_decisive(),
]


def best_variance(episodes) -> float:
    """Var(Y - h_β*) per test, with β* the population minimiser."""
    y = episodes.crash / episodes.mixture
    h = episodes.ratios / episodes.mixture[:, None] - 1.0
    mean = episodes.expect(y)
    covariance = episodes.expect(h * (y - mean)[:, None])
    return float(
        episodes.expect((y - mean) ** 2) - covariance @ np.linalg.pinv(second_moments(episodes, h)) @ covariance
    )


def second_moments(episodes, h):
    return (h * (episodes.p * episodes.mixture)[:, None]).T @ h


@pytest.mark.parametrize("chain", SMALL, ids=lambda c: c.name)
def test_control_variates_of_whole_episodes_have_mean_zero(chain):
    episodes = enumerate_episodes(chain)
    assert episodes.p @ episodes.mixture == pytest.approx(1.0, rel=1e-11)
    np.testing.assert_allclose(episodes.expect(episodes.ratios / episodes.mixture[:, None] - 1.0), 0.0, atol=1e-11)
    assert episodes.expect(episodes.crash / episodes.mixture) == pytest.approx(chain.crash_rate, rel=1e-11)


@pytest.mark.parametrize("chain", SMALL, ids=lambda c: c.name)
def test_lemma_1_bounds_the_variance_by_that_of_the_best_component(chain):
    episodes = enumerate_episodes(chain)
    crashes = episodes.crash
    single = (episodes.p * crashes) @ (1.0 / np.where(crashes[:, None], episodes.ratios, 1.0)) - chain.crash_rate**2
    plain = float(episodes.expect((crashes / episodes.mixture) ** 2)) - chain.crash_rate**2
    best = best_variance(episodes)
    assert best <= np.min(single / episodes.alpha) * (1.0 + 1e-9)
    assert best <= plain * (1.0 + 1e-9)


def test_theorem_3_with_known_means_the_error_is_zero():
    """One control step that decides, and one optimal q_j: the regression with known means returns μ itself."""
    world = with_optimal_function()
    state = MixtureCv()
    state.add(world.draw("episode_mixture", 2_000, np.random.default_rng(SEED)))
    estimate = state.result(0.9)
    assert estimate.crash_rate == pytest.approx(world.crash_rate, rel=1e-12)
    assert estimate.std_error < 1e-12 * world.crash_rate
    assert estimate.details["plain_mean"] != pytest.approx(world.crash_rate, rel=1e-3)


def test_theorem_3_with_sample_means_the_claim_is_zero_but_the_error_is_not():
    """Algorithm 1 on the same world: it claims no variance at all, and returns the plain mean, 2 % off and more."""
    world = with_optimal_function()
    rates = []
    for k in range(50):
        state = Scv()
        state.add(world.draw("step_mixture", 2_000, np.random.default_rng([SEED, k])))
        estimate = state.result(0.9)
        rates.append(estimate.crash_rate)
        assert estimate.std_error < 1e-12 * world.crash_rate
    assert np.std(rates) > 0.01 * world.crash_rate
