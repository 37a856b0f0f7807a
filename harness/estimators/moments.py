"""Moments of numbers that come in blocks, without the cancellation of Σx² - (Σx)²/n.

Moments of a block are joined to those before (T. F. Chan, G. H. Golub and R. J. LeVeque, The American Statistician 37,
1983, 242; third moments: P. Pébay, Sandia report SAND2008-6212). How numbers are cut into blocks shows in the last
digits only; a run's blocks are its shards, which follow from the campaign alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.vocabulary import FloatArray

_ROWS_AT_ONCE = 4096


class _Central(NamedTuple):
    """Number of values, Σx (exact for counts), Σ(x - x̄)² and Σ(x - x̄)³."""

    n: int = 0
    total: float = 0.0
    second: float = 0.0
    third: float = 0.0

    def joined(self, other: _Central) -> _Central:
        if not self.n or not other.n:
            return self if self.n else other
        n, total = self.n + other.n, self.total + other.total
        distance = other.total / other.n - self.total / self.n
        if not math.isfinite(distance):
            return _Central(n, total, math.nan, math.nan)
        spread = distance * distance * self.n * (other.n / n)
        third = self.third + other.third + spread * distance * ((self.n - other.n) / n)
        third += 3.0 * distance * (self.n * other.second - other.n * self.second) / n
        return _Central(n, total, self.second + other.second + spread, third)


def _central(values: FloatArray) -> _Central:
    """Moments of one block; what rounding the mean has left in the distances from it is taken out again."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        total = float(np.sum(values))
        if not math.isfinite(total):
            return _Central(len(values), total, math.nan, math.nan)
        away = values - total / len(values)
        away -= np.mean(away)
        squares = away * away  # summed by numpy alone: how BLAS adds depends on the number of its threads
        return _Central(len(values), total, float(np.sum(squares)), float(np.sum(squares * away)))


class Moments:
    """Running moments of the numbers added so far; those never added count as zeros where a larger n is asked for."""

    def __init__(self) -> None:
        self._seen = _Central()

    def add(self, values: FloatArray) -> None:
        """Add all entries of a one-dimensional array."""
        if len(values):
            self._seen = self._seen.joined(_central(values))

    @property
    def total(self) -> float:
        """Σx."""
        return self._seen.total

    @property
    def squares(self) -> float:
        """Σx²."""
        return self._seen.second + self.total * (self.total / self._seen.n) if self._seen.n else 0.0

    @property
    def n_effective(self) -> float:
        """(Σx)²/Σx², 0 where all numbers are."""
        return self.total**2 / self.squares if self.squares > 0.0 else 0.0

    def _of(self, n: int) -> _Central:
        return self._seen.joined(_Central(n - self._seen.n))

    def mean(self, n: int) -> float:
        """Σx/n."""
        return self.total / n

    def variance(self, n: int) -> float:
        """Sample variance; infinite for n < 2, and where a number or its square is."""
        second = self._of(n).second
        return second / (n - 1) if n > 1 and math.isfinite(second) else math.inf

    def std_error(self, n: int) -> float:
        """Of the mean."""
        return math.sqrt(self.variance(n) / n)

    def third_moment(self, n: int) -> float:
        """Third central moment of the mean, Σ(x - x̄)³/n³; 0 where it is not finite."""
        third = self._of(n).third / n**3 if n else 0.0
        return third if math.isfinite(third) else 0.0


class ThirdMoments:
    """Σ x_i x_j x_k over rows of k columns: the skewness of any linear combination of these is known afterwards."""

    def __init__(self, n_columns: int) -> None:
        self._sums: FloatArray = np.zeros((n_columns * n_columns, n_columns))

    def add(self, rows: FloatArray) -> None:
        """Add rows of shape (n, k)."""
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            part = rows[start : start + _ROWS_AT_ONCE]
            self._sums += (part[:, :, None] * part[:, None, :]).reshape(len(part), -1).T @ part

    def of(self, coefficients: FloatArray) -> float:
        """Σ (cᵀx)³ for coefficients c of shape (k,)."""
        return float(np.outer(coefficients, coefficients).ravel() @ self._sums @ coefficients)
