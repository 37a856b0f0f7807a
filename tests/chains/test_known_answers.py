"""Every estimator within four standard errors of the truth, on chains from 1e-3 to 1e-9.

Four standard errors miss with probability 6e-5 per check, some 0.2 % for the whole panel.
"""

import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.campaign.files import load_campaign
from harness.campaign.sections import LEAST_TESTS
from harness.errors import CampaignError
from harness.estimators.block import Block
from harness.estimators.doubly_robust import FOLDS, DoublyRobust
from harness.estimators.estimate import Accumulator, Estimate, Unavailable
from harness.estimators.limits import skewed_distances
from harness.estimators.one_pass import one_pass
from harness.estimators.scv import MixtureCv, Scv
from harness.estimators.weighted import Nade
from harness.sampling.protocol import KnownTests
from studies.case_study.theorems import small_chains
from studies.chains.chain import CHAINS, DECISIVE, PANEL, REPLAYED, Chain, decisive, enumerate_episodes, overtaking
from studies.chains.sampler import Sampler, draw, with_optimal_function
from studies.chains.shells import ChainShells, joint_outcomes
from studies.replication.judgement import Judgement, Subject, estimate_row, judge
from studies.replication.populations import Known
from tests.chains import SEED
from tests.estimators.small_blocks import blocks, fed

SIZES = [5_000] * 6
METHODS = {
    "nde": {"nde", "nade"},
    "forced": {"nade"},
    "step_mixture": {"nade", "dr", "scv"},
    "episode_mixture": {"nade", "mixture_cv", "dr"},
}
"""Which estimators its records allow, by method."""


def cut_in_rate(chain: Chain) -> float:
    """P(cut-in within the horizon)."""
    none = np.ones(len(chain.start))
    for _ in range(chain.horizon):
        none = (1.0 - chain.hazard) * (chain.approach @ none)
    return 1.0 - float(chain.start @ none)


def standard_errors_off(chain, estimate: Estimate, std_error: float | None = None) -> float:
    return abs(estimate.crash_rate - chain.crash_rate) / (estimate.std_error if std_error is None else std_error)


@pytest.mark.parametrize("chain", [*PANEL, *DECISIVE], ids=lambda c: c.name)
@pytest.mark.parametrize("method", METHODS)
def test_estimates_are_right(chain, method):
    done = one_pass(blocks(chain, method, SIZES, SEED))
    found = {name: estimate for name, estimate in done.estimates.items() if isinstance(estimate, Estimate)}
    assert set(found) == METHODS[method]
    if method == "nde":
        assert binomtest(found["nde"].n_crashes, sum(SIZES), chain.crash_rate).pvalue > 6e-5
        assert found["nade"].crash_rate == found["nde"].crash_rate
        return
    known_error = math.sqrt(chain.step_mixture_variance / sum(SIZES)) if method == "step_mixture" else None
    for estimate in found.values():
        assert standard_errors_off(chain, estimate, known_error) < 4.0
        assert estimate.upper_bound > estimate.crash_rate
    if method == "episode_mixture":  # its weights are bounded; no such test exists for the step mixture
        said = done.diagnostics.result()
        known = [(mean, 1.0) for mean in said["mean_ratio"].values()]
        for mean, truth in [(said["mean_weight_event"], cut_in_rate(chain)), *known]:
            assert abs(mean["mean"] - truth) < 4.0 * mean["std_error"]


class ForgetsTheCutIn(Sampler):
    """Mutant: weights without the ratio of the step in which the cut-in was drawn."""

    def _step_before(self, t, rows):
        before = self.log_step.copy()
        super()._step_before(t, rows)
        cut = rows[self.cut_in[rows]]
        self.log_step[cut] = before[cut]


@pytest.mark.parametrize("chain", [PANEL[0], DECISIVE[0]], ids=lambda c: c.name)
def test_a_dropped_ratio_is_caught(chain):
    """The check has teeth: leave the cut-in's own ratio out and the answer is off by far more than four errors."""
    wrong = ForgetsTheCutIn(chain, "step_mixture", sum(SIZES), np.random.default_rng(SEED)).run(0)
    assert standard_errors_off(chain, fed(Nade(), [wrong]).result(0.9)) > 8.0


# -- what the intervals are worth, by replication: mutants are caught --


REPLICATIONS = 100
N = 2_000


def replicate(
    draw: Callable[[np.random.Generator], Block], seed: int, make: Mapping[str, type[Accumulator]], truth: float
) -> dict[str, Judgement]:
    """Give the same data, drawn anew for each replication, to every estimator, and judge their 90 % intervals."""
    drawn = [draw(np.random.default_rng([seed, k])) for k in range(REPLICATIONS)]
    rows = {
        name: [estimate_row(name, k, fed(new(), [block]).result(0.9), reached=False) for k, block in enumerate(drawn)]
        for name, new in make.items()
    }
    return {name: judge(Subject("", Known.exactly(truth)), name, of_name, 0.9) for name, of_name in rows.items()}


def covers(covered: int) -> bool:
    return binomtest(covered, REPLICATIONS, 0.9).pvalue > 1e-4


@pytest.mark.parametrize("chain", DECISIVE, ids=lambda c: c.name)
def test_nade_covers_and_the_published_scv_does_not(chain):
    both = {"nade": Nade, "scv": Scv}
    nade, scv = replicate(lambda rng: draw(chain, "step_mixture", N, rng), 11, both, chain.crash_rate).values()
    assert scv["bias"] == pytest.approx(nade["bias"], abs=1e-12)
    assert covers(nade["covered"])
    assert scv["p_value"] < 1e-9
    assert N * nade["claimed_relvar"] == pytest.approx(chain.step_mixture_variance / chain.crash_rate**2, rel=0.1)
    assert scv["true_relvar"] > 1.5 * scv["claimed_relvar"]


class Centred(Block):
    """The ratios shifted, so that it is their sample means that are 1."""

    def mixture_ratios(self) -> np.ndarray:
        ratios = super().mixture_ratios()
        return ratios - ratios.mean(axis=0) + 1.0


class SampleCentred(MixtureCv):
    """Mutant: the columns centred by their sample means, as in Algorithm 1."""

    def add(self, block: Block) -> None:
        super().add(Centred(**vars(block)))


@pytest.mark.parametrize("tilt", [0.3, 3.0])
def test_known_means_cover_and_sample_means_do_not(tilt):
    """A nearly optimal importance function among others: the gain is real only if the means are known."""
    world = with_optimal_function(tilt)
    both = {"right": MixtureCv, "wrong": SampleCentred}
    found = replicate(lambda rng: world.block("episode_mixture", world.maneuvers(N, rng)), 13, both, world.crash_rate)
    assert covers(found["right"]["covered"])
    assert not covers(found["wrong"]["covered"])


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
    assert source.shell_p.sum() == pytest.approx(cut_in_rate(chain), rel=1e-11)
    assert source.crash_p.sum() == pytest.approx(chain.crash_rate, rel=1e-11)
    drawn = [source.draw(np.random.default_rng([1, k]))[0] for k in range(200)]
    p = np.array([each.design.p for each in drawn])
    crash = np.array([each.design.p * each.share for each in drawn])
    for found, exact in ((p, source.shell_p), (crash, source.crash_p)):
        error = found.std(axis=0) / np.sqrt(len(found))
        assert np.all(np.abs(found.mean(axis=0) - exact) <= 4.5 * error + 1e-18)


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
    assert KnownTests(load_campaign("idm", [*asked, *small])).rule.looks[0] == LEAST_TESTS["dr"]
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
