"""One row per replication and result: what a campaign reported, and nothing that only the experimenter knows."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from harness.arrays import BoolArray, FloatArray, IntArray
from harness.estimators.estimate import Estimate


@dataclass(frozen=True)
class Row:
    """Result of one replication.

    Attributes
    ----------
    result : str
        Estimator, or one of the two statements of shells.
    replication : int
    n_tests, n_crashes : int
    crash_rate, std_error, ci_low, ci_high : float
        As the campaign reported them.
    reached : bool
        Whether the asked precision was reached; False when none was asked.
    n_crashes_outside : int
        Crashes beyond the boundary; 0 where there are no shells.
    """

    result: str
    replication: int
    n_tests: int
    n_crashes: int
    crash_rate: float
    std_error: float
    ci_low: float
    ci_high: float
    reached: bool
    n_crashes_outside: int = 0


def estimate_row(result: str, replication: int, estimate: Estimate, *, reached: bool) -> Row:
    """Row of an estimate with one interval."""
    return Row(
        result,
        replication,
        estimate.n_episodes,
        estimate.n_crashes,
        estimate.crash_rate,
        estimate.std_error,
        estimate.ci_low,
        estimate.ci_high,
        reached,
    )


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of one vehicle and one result as columns, each of shape (R,)."""

    replication: IntArray
    n_tests: IntArray
    n_crashes: IntArray
    crash_rate: FloatArray
    std_error: FloatArray
    ci_low: FloatArray
    ci_high: FloatArray
    reached: BoolArray
    n_crashes_outside: IntArray

    @classmethod
    def of(cls, rows: list[Row]) -> Rows:
        """Columns from rows, in the order of replications."""
        rows = sorted(rows, key=lambda row: row.replication)
        return cls(**{field.name: np.array([getattr(row, field.name) for row in rows]) for field in fields(cls)})
