"""Where cut-ins happen, on a grid of (R2, R2dot), filled batch by batch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.report.fine_histogram import Floats, bin_index

R2_LOW_M, R2_HIGH_M, R2_WIDTH_M = 0.0, 150.0, 2.5
R2DOT_LOW_MPS, R2DOT_HIGH_MPS, R2DOT_WIDTH_MPS = -30.0, 20.0, 0.5


@dataclass(frozen=True)
class GridRange:
    """Edges of the cells in use: ``r2_m`` (m+1) and ``r2dot_mps`` (n+1), and their index ranges."""

    r2_m: Floats
    r2dot_mps: Floats
    rows: slice
    columns: slice


class CutInGrid:
    """Counts and weight sums per cell of (R2, R2dot); beyond the range a cut-in goes to the outermost cell."""

    def __init__(self) -> None:
        self.n_r2 = round((R2_HIGH_M - R2_LOW_M) / R2_WIDTH_M)
        self.n_r2dot = round((R2DOT_HIGH_MPS - R2DOT_LOW_MPS) / R2DOT_WIDTH_MPS)
        self.count = np.zeros((self.n_r2dot, self.n_r2))
        self.weight = np.zeros((self.n_r2dot, self.n_r2))

    def add(self, r2_m: Floats, r2dot_mps: Floats, weights: Floats) -> None:
        """Count cut-ins; all of shape (m,), those without a known place are left out."""
        known = np.isfinite(r2_m) & np.isfinite(r2dot_mps)
        column = bin_index(r2_m[known], R2_LOW_M, R2_WIDTH_M, self.n_r2)
        row = bin_index(r2dot_mps[known], R2DOT_LOW_MPS, R2DOT_WIDTH_MPS, self.n_r2dot)
        cell = row * self.n_r2 + column
        self.count += np.bincount(cell, minlength=self.count.size).reshape(self.count.shape)
        self.weight += np.bincount(cell, weights=weights[known], minlength=self.count.size).reshape(self.count.shape)

    def range_used(self) -> GridRange | None:
        """Smallest block of cells that holds every cut-in; None without any."""
        rows, columns = np.nonzero(self.count)
        if not rows.size:
            return None
        row, column = slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1)
        return GridRange(
            r2_m=R2_LOW_M + R2_WIDTH_M * np.arange(column.start, column.stop + 1, dtype=np.float64),
            r2dot_mps=R2DOT_LOW_MPS + R2DOT_WIDTH_MPS * np.arange(row.start, row.stop + 1, dtype=np.float64),
            rows=row,
            columns=column,
        )
