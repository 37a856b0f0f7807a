"""Regression of one stratum of the sparse control variates, streamed.

Episodes wait as compact rows (27 numbers for J = 3) until a chunk is full; only then are they expanded to up to 729
columns and folded into the triangular factor. Chunks are cut by the count of the stratum's episodes alone, so the
result does not depend on how the episodes came in blocks, and small strata never hold a large factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.arrays import FloatArray
from harness.estimators.scv_columns import Basis, fill_product_columns, n_columns
from harness.estimators.triangular_factor import empty_factor, fold_rows, short_factor

CHUNK_ROWS = 2_048


@dataclass(frozen=True)
class StratumFit:
    """Regression of Y_l on H_l.

    Attributes
    ----------
    n, n_columns, rank : int
        Episodes, columns, and rank of the centred columns.
    intercept : float
        η_l.
    residual_squares : float
        Σ(Z - η_l)² over the stratum.
    """

    n: int
    n_columns: int
    rank: int
    intercept: float
    residual_squares: float


class Stratum:
    """Episodes with `level` control steps: a triangular factor of [1, H, Y] and the rows that wait."""

    def __init__(self, level: int, basis: Basis) -> None:
        self.level = level
        self.basis = basis
        self.n = 0
        self._factor: FloatArray | None = None
        self._ratios: list[FloatArray] = []
        self._y: list[FloatArray] = []
        self._n_waiting = 0

    def add(self, first_ratios: FloatArray, y: FloatArray) -> None:
        """Add episodes of this stratum.

        Parameters
        ----------
        first_ratios : (m, 9, J) float64
        y : (m,) float64
        """
        start = 0
        while start < len(y):
            stop = min(len(y), start + CHUNK_ROWS - self._n_waiting)
            self._wait(first_ratios[start:stop], y[start:stop])
            if self._n_waiting == CHUNK_ROWS:
                self._factor = self._folded(self._factor)
                self._ratios, self._y, self._n_waiting = [], [], 0
            start = stop

    def _wait(self, first_ratios: FloatArray, y: FloatArray) -> None:
        self.n += len(y)
        self._ratios.append(first_ratios)
        self._y.append(y)
        self._n_waiting += len(y)

    def _folded(self, factor: FloatArray | None) -> FloatArray:
        """Fold the waiting rows into `factor`, which is changed, or into a new one."""
        rows = self._waiting_rows()
        factor = empty_factor(rows.shape[1]) if factor is None else factor
        fold_rows(factor, rows)
        return factor

    def _waiting_rows(self) -> FloatArray:
        """Rows [1, H, Y] that wait, shape (m, d + 2), in Fortran order."""
        first_ratios = np.concatenate(self._ratios)
        width = n_columns(self.level, first_ratios.shape[2], self.basis) + 2
        rows = np.empty((self._n_waiting, width), order="F")
        rows[:, 0], rows[:, -1] = 1.0, np.concatenate(self._y)
        fill_product_columns(first_ratios, self.level, self.basis, rows[:, 1:-1])
        return rows

    def _with_waiting_rows(self) -> FloatArray:
        """Triangular factor of all rows so far; the state stays as it is.

        Fewer rows than columns have a factor of as many rows; the square one would be filled up with zeros, and its
        decomposition would take hundreds of times as long.
        """
        if self._factor is not None:
            return self._folded(self._factor.copy(order="F")) if self._ratios else self._factor
        rows = self._waiting_rows()
        return short_factor(rows) if rows.shape[0] < rows.shape[1] else self._folded(None)

    def fit(self) -> StratumFit:
        """Solve the regression by SVD of the centred columns' triangular factor.

        The tolerance for the rank is the customary one of least-squares solvers, the larger dimension times machine
        epsilon times the largest singular value; but never below what centring has rounded away, which grows with the
        columns' means. Else columns that never vary would be fitted as if their rounding errors were data.
        """
        factor = self._with_waiting_rows()
        intercept = float(factor[0, -1] / factor[0, 0])
        last = factor.shape[1] - 1
        centred, target = factor[1:last, 1:last], factor[1:last, last]
        residual_squares = float(factor[last, last] ** 2) if len(factor) > last else 0.0
        rank = 0
        if centred.size:
            left, singular, _ = np.linalg.svd(centred, full_matrices=False)
            largest = max(singular[0], np.linalg.norm(factor[0, :-1]))
            kept = singular > max(self.n, last - 1) * np.finfo(np.float64).eps * largest
            rank = int(np.count_nonzero(kept))
            residual_squares += float(np.sum((left[:, ~kept].T @ target) ** 2))
        return StratumFit(self.n, last - 1, rank, intercept, residual_squares)
