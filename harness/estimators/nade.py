"""`nade`: the mean of weighted crashes, importance sampling as it stands ([paper] section II-B)."""

from __future__ import annotations

from typing import ClassVar

from harness.estimators.accumulator import require_episodes
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate
from harness.estimators.weighted_sums import WeightedSums, weighted_estimate
from harness.methods import EstimatorName


class Nade:
    """Mean of Y = 1{crash}·weight. Unbiased for every method of drawing; without control it is the crash share."""

    name: ClassVar[EstimatorName] = "nade"

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
        require_episodes(self.sums.n)
        return weighted_estimate(
            self.sums,
            self.sums.mean(),
            self.sums.y.std_error(self.sums.n),
            confidence,
            third_moment=self.sums.y.third_moment(self.sums.n),
            method="mean of weighted crashes",
            details={},
        )
