"""The plain means: `nade`, of weighted crashes ([paper] section II-B), and `nde`, the share of crashes (II-A)."""

from __future__ import annotations

import math

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, require_episodes
from harness.estimators.intervals import clopper_pearson
from harness.estimators.weighted_sums import WeightedSums, count_warnings, weighted_estimate


class Nade:
    """Mean of Y = 1{crash}·weight. Unbiased for every method of drawing; without control it is the crash share."""

    def __init__(self) -> None:
        self.sums = WeightedSums()

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Refuses shells: how many tests each gets depends on results, so that no plain mean is meant."""
        if block.method == "shells":
            return (
                "tests were drawn within shells, whose shares must be added by their probabilities (estimator shells)"
            )
        return None

    def add(self, block: Block) -> None:
        """Add one block's weighted crashes."""
        self.sums.add(block)

    def result(self, confidence: float) -> Estimate:
        """Mean of Y with its interval."""
        n, y = self.sums.n, self.sums.y
        require_episodes(n)
        return weighted_estimate(
            self.sums,
            y.mean(n),
            y.std_error(n),
            confidence,
            third_moment=y.third_moment(n),
            method="mean of weighted crashes",
            details={},
        )


class Nde:
    """Share of crashes among naturalistic tests, with the Clopper-Pearson interval."""

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
        low, high = map(float, clopper_pearson(self.n_crashes, self.n, (1.0 - confidence) / 2.0))
        return Estimate(
            crash_rate=rate,
            std_error=math.sqrt(rate * (1.0 - rate) / self.n),
            ci_low=low,
            ci_high=high,
            upper_bound=float(clopper_pearson(self.n_crashes, self.n, 1.0 - confidence)[1]),
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
