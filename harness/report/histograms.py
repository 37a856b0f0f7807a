"""Histograms that are filled batch by batch, in one variable, or in two as those of cut-ins in (R2dot, R2).

Values are counted in fine fixed bins, so that memory does not grow with the number of tests; for display the fine bins
are merged to at most as many as a plot can show, over the range that is used. Beyond the fixed range a value goes to
the outermost bin, so that no test is lost from a count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from harness.vocabulary import FloatArray, IntArray

MERGE_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1_000, 2_000)


class Axis(NamedTuple):
    """Fine bins of equal width between two ends, all in the variable's unit."""

    low: float
    high: float
    width: float

    @property
    def n(self) -> int:
        """Number of bins."""
        return round((self.high - self.low) / self.width)

    def place(self, values: FloatArray) -> IntArray:
        """Bin of each value."""
        # A value such as 0.3 on bins of 0.1 must not fall below its edge by rounding.
        raw = np.floor((values - self.low) / self.width + 1e-9)
        return np.clip(raw, 0, self.n - 1).astype(np.int64)

    def edges(self, first: int, last: int, step: int = 1) -> FloatArray:
        """Edges of the bins from ``first`` up to ``last``, ``step`` of them together."""
        return self.low + self.width * np.arange(first, last + 1, step, dtype=np.float64)


class Bins(NamedTuple):
    """Display bins: ``edges`` (n+1) in the variable's unit, counts and sums of weights (n)."""

    edges: FloatArray
    counts: FloatArray
    weights: FloatArray


class FineHistogram:
    """Counts and weight sums in fine bins, of shape (n,) or, of two variables, (rows, columns)."""

    def __init__(self, *axes: Axis) -> None:
        self.axes = axes
        self.count = np.zeros([axis.n for axis in axes])
        self.weight = np.zeros_like(self.count)

    def add(self, weights: FloatArray, *values: FloatArray) -> None:
        """Count values of each variable, all of shape (m,); those that are not finite are left out."""
        known = np.isfinite(values).all(axis=0)
        place = [axis.place(of_one[known]) for axis, of_one in zip(self.axes, values, strict=True)]
        shape, cell = self.count.shape, np.ravel_multi_index(place, self.count.shape)
        self.count += np.bincount(cell, minlength=self.count.size).reshape(shape)
        self.weight += np.bincount(cell, weights=weights[known], minlength=self.count.size).reshape(shape)

    def used(self) -> tuple[slice, ...] | None:
        """Smallest block of fine bins that holds every value; None without any."""
        filled = np.nonzero(self.count)
        return tuple(slice(int(i.min()), int(i.max()) + 1) for i in filled) if filled[0].size else None

    def bins(self, most: int, used: slice | None = None) -> Bins:
        """Merge those of one variable to at most ``most`` bins over the used range (or a given range of fine bins)."""
        within = used or (self.used() or (slice(0, 1),))[0]
        for factor in MERGE_FACTORS:
            low, high = within.start // factor * factor, -(-within.stop // factor) * factor
            if (high - low) // factor <= most:
                break
        starts = np.arange(0, high - low, factor)
        merged = (np.add.reduceat(values[low:high], starts) for values in (self.count, self.weight))
        return Bins(self.axes[0].edges(low, high, factor), *merged)

    def weighted_quantile(self, share: float) -> float:
        """Value of one variable below which this share of the weight lies, to a fine bin; NaN without weight."""
        total = float(self.weight.sum())
        if total <= 0.0:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self.weight), share * total))
        axis = self.axes[0]
        return float(axis.low + axis.width * (min(index, axis.n - 1) + 0.5))
