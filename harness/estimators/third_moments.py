"""Third moments of rows, so that the skewness of any linear combination of their columns is known afterwards."""

from __future__ import annotations

import numpy as np

from harness.arrays import FloatArray

_ROWS_AT_ONCE = 4096


class ThirdMoments:
    """Σ x_i x_j x_k over rows x, k³ numbers however many rows.

    Parameters
    ----------
    n_columns : int
        Columns k of a row.
    """

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
