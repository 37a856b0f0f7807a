"""`martingale`: weighted crashes, less what luck at the control steps did to them.

At control step t the term W_{t-1} V_j(s_t)(q_{j,t}/q_{α,t} - 1) has mean 0 given all that came before, because W_{t-1}
and V_j(s_t) are known then and the maneuver is drawn from q_{α,t} (for the episode mixture: the predictive mixture,
with the components' posterior weights). So its sum over an episode, stored for each surrogate, has mean exactly 0
whatever the AV does. With a surrogate like the AV it follows the expected crash, step by step, and takes its luck out
of Y.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from harness.campaign.models import EstimatorName
from harness.estimators.accumulator import require_episodes
from harness.estimators.block import Block
from harness.estimators.cross_fit import CrossFit
from harness.estimators.estimate import Estimate
from harness.estimators.weighted_sums import FEW_FOR_RESIDUALS, WeightedSums, weighted_estimate

RESIDUALS = (
    "the interval comes from regression residuals: what is left of the variance may sit in tests that have not been "
    "met yet, so never stop a campaign on it"
)
PLAIN = (
    "too few {what} for an interval from regression residuals: it is as wide as that of the plain mean of weighted "
    "crashes"
)


class Martingale:
    """Cross-fitted regression of Y on the stored martingale sums."""

    name: ClassVar[EstimatorName] = "martingale"

    def __init__(self) -> None:
        self.sums = WeightedSums()
        self._fit: CrossFit | None = None

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Needs surrogates that controlled the tests, and the sums on record."""
        if block.method not in ("step_mixture", "episode_mixture"):
            return f"needs step_mixture or episode_mixture: under {block.method} no surrogate controls anything"
        if block.martingale is None:
            return "needs the column martingale of the episodes table, which these records do not have"
        return None

    def add(self, block: Block) -> None:
        """Fold one block's rows into the factors, in index order."""
        if block.martingale is None:
            raise ValueError("the block has no martingale sums")
        self.sums.add(block)
        self._fit = self._fit or CrossFit(block.martingale.shape[1])
        self._fit.add(block.first_episode, block.martingale, block.weighted_crashes())

    def result(self, confidence: float) -> Estimate:
        """Mean of Y less the fitted martingale terms."""
        require_episodes(self.sums.n)
        assert self._fit is not None
        zeros = np.zeros(self._fit.n_columns)
        found = self._fit.result(zeros, np.diag(zeros))
        plain = self.sums.y.std_error(self.sums.n)
        trusted = self.sums.is_settled() and self.sums.n_effective() >= FEW_FOR_RESIDUALS
        own = trusted or found.std_error >= plain
        return weighted_estimate(
            self.sums,
            found.rate,
            found.std_error if own else plain,
            confidence,
            third_moment=found.third_moment if own else self.sums.y.third_moment(self.sums.n),
            method="mean of weighted crashes with martingale terms of mean 0, cross-fitted in ten folds",
            warnings=[RESIDUALS if trusted else PLAIN.format(what="crashes")],
            details={
                "beta": found.beta.tolist(),
                "residual_std_error": found.std_error,
                "plain_mean": self.sums.mean(),
                "plain_std_error": plain,
            },
        )
