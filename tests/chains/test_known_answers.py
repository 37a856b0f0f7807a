"""Every estimator within four standard errors of the truth, on chains from 1e-3 to 1e-9.

Four standard errors miss with probability 6e-5 per check, some 0.2 % for the whole panel.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.estimators.block import Block
from harness.estimators.estimate import Accumulator, Estimate
from harness.estimators.one_pass import one_pass
from harness.estimators.scv import MixtureCv, Scv
from harness.estimators.weighted import Nade
from studies.chains.chain import DECISIVE, PANEL, REPLAYED, Chain
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


@pytest.mark.slow
def test_known_mean_control_variates_cover_on_a_chain():
    chain = DECISIVE[0]
    one = {"mixture_cv": MixtureCv}
    found = replicate(lambda rng: draw(chain, "episode_mixture", N, rng), 12, one, chain.crash_rate)
    assert covers(found["mixture_cv"]["covered"])


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
