"""What the intervals are worth, by replication: nade's covers, the published scv's does not, mutants are caught.

Seeds are fixed, so that the outcome is too. Each `binomtest` would reject a correct 90 % interval with probability
1e-4; the defect must show at 1e-9.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.estimators.block import Block
from harness.estimators.estimate import Accumulator
from harness.estimators.scv import MixtureCv, Scv
from harness.estimators.weighted import Nade
from studies.chains.chain import DECISIVE
from studies.chains.sampler import draw, with_optimal_function
from studies.replication.judgement import Judgement, Subject, estimate_row, judge
from studies.replication.populations import Known
from tests.estimators.small_blocks import fed

REPLICATIONS = 200
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


def test_known_mean_control_variates_cover_on_a_chain():
    chain = DECISIVE[0]
    one = {"mixture_cv": MixtureCv}
    found = replicate(lambda rng: draw(chain, "episode_mixture", N, rng), 12, one, chain.crash_rate)
    assert covers(found["mixture_cv"]["covered"])
