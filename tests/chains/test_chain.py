"""The chain itself: backward induction against enumeration and plain sampling, and the identities of its samplers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.studies.chains.enumeration import enumerate_episodes
from harness.studies.chains.named import frequent_decisive, overtaking, panel, rare_decisive
from harness.studies.chains.sampler import draw

from .seed import SEED


def small() -> list:
    return [
        overtaking("small", skill=0.6, surrogates=[0.6, 0.3], level=0.05, horizon=4),
        overtaking("immediate", skill=0.6, surrogates=[0.6, 0.3], level=0.05, horizon=4, challenge="immediate"),
        rare_decisive(),
    ]


def test_crash_rates_span_the_rare_range():
    rates = [chain.crash_rate for chain in panel()]
    assert max(rates) > 1e-3
    assert min(rates) < 1e-8


@pytest.mark.parametrize("chain", small(), ids=lambda c: c.name)
def test_backward_induction_is_the_sum_over_all_episodes(chain):
    episodes = enumerate_episodes(chain)
    assert episodes.p.sum() == pytest.approx(1.0, rel=1e-12)
    assert episodes.p @ episodes.crash == pytest.approx(chain.crash_rate, rel=1e-11)


@pytest.mark.parametrize("chain", panel(), ids=lambda c: c.name)
def test_importance_functions_sum_to_one_and_have_mean_ratio_one(chain):
    maneuver = chain.proposals.maneuver
    np.testing.assert_allclose(maneuver.sum(axis=-1), 1.0, rtol=1e-12)
    np.testing.assert_allclose((maneuver * (chain.exposure / maneuver)).sum(axis=-1), 1.0, rtol=1e-12)
    assert np.all((chain.proposals.cut >= 0.0) & (chain.proposals.cut <= 1.0))


def test_plain_sampling_gives_the_induced_crash_rate():
    chain = frequent_decisive()
    block = draw(chain, "nde", 200_000, np.random.default_rng(SEED))
    assert binomtest(int(block.crash.sum()), 200_000, chain.crash_rate).pvalue > 1e-4
    assert binomtest(int(block.cut_in.sum()), 200_000, chain.cut_in_rate).pvalue > 1e-4


@pytest.mark.parametrize("method", ["nde", "step_mixture"])
def test_without_control_the_log_weight_is_exactly_zero(method):
    block = draw(panel()[3], method, 20_000, np.random.default_rng(SEED))
    free = block.n_control_steps == 0
    assert np.all(block.log_weight[free] == 0.0)
    assert np.all(block.log_q[free] == 0.0)


def test_forced_weights_are_the_probability_of_a_cut_in_on_the_path():
    chain = panel()[1]
    block = draw(chain, "forced", 5_000, np.random.default_rng(SEED))
    assert block.cut_in.all()
    assert np.all(block.log_weight == block.log_p_cut_in)
    assert block.weighted_crashes().max() <= chain.cut_in_cap


def test_defensive_mixture_bounds_every_weighted_crash():
    chain = panel()[2]
    block = draw(chain, "episode_mixture", 50_000, np.random.default_rng(SEED))
    bound = np.exp(block.log_p_cut_in) / block.alpha[0]
    assert np.all(block.weighted_crashes() <= bound * (1.0 + 1e-12))


def test_exact_variance_of_the_step_mixture_is_that_of_replications():
    chain = frequent_decisive()
    y = draw(chain, "step_mixture", 400_000, np.random.default_rng(SEED)).weighted_crashes()
    assert y.var() == pytest.approx(chain.step_mixture_variance, rel=0.03)
