"""`nde`: the share of crashes among naturalistic tests, with the exact binomial interval."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from harness.estimators.accumulator import require_episodes
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate
from harness.estimators.intervals import clopper_pearson, clopper_pearson_upper
from harness.estimators.weighted_sums import count_warnings
from harness.methods import EstimatorName


class Nde:
    """Counts of crashes; the estimate is c/n with the Clopper-Pearson interval ([paper] section II-A)."""

    name: ClassVar[EstimatorName] = "nde"

    def __init__(self) -> None:
        self.n = 0
        self.n_crashes = 0

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Crash counts mean something only where nothing was controlled."""
        if block.method != "nde":
            return f"a share of crashes needs naturalistic tests (method nde), these were drawn by {block.method}"
        return None

    def add(self, block: Block) -> None:
        """Count one block."""
        self.n += len(block)
        self.n_crashes += int(np.count_nonzero(block.crash))

    def result(self, confidence: float) -> Estimate:
        """Share of crashes; its relative half-width is half the interval's length over the rate."""
        require_episodes(self.n)
        rate = self.n_crashes / self.n
        low, high = clopper_pearson(self.n_crashes, self.n, confidence)
        return Estimate(
            crash_rate=rate,
            std_error=math.sqrt(rate * (1.0 - rate) / self.n),
            ci_low=low,
            ci_high=high,
            upper_bound=clopper_pearson_upper(self.n_crashes, self.n, confidence),
            confidence=confidence,
            rhw=(high - low) / 2.0 / rate if rate > 0.0 else math.inf,
            n_episodes=self.n,
            n_crashes=self.n_crashes,
            n_effective=float(self.n_crashes),
            largest_weight_share=1.0 / self.n_crashes if self.n_crashes else 0.0,
            method="share of crashes; Clopper-Pearson interval and upper bound",
            weight_cap=1.0,
            warnings=tuple(count_warnings(self.n_crashes)),
        )
