"""The chain itself: backward induction against enumeration and plain sampling, and the identities of its samplers."""

import numpy as np
import pytest

from studies.case_study.theorems import small_chains
from studies.chains.chain import REPLAYED, enumerate_episodes, overtaking
from studies.chains.shells import ChainShells, joint_outcomes

IMMEDIATE = overtaking("immediate", skill=0.6, level=0.05, horizon=4, surrogates=[0.6, 0.3], challenge="immediate")


@pytest.mark.parametrize("chain", [*small_chains(), IMMEDIATE], ids=lambda c: c.name)
def test_backward_induction_is_the_sum_over_all_episodes(chain):
    episodes = enumerate_episodes(chain)
    assert episodes.p.sum() == pytest.approx(1.0, rel=1e-12)
    assert episodes.p @ episodes.crash == pytest.approx(chain.crash_rate, rel=1e-11)


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
