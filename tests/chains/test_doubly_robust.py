"""What surrogates predict has mean 0 once it is taken off again, exactly; and the estimate that takes it off."""

import itertools

import numpy as np
import pytest

from harness.campaign.files import load_campaign
from harness.campaign.sections import LEAST_TESTS
from harness.errors import CampaignError
from harness.estimators.doubly_robust import FOLDS, DoublyRobust
from harness.estimators.estimate import Unavailable
from harness.estimators.limits import skewed_distances
from harness.estimators.one_pass import one_pass
from harness.estimators.weighted import Nade
from harness.sampling.protocol import KnownRounds
from studies.case_study.theorems import small_chains
from studies.chains.chain import CHAINS, DECISIVE, decisive, enumerate_episodes, overtaking
from studies.chains.sampler import Sampler, draw
from tests.chains import SEED
from tests.estimators.small_blocks import blocks, fed

IMMEDIATE = overtaking("immediate", skill=0.6, level=0.05, horizon=4, surrogates=[0.6, 0.3], challenge="immediate")
NOISY = overtaking("noisy", skill=0.6, level=0.05, horizon=4, surrogates=[0.6, 0.3], epsilon=0.5)
CERTAIN = decisive("certain", skill=0.3, level=0.05, horizon=4, brake=0.2, surrogates=[0.3, 0.9], epsilon=0.9)


def exactly(chain, of_episodes, value=None):
    """Probabilities of all episodes under a mixture, their weights, and D_j, with other V_j than the chain's own."""
    episodes = enumerate_episodes(chain)
    so_far = np.cumprod(episodes.ratios, axis=1).mean(axis=2) if of_episodes else None
    sampled = np.cumprod(episodes.ratios.mean(axis=2), axis=1) if so_far is None else so_far
    weight = np.concatenate([np.ones((len(sampled), 1)), 1.0 / sampled], axis=1)[:, :, None]
    v = episodes.value if value is None else value(episodes)
    d = (weight[:, 1:] * episodes.challenge - weight[:, :-1] * v).sum(axis=1)
    return episodes.p * sampled[:, -1], weight[:, -1, 0] * episodes.crash, d


@pytest.mark.parametrize("of_episodes", [False, True])
@pytest.mark.parametrize("chain", [*small_chains(), IMMEDIATE, NOISY, CERTAIN], ids=lambda c: c.name)
def test_the_mean_over_all_episodes_is_zero(chain, of_episodes):
    """And their sum is what backward induction says."""
    p, y, d = exactly(chain, of_episodes)
    assert p.sum() == pytest.approx(1.0, rel=1e-12)
    assert p @ y == pytest.approx(chain.crash_rate, rel=1e-11)
    assert np.abs(d).max() > 0.0
    assert np.all(np.abs(p @ d) <= 1e-12 * (p @ np.abs(d)))


@pytest.mark.parametrize("of_episodes", [False, True])
def test_a_value_that_is_not_what_the_surrogate_predicts_is_seen(of_episodes):
    """Another surrogate's, or that of the next step: then the mean is another, by far more than rounding."""
    for wrong in (lambda e: e.value[:, :, ::-1], lambda e: np.roll(e.value, -1, axis=1)):
        p, _, d = exactly(NOISY, of_episodes, wrong)
        assert np.all(np.abs(p @ d) > 1e-3 * (p @ np.abs(d)))


def test_the_mean_over_tests_with_as_many_control_steps_is_not_zero():
    """So a β of each number of control steps, as `scv` has them, is biased."""
    steps, (p, _, d) = enumerate_episodes(NOISY).n_control_steps, exactly(NOISY, of_episodes=False)
    by_steps = np.array([np.bincount(steps, p * each) for each in d.T])
    assert np.all(np.abs(by_steps).max(axis=1) > 0.01 * (p @ np.abs(d)))


def test_a_surrogate_that_is_the_vehicle_leaves_less():
    """What is left is the first V, and what the vehicle's own luck, in which no maneuver has a part, makes of it."""
    p, y, d = exactly(CERTAIN, of_episodes=False)
    left = [p @ (y - each) ** 2 - CERTAIN.crash_rate**2 for each in (0.0, *d.T)]
    assert left[1] < 0.9 * left[0]


@pytest.mark.parametrize("method", ["step_mixture", "episode_mixture"])
@pytest.mark.parametrize("chain", [CHAINS["one surrogate right"], *DECISIVE], ids=lambda c: c.name)
def test_sampled_sums_have_mean_zero(chain, method):
    some = draw(chain, method, 20_000, np.random.default_rng(SEED))
    d = some.martingale
    assert np.all(np.abs(d.mean(axis=0)) < 4.0 * d.std(axis=0) / np.sqrt(len(d)))


class OfTheNext(Sampler):
    """Mutant: V as another surrogate has it."""

    def predicted(self, p, challenge):
        return super().predicted(p, challenge)[:, ::-1]


