"""The shape that all estimators share: add blocks, ask for the result."""

from __future__ import annotations

from typing import ClassVar, Protocol

from harness.estimators.block import Block
from harness.estimators.estimate import Estimate
from harness.methods import EstimatorName


class Accumulator(Protocol):
    """One estimator's running state, of bounded size."""

    name: ClassVar[EstimatorName]

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Why records like this block do not allow this estimator; None if they do."""
        ...

    def add(self, block: Block) -> None:
        """Add the episodes of one block."""
        ...

    def result(self, confidence: float) -> Estimate:
        """Estimate from the episodes so far; leaves the state as it is.

        Raises
        ------
        ValueError
            If no episode was added.
        """
        ...


def require_episodes(n: int) -> None:
    """Refuse to estimate from nothing."""
    if n < 1:
        raise ValueError("an estimate needs at least one episode")
