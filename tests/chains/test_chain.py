"""The chain itself: backward induction against enumeration and plain sampling, and the identities of its samplers."""

from __future__ import annotations

import numpy as np
import pytest

from studies.case_study.theorems import small_chains
from studies.chains.chain import PANEL, REPLAYED, enumerate_episodes, overtaking
from studies.chains.sampler import draw, mixture_weights
from studies.chains.shells import ChainShells, joint_outcomes
from tests.chains.seed import SEED

IMMEDIATE = overtaking("immediate", skill=0.6, level=0.05, horizon=4, surrogates=[0.6, 0.3], challenge="immediate")


@pytest.mark.parametrize("chain", [*small_chains(), IMMEDIATE], ids=lambda c: c.name)
def test_backward_induction_is_the_sum_over_all_episodes(chain):
    episodes = enumerate_episodes(chain)
    assert episodes.p.sum() == pytest.approx(1.0, rel=1e-12)
    assert episodes.p @ episodes.crash == pytest.approx(chain.crash_rate, rel=1e-11)


@pytest.mark.parametrize("chain", small_chains(), ids=lambda c: c.name)
def test_whole_episodes_have_columns_of_mean_zero_and_lemma_1_bounds_their_variance(chain):
    """Episode mixture with the forced cut-in as component 0: by that of the best component, and of no columns."""
    episodes, alpha = enumerate_episodes(chain), mixture_weights(chain, "episode_mixture")
    p, crashes = episodes.p, episodes.crash
    ratios = np.column_stack([episodes.forced, episodes.ratios.prod(axis=1)])
    mixture = ratios @ alpha
    drawn = p * mixture
    assert drawn.sum() == pytest.approx(1.0, rel=1e-11)
    y, h = crashes / mixture, ratios / mixture[:, None] - 1.0
    np.testing.assert_allclose(drawn @ h, 0.0, atol=1e-11)
    assert drawn @ y == pytest.approx(chain.crash_rate, rel=1e-11)
    single = (p * crashes) @ (1.0 / np.where(crashes[:, None], ratios, 1.0)) - chain.crash_rate**2
    plain = drawn @ (y - chain.crash_rate) ** 2
    covariance = drawn @ (h * (y - chain.crash_rate)[:, None])
    best = plain - covariance @ np.linalg.pinv((h * drawn[:, None]).T @ h) @ covariance
    assert best <= np.min(single / alpha) * (1.0 + 1e-9)
    assert best <= plain * (1.0 + 1e-9)


def drawn(chain, method: str, n: int):
    return draw(chain, method, n, np.random.default_rng(SEED))


@pytest.mark.parametrize("method", ["nde", "step_mixture"])
def test_without_control_the_log_weight_is_exactly_zero(method):
    block = drawn(PANEL[3], method, 20_000)
    free = block.n_control_steps == 0
    assert not np.any(block.log_weight[free])
    assert not np.any(block.log_q[free])


def test_weights_are_the_probability_of_a_cut_in_on_the_path_or_bounded_by_it():
    chain = PANEL[1]
    block = drawn(chain, "forced", 5_000)
    assert block.cut_in.all()
    assert np.all(block.log_weight == block.log_p_cut_in)
    assert block.weighted_crashes().max() <= chain.cut_in_cap
    block = drawn(PANEL[2], "episode_mixture", 50_000)
    assert np.all(block.weighted_crashes() <= np.exp(block.log_p_cut_in) / block.drawn.alpha[0] * (1.0 + 1e-12))


# -- vehicles on the same cut-ins: joint outcomes, and shells that they make --


@pytest.fixture(params=REPLAYED, ids=lambda c: c.name)
def chain(request):
    return request.param


def given_a_cut_in(chain, response):
    _, after = chain.values(response)
    return np.stack([chain.entry @ after[t + 1] for t in range(chain.horizon)])


def test_marginals_are_those_of_each_vehicle_alone(chain):
    joint = joint_outcomes(chain)
    np.testing.assert_allclose(joint.sum(axis=(2, 3)), 1.0, rtol=1e-12)
    np.testing.assert_allclose(joint[..., 1].sum(axis=2), given_a_cut_in(chain, chain.response), atol=1e-14)
    masks = np.arange(joint.shape[2])
    for j, response in enumerate(chain.surrogate_responses):
        crashes = joint[:, :, (masks >> j) & 1 == 1].sum(axis=(2, 3))
        np.testing.assert_allclose(crashes, given_a_cut_in(chain, response), atol=1e-14)


def test_with_shared_noise_the_more_skilled_crashes_only_where_the_less_skilled_does():
    joint = joint_outcomes(REPLAYED[0]).sum(axis=3)  # skills 0.8, 0.65, 0.5
    nested = {0b000, 0b100, 0b110, 0b111}
    assert joint[:, :, [mask for mask in range(8) if mask not in nested]].max() < 1e-15


def test_shells_add_up_and_drawn_pools_scatter_around_them(chain):
    source = ChainShells(chain, 512)
    assert source.shell_p.sum() == pytest.approx(chain.cut_in_rate, rel=1e-11)
    assert source.crash_p.sum() == pytest.approx(chain.crash_rate, rel=1e-11)
    drawn = [source.draw(np.random.default_rng([1, k]))[0] for k in range(200)]
    p = np.array([each.design.p for each in drawn])
    crash = np.array([each.design.p * each.share for each in drawn])
    for found, exact in ((p, source.shell_p), (crash, source.crash_p)):
        error = found.std(axis=0) / np.sqrt(len(found))
        assert np.all(np.abs(found.mean(axis=0) - exact) <= 4.5 * error + 1e-18)
