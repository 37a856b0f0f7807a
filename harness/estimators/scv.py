"""`scv`: sparse control variates exactly as published ([paper] Algorithm 1), with the warning that they need.

Episodes are stratified by their number of control steps l; within each stratum Y is regressed by SVD on the products
of q_j/q_alpha, centred by the stratum's *sample* mean; the estimate is Σ_l n_l·intercept_l/n and its variance is that
of the pooled residuals Z = Y - H·β. Each l is a stratum of its own, also above nine: there the columns come from the
first nine control steps ([paper] section VI-E), but Algorithm 1 does not pool the strata.

Because sample-centred columns leave the intercept at the stratum's mean of Y, the estimate *is* that of `nade`, while
its claimed variance leaves out the error of the centring. See docs/scv-defect.md.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from harness.arrays import IntArray
from harness.estimators.accumulator import require_episodes
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate
from harness.estimators.scv_columns import Basis, n_columns
from harness.estimators.scv_stratum import CHUNK_ROWS, Stratum
from harness.estimators.threads import side_by_side
from harness.estimators.weighted_sums import WeightedSums, weighted_estimate
from harness.methods import EstimatorName

WARNING = (
    "this interval is known to be too narrow; use nade's (docs/scv-defect.md). The published variance is not that of "
    "this estimator: columns centred by their sample means leave the estimate equal to nade's, and var(Z) leaves out "
    "the error of those means"
)


class Scv:
    """One `Stratum` per number of control steps.

    Parameters
    ----------
    basis : {"reduced", "full"}
        j = 1 … J-1 as in Algorithm 1, or all J functions.
    """

    name: ClassVar[EstimatorName] = "scv"

    def __init__(self, basis: Basis = "reduced") -> None:
        self.basis = basis
        self.sums = WeightedSums()
        self._strata: dict[int, Stratum] = {}

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Needs the step mixture and the ratios of its first control steps."""
        if block.method != "step_mixture":
            return f"is defined for the step mixture ([paper] section III-C), these tests were drawn by {block.method}"
        if block.first_ratios is None:
            return "needs the control steps of every episode: set records.moments to first_9 or all"
        return None

    def add(self, block: Block) -> None:
        """Hand each episode to its stratum, in index order."""
        if block.first_ratios is None:
            raise ValueError("scv needs Block.first_ratios in every block")
        self.sums.add(block)
        y = block.weighted_crashes()
        order = np.argsort(block.n_control_steps, kind="stable")
        strata, starts = np.unique(block.n_control_steps[order], return_index=True)
        first_ratios = block.first_ratios
        parts = list(zip(map(self._stratum, strata.tolist()), np.split(order, starts[1:]), strict=True))
        n_surrogates = first_ratios.shape[2]
        # The dearest first: else one thread would be left with it when the others have finished.
        parts.sort(key=lambda part: -len(part[1]) * n_columns(part[0].level, n_surrogates, self.basis) ** 2)

        def add(part: tuple[Stratum, IntArray]) -> None:
            stratum, rows = part
            stratum.add(first_ratios[rows], y[rows])

        side_by_side(add, parts, worthwhile=len(block) >= CHUNK_ROWS)

    def _stratum(self, level: int) -> Stratum:
        return self._strata.setdefault(level, Stratum(level, self.basis))

    def result(self, confidence: float) -> Estimate:
        """Algorithm 1's estimate and its published variance."""
        require_episodes(self.sums.n)
        n = self.sums.n
        levels = sorted(self._strata)
        fitted = side_by_side(lambda level: self._strata[level].fit(), levels, worthwhile=n >= CHUNK_ROWS)
        fits = dict(zip(levels, fitted, strict=True))
        rate = math.fsum(fit.n * fit.intercept for fit in fits.values()) / n
        within = math.fsum(fit.residual_squares for fit in fits.values())
        between = math.fsum(fit.n * (fit.intercept - rate) ** 2 for fit in fits.values())
        var_z = (within + between) / (n - 1) if n > 1 else math.inf
        var_y = self.sums.y.variance(n)
        details: dict[str, Any] = {
            "basis": self.basis,
            "var_z": var_z,
            "var_y": var_y,
            "nade_std_error": math.sqrt(var_y / n),
            "strata": [
                {"n_control_steps": level, "n": fit.n, "columns": fit.n_columns, "rank": fit.rank}
                for level, fit in fits.items()
            ],
        }
        return weighted_estimate(
            self.sums,
            rate,
            math.sqrt(var_z / n),
            confidence,
            third_moment=None,
            method="sparse control variates as published (Algorithm 1)",
            cautions=[WARNING],
            details=details,
        )
