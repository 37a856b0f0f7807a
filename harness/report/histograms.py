"""Histograms that are filled batch by batch, in one variable and of cut-ins in (R2, R2dot).

Values are counted in fine fixed bins, so that memory does not grow with the number of tests; for display the fine bins
are merged to at most as many as a plot can show, over the range that is used. Beyond the fixed range a value goes to
the outermost bin, so that no test is lost from a count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from harness.arrays import FloatArray, IntArray

MERGE_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1_000, 2_000)
R2_LOW_M, R2_HIGH_M, R2_WIDTH_M = 0.0, 150.0, 2.5
R2DOT_LOW_MPS, R2DOT_HIGH_MPS, R2DOT_WIDTH_MPS = -30.0, 20.0, 0.5


class Bins(NamedTuple):
    """Display bins: ``edges`` (n+1) in the variable's unit, counts and sums of weights (n)."""

    edges: FloatArray
    counts: FloatArray
    weights: FloatArray


class FineHistogram:
    """Counts and weight sums of one variable in fine bins of equal width; arguments in the variable's unit."""

    def __init__(self, low: float, high: float, width: float) -> None:
        n = round((high - low) / width)
        self.low = low
        self.width = width
        self.count = np.zeros(n)
        self.weight = np.zeros(n)

    def add(self, values: FloatArray, weights: FloatArray) -> None:
        """Count values, each with its weight; both shape (m,), values that are not finite are left out."""
        known = np.isfinite(values)
        index = _bin_index(values[known], self.low, self.width, self.count.size)
        self.count += np.bincount(index, minlength=self.count.size)
        self.weight += np.bincount(index, weights=weights[known], minlength=self.count.size)

    def used(self) -> tuple[int, int] | None:
        """First and one past the last fine bin that holds a value; None when there is none."""
        filled = np.flatnonzero(self.count)
        return (int(filled[0]), int(filled[-1]) + 1) if filled.size else None

    def bins(self, most: int, used: tuple[int, int] | None = None) -> Bins:
        """Merge to at most ``most`` bins over the used range (or a given range of fine bins)."""
        first, last = used or self.used() or (0, 1)
        for factor in MERGE_FACTORS:
            low, high = first // factor * factor, -(-last // factor) * factor
            if (high - low) // factor <= most:
                break
        edges = self.low + self.width * np.arange(low, high + 1, factor, dtype=np.float64)
        return Bins(edges, *(_merged(values, low, high, factor) for values in (self.count, self.weight)))

    def weighted_quantile(self, share: float) -> float:
        """Value below which this share of the weight lies, to the width of a fine bin; NaN without weight."""
        total = float(self.weight.sum())
        if total <= 0.0:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self.weight), share * total))
        return float(self.low + self.width * (min(index, self.weight.size - 1) + 0.5))


def _bin_index(values: FloatArray, low: float, width: float, n: int) -> IntArray:
    # A value such as 0.3 on bins of 0.1 must not fall below its edge by rounding.
    raw = np.floor((values - low) / width + 1e-9)
    return np.clip(raw, 0, n - 1).astype(np.int64)


def _merged(values: FloatArray, low: int, high: int, factor: int) -> FloatArray:
    """Sums of ``factor`` neighbours of ``values[low:high]``, zeros beyond its end."""
    part = values[low:high]
    return np.asarray(np.pad(part, (0, high - low - part.size)).reshape(-1, factor).sum(axis=1))


class UsedCells(NamedTuple):
    """Edges of the cells in use, ``r2_m`` (m+1) and ``r2dot_mps`` (n+1), and their place in the grid."""

    r2_m: FloatArray
    r2dot_mps: FloatArray
    place: tuple[slice, slice]


class CutInGrid:
    """Counts and weight sums per cell of R2dot (rows) and R2 (columns); see the module for cut-ins out of range."""

    def __init__(self) -> None:
        n_r2dot = round((R2DOT_HIGH_MPS - R2DOT_LOW_MPS) / R2DOT_WIDTH_MPS)
        self.count = np.zeros((n_r2dot, round((R2_HIGH_M - R2_LOW_M) / R2_WIDTH_M)))
        self.weight = np.zeros_like(self.count)

    def add(self, r2_m: FloatArray, r2dot_mps: FloatArray, weights: FloatArray) -> None:
        """Count cut-ins; all of shape (m,), those without a known place are left out."""
        known = np.isfinite(r2_m) & np.isfinite(r2dot_mps)
        n_rows, n_columns = self.count.shape
        column = _bin_index(r2_m[known], R2_LOW_M, R2_WIDTH_M, n_columns)
        cell = column + n_columns * _bin_index(r2dot_mps[known], R2DOT_LOW_MPS, R2DOT_WIDTH_MPS, n_rows)
        self.count += np.bincount(cell, minlength=self.count.size).reshape(self.count.shape)
        self.weight += np.bincount(cell, weights=weights[known], minlength=self.count.size).reshape(self.count.shape)

    def used(self) -> UsedCells | None:
        """Smallest block of cells that holds every cut-in; None without any."""
        filled = np.nonzero(self.count)
        if not filled[0].size:
            return None
        rows, columns = (slice(int(index.min()), int(index.max()) + 1) for index in filled)
        return UsedCells(
            r2_m=R2_LOW_M + R2_WIDTH_M * np.arange(columns.start, columns.stop + 1, dtype=np.float64),
            r2dot_mps=R2DOT_LOW_MPS + R2DOT_WIDTH_MPS * np.arange(rows.start, rows.stop + 1, dtype=np.float64),
            place=(rows, columns),
        )
