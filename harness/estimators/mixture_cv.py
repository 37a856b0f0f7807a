"""`mixture_cv`: weighted crashes with the episode mixture's exactly known-mean control variates.

Under q_alpha(x) = Σ_j alpha_j q_j(x) over whole episodes, h_j(x) = q_j(x)/q_alpha(x) - 1 has mean exactly 0, whatever
the AV does. Regressing Y on [1, h_1 … h_M], with the columns *not* centred by their sample means, makes the intercept
the estimate: it moves away from the plain mean by what the sample means of the h_j show to be luck. Its variance is at
most min_j σ²_j/(n alpha_j) up to the estimation of β ([paper] Lemma 1, which is Theorem 2 of Owen and Zhou).
"""

from __future__ import annotations

import math

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, require_episodes
from harness.estimators.moments import ThirdMoments
from harness.estimators.nade import FEW_FOR_RESIDUALS, WeightedSums, weighted_estimate
from harness.estimators.triangular_factor import empty_factor, fold_rows
from harness.vocabulary import FloatArray


class MixtureCv:
    """Triangular factor and third moments of [1, H, Y], at most (M + 2)³ numbers however many episodes."""

    def __init__(self) -> None:
        self.sums = WeightedSums()
        self._factor: FloatArray | None = None
        self._cubes: ThirdMoments | None = None

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Only the episode mixture has few control variates whose means are known and whose values are bounded."""
        if block.method == "step_mixture":
            return (
                "needs the episode mixture: under the step mixture the products of q_j/q_alpha have mean 1 too, "
                "but tails too heavy for a regression"
            )
        if block.method != "episode_mixture":
            return f"needs the episode mixture; {block.method} draws from a single distribution"
        return None

    def add(self, block: Block) -> None:
        """Fold one block's rows into the factor, in index order."""
        self.sums.add(block)
        ones = np.ones((len(block), 1))
        columns = [ones, block.mixture_ratios() - 1.0, block.weighted_crashes()[:, None]]
        rows = np.asfortranarray(np.concatenate(columns, axis=1))
        self._factor = empty_factor(rows.shape[1]) if self._factor is None else self._factor
        self._cubes = self._cubes or ThirdMoments(rows.shape[1])
        self._cubes.add(rows)
        fold_rows(self._factor, rows)

    def result(self, confidence: float) -> Estimate:
        """Intercept of the regression, with the residual variance if crashes are many, else the plain mean's."""
        n, y = self.sums.n, self.sums.y
        require_episodes(n)
        assert self._factor is not None
        assert self._cubes is not None
        coefficients, rank, variance = _regression(self._factor, n)
        residual = std_error = math.sqrt(variance)
        third_moment = self._cubes.of(np.array([*-coefficients, 1.0])) / n**3
        plain, warnings = y.std_error(n), []
        if self.sums.n_crashes and y.n_effective < FEW_FOR_RESIDUALS and residual < plain:
            std_error, third_moment = plain, y.third_moment(n)
            warnings.append(
                f"fewer than {FEW_FOR_RESIDUALS:.0f} effective crashes: the interval is as wide as that of the plain "
                "mean of weighted crashes"
            )
        return weighted_estimate(
            self.sums,
            float(coefficients[0]),
            std_error,
            confidence,
            third_moment=third_moment,
            method="mean of weighted crashes with the episode mixture's known-mean control variates",
            warnings=warnings,
            details={
                "beta": coefficients[1:].tolist(),
                "rank": rank,
                "residual_std_error": residual,
                "plain_mean": y.mean(n),
                "plain_std_error": plain,
            },
        )


def _regression(factor: FloatArray, n: int) -> tuple[FloatArray, int, float]:
    """Least squares of Y on [1, H], of the smallest norm where columns depend on each other.

    Parameters
    ----------
    factor : (k, k) float64
        Upper triangular factor of [1, H, Y].
    n : int
        Rows behind the factor; it scales the tolerance for the rank (Σ_j alpha_j h_j = 0 always costs one).

    Returns
    -------
    Intercept and β, shape (1 + M,); rank of [1, H]; variance of the intercept from that of the residuals.
    """
    design, target = factor[:-1, :-1], factor[:-1, -1]
    left, singular, right = np.linalg.svd(design)
    kept = singular > max(n, len(design)) * np.finfo(np.float64).eps * singular[0]
    projected = left.T @ target
    coefficients = right[kept].T @ (projected[kept] / singular[kept])
    residual_squares = float(factor[-1, -1] ** 2 + np.sum(projected[~kept] ** 2))
    leverage = float(np.sum((right[kept, 0] / singular[kept]) ** 2))  # of the intercept, [(XᵀX)⁺]_00
    rank = int(np.count_nonzero(kept))
    variance = residual_squares / (n - rank) * leverage if n > rank else math.inf
    return coefficients, rank, variance