def test_wrong_predictions_are_caught():
    chain = CHAINS["frequent"]
    wrong = OfTheNext(chain, "step_mixture", 60_000, np.random.default_rng(SEED)).run(0)
    estimate = fed(DoublyRobust(), [wrong]).result(0.9)
    d = wrong.martingale
    assert np.abs(d.mean(axis=0) / d.std(axis=0)).max() * np.sqrt(len(d)) > 8.0
    assert abs(estimate.crash_rate - chain.crash_rate) > 8.0 * estimate.std_error


def by_hand(some):
    """β of each fold (5, J), and what is left of Y, from plain sums over the other folds."""
    y, d = some.weighted_crashes(), some.martingale
    fold = (some.first_episode + np.arange(len(y))) % FOLDS
    shares = np.zeros((FOLDS, d.shape[1]))
    for k in range(FOLDS):
        others = fold != k
        with_y = (y[others] - y[others].mean()) @ d[others]
        squares = (d[others] ** 2).sum(axis=0)
        beta = np.clip(with_y / squares, 0.0, 1.0)
        left = [
            ((y[others] - y[others].mean() - b * each) ** 2).sum() for b, each in zip(beta, d[others].T, strict=True)
        ]
        j = int(np.argmin(left))
        shares[k, j] = beta[j]
    return shares, y - (shares[fold] * d).sum(axis=1)


@pytest.mark.parametrize("cuts", [[0, 3_000], [0, 1, 2, 7, 1_204, 3_000]])
def test_it_is_what_the_other_folds_leave(cuts):
    (whole,) = blocks(DECISIVE[0], "step_mixture", [3_000], SEED)
    estimate = fed(DoublyRobust(), [whole.take(slice(a, b)) for a, b in itertools.pairwise(cuts)]).result(0.9)
    shares, left = by_hand(whole)
    assert estimate.crash_rate == pytest.approx(left.mean(), rel=1e-10)
    assert estimate.std_error == pytest.approx(left.std(ddof=1) / np.sqrt(3_000), rel=1e-9)
    np.testing.assert_allclose(estimate.details["beta"], shares.mean(axis=0), rtol=1e-9)
    third = np.sum((left - left.mean()) ** 3) / 3_000**3
    below, above = skewed_distances(estimate.std_error, third, 0.05)
    assert (estimate.crash_rate - estimate.ci_low, estimate.ci_high - estimate.crash_rate) == pytest.approx(
        (below, above)
    )
    assert estimate.std_error < 0.95 * estimate.details["plain_std_error"]


def test_while_few_crashes_count_it_is_as_wide_as_the_plain_mean():
    (whole,) = blocks(DECISIVE[0], "step_mixture", [60], SEED)
    estimate, plain = fed(DoublyRobust(), [whole]).result(0.9), fed(Nade(), [whole]).result(0.9)
    assert plain.n_effective < 30.0
    assert estimate.std_error == plain.std_error > estimate.details["residual_std_error"]
    assert "plain_width" in [each.key for each in estimate.warnings]


def test_it_is_refused_below_the_tests_from_which_on_it_covers():
    least = LEAST_TESTS["dr"]
    few, enough = (one_pass(blocks(DECISIVE[0], "step_mixture", [n], SEED)).estimates["dr"] for n in (least - 1, least))
    assert isinstance(few, Unavailable)
    assert (few.why.key, few.why.numbers) == ("needs_tests", {"n": least - 1, "least": least})
    assert enough.n_episodes == least


def test_where_it_answers_it_is_refused_before_a_test_and_looked_at_from_there_on():
    asked = ["testing={method: episode_mixture, estimator: dr}", "environment.parameters=ndd-overtaking-1"]
    small = ["run.shard_size=100", "stop={rhw: 0.5, below_reference: null, episodes: 1999}"]
    assert KnownRounds(load_campaign("idm", [*asked, *small])).rule.looks[0] == LEAST_TESTS["dr"]
    with pytest.raises(CampaignError, match=r"stop\.episodes.*999, with testing\.estimator dr.*at least 1,000"):
        load_campaign("idm", [*asked, *small, "stop.episodes=999"])
    with pytest.raises(CampaignError, match=r"dr, with 999 tests.*--resume"):  # of a run that was interrupted
        one_pass(blocks(DECISIVE[0], "step_mixture", [999], SEED), best="dr")


def test_a_crash_that_is_due_and_was_not_drawn_is_said():
    """One path on which the surrogate predicts a crash as heavy as all that were drawn together, and none came."""
    (some,) = blocks(DECISIVE[0], "step_mixture", [3_000], SEED)
    assert "due_not_drawn" not in [each.key for each in fed(DoublyRobust(), [some]).result(0.9).warnings]
    quiet = int(np.flatnonzero(some.weighted_crashes() == 0.0)[0])
    some.martingale[quiet] = -some.weighted_crashes().sum()
    assert "due_not_drawn" in [each.key for each in fed(DoublyRobust(), [some]).result(0.9).warnings]
