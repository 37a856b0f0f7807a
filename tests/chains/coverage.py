"""Replications of a campaign on a chain: what an estimator's interval is worth is judged by these, never by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from harness.arrays import FloatArray
from harness.estimators.block import Block
from harness.estimators.estimate import Accumulator


@dataclass(frozen=True, eq=False)
class Replications:
    """Per replication: rate, claimed standard error, interval."""

    rate: FloatArray
    std_error: FloatArray
    low: FloatArray
    high: FloatArray

    def covered(self, truth: float) -> int:
        return int(np.count_nonzero((self.low <= truth) & (truth <= self.high)))

    def claimed_relvar(self, truth: float, n: int) -> float:
        """Mean claimed n·Var/μ²."""
        return float(np.mean(self.std_error**2)) * n / truth**2

    def true_relvar(self, truth: float, n: int) -> float:
        """n·Var/μ² of the estimates themselves, around the truth."""
        return float(np.mean((self.rate - truth) ** 2)) * n / truth**2


def replicate(
    draw: Callable[[np.random.Generator], Block],
    replications: int,
    seed: int,
    make: Mapping[str, Callable[[], Accumulator]],
    confidence: float = 0.9,
) -> dict[str, Replications]:
    """Give the same data, drawn anew for each replication, to every estimator."""
    rows: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in make}
    for k in range(replications):
        block = draw(np.random.default_rng([seed, k]))
        for name, new in make.items():
            state = new()
            state.add(block)
            e = state.result(confidence)
            rows[name].append((e.crash_rate, e.std_error, e.ci_low, e.ci_high))
    return {name: Replications(*np.array(values).T) for name, values in rows.items()}
