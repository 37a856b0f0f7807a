"""Every estimator within four standard errors of the truth, on chains from 1e-3 to 1e-9.

Four standard errors miss with probability 6e-5 per check, some 0.2 % for the whole panel.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.estimators.estimate import Estimate
from harness.estimators.one_pass import one_pass
from harness.estimators.weighted import Nade
from studies.chains.chain import DECISIVE, PANEL
from studies.chains.sampler import Sampler, blocks
from tests.chains.seed import SEED
from tests.estimators.small_blocks import fed

SIZES = [5_000] * 12
METHODS = {
    "nde": {"nde", "nade"},
    "forced": {"nade"},
    "step_mixture": {"nade", "scv"},
    "episode_mixture": {"nade", "mixture_cv"},
}
"""Which estimators its records allow, by method."""


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
        known = [
            (said["mean_weight_cut_in"], chain.cut_in_rate),
            *((mean, 1.0) for mean in said["mean_ratio"].values()),
        ]
        for mean, truth in known:
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
