"""`replay`: weighted crashes, corrected by what surrogates of known crash rate did on the very same traffic.

Any surrogate k can be driven in the twin on a stored test's traffic. Its weighted crashes W f_k have the mean μ_k
whatever the tests were drawn from and whatever the AV under test is; how far their sample mean is from μ_k shows the
luck of the draw. μ_k comes from the pool, with its own error.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from harness.arrays import BoolArray, FloatArray
from harness.campaign.models import EstimatorName
from harness.estimators.accumulator import require_episodes
from harness.estimators.block import Block
from harness.estimators.cross_fit import CrossFit
from harness.estimators.estimate import Estimate
from harness.estimators.martingale import PLAIN, RESIDUALS
from harness.estimators.weighted_sums import FEW_EFFECTIVE, WeightedSums, weighted_estimate
from harness.pool.surrogate_replay import KnownRates

UNBOUNDED = (
    "under the step mixture the surrogates' weighted crashes are not bounded either: with few tests their rare large "
    "values can make this worse than the plain mean"
)


class Replay:
    """Cross-fitted regression of Y on the weighted crashes of surrogates that crash in ordinary traffic.

    Attributes
    ----------
    n_lost : int
        Failed tests without a cut-in, whose traffic is not known to the end.
    """

    name: ClassVar[EstimatorName] = "replay"

    def __init__(self) -> None:
        self.sums = WeightedSums()
        self.n_lost = 0
        self._known: KnownRates | None = None
        self._fit: CrossFit | None = None
        self._residuals = ResidualSums()

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Needs tests whose weights mean something, and that surrogates have been asked about."""
        if block.method == "shells":
            return "needs weighted tests: those drawn from shells have used the surrogates' outcomes already"
        if block.surrogates_crash is None or block.known_rates is None:
            return "needs a replay of surrogates, for which there is no pool of cut-ins"
        return None

    def add(self, block: Block) -> None:
        """Fold one block's rows into the factors, in index order."""
        if block.surrogates_crash is None or block.known_rates is None:
            raise ValueError("the block has no replayed surrogates")
        self.sums.add(block)
        self.n_lost += int(np.count_nonzero(block.failed & ~block.cut_in))
        self._known = block.known_rates
        used = block.known_rates.ordinary
        self._fit = self._fit or CrossFit(int(np.count_nonzero(used)))
        self._fit.add(block.first_episode, weighted_surrogates(block)[:, used], block.weighted_crashes())
        self._residuals.add(block)

    def result(self, confidence: float) -> Estimate:
        """Mean of Y less the fitted surprise of the surrogates, with the error of their rates."""
        require_episodes(self.sums.n)
        assert self._fit is not None
        assert self._known is not None
        used = self._known.ordinary
        found = self._fit.result(self._known.mu[used], self._known.covariance[np.ix_(used, used)])
        beta = np.zeros(len(used))
        beta[used] = found.beta
        plain = self.sums.y.std_error(self.sums.n)
        disagreements = self._residuals.n_effective(beta)
        trusted = self.sums.is_settled() and disagreements >= FEW_EFFECTIVE
        own = trusted or found.std_error >= plain
        warnings = [RESIDUALS if trusted else PLAIN.format(what="crashes, or disagreements with the surrogates,")]
        if self.sums.method == "step_mixture":
            warnings.append(UNBOUNDED)
        cautions = []
        if self.n_lost:
            cautions.append(f"{self.n_lost} failed tests have no cut-in, and surrogates count as not crashing in them")
        details: dict[str, Any] = {
            "pool": self._known.pool,
            "beta": dict(zip(self._known.names, beta.tolist(), strict=True)),
            "residual_std_error": found.std_error,
            "n_effective_residuals": disagreements,
            "share_of_variance_from_pool": found.known_share,
            "plain_mean": self.sums.mean(),
            "plain_std_error": plain,
        }
        return weighted_estimate(
            self.sums,
            found.rate,
            found.std_error if own else plain,
            confidence,
            third_moment=found.third_moment if own else self.sums.y.third_moment(self.sums.n),
            method="mean of weighted crashes with replayed surrogates of known crash rate, cross-fitted in ten folds",
            warnings=warnings,
            cautions=cautions,
            details=details,
        )


def weighted_surrogates(block: Block) -> FloatArray:
    """Weighted crashes W f_k of the surrogates, shape (n, D); 0 where none crashes, whatever the weight."""
    crashes = block.surrogates_crash
    assert crashes is not None
    rows = crashes.any(axis=1)
    values = np.zeros(crashes.shape)
    values[rows] = np.exp(block.log_weight[rows])[:, None] * crashes[rows]
    return values


class ResidualSums:
    """Sums of W² and W⁴ by who crashed: few patterns occur, and within one all residuals are W times one number."""

    DISAGREEMENT = 0.1
    """Residuals below this many crashes are not a disagreement but an inexact coefficient."""

    def __init__(self) -> None:
        self._sums: dict[bytes, FloatArray] = {}

    def add(self, block: Block) -> None:
        """Add one block."""
        assert block.surrogates_crash is not None
        who: BoolArray = np.column_stack([block.crash, block.surrogates_crash])
        rows = who.any(axis=1)
        squares = np.exp(2.0 * block.log_weight[rows])
        patterns, which = np.unique(who[rows], axis=0, return_inverse=True)
        second = np.bincount(which.ravel(), squares, minlength=len(patterns))
        fourth = np.bincount(which.ravel(), squares * squares, minlength=len(patterns))
        for pattern, *sums in zip(patterns, second, fourth, strict=True):
            self._add(pattern.tobytes(), np.array(sums))

    def _add(self, pattern: bytes, sums: FloatArray) -> None:
        self._sums[pattern] = self._sums.get(pattern, np.zeros(2)) + sums

    def n_effective(self, beta: FloatArray) -> float:
        """(Σz²)²/Σz⁴ of the residuals z = W (1{crash} - βᵀf): how many tests carry what f does not explain."""
        second = fourth = 0.0
        for pattern, sums in self._sums.items():
            crash, *surrogates = np.frombuffer(pattern, np.bool_).astype(np.float64)
            size = float(crash - beta @ np.array(surrogates))
            if abs(size) > self.DISAGREEMENT:
                second += size**2 * sums[0]
                fourth += size**4 * sums[1]
        return float(second**2 / fourth) if fourth > 0.0 else 0.0
