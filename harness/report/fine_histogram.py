"""Histograms that are filled batch by batch and get their display bins only at the end.

Values are counted in fine fixed bins, so that memory does not grow with the number of tests; for display the fine bins
are merged to at most as many as a plot can show, over the range that is used. Beyond the fixed range a value goes to
the outermost bin, so that no test is lost from a count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
MERGE_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1_000, 2_000)


@dataclass(frozen=True)
class Bins:
    """Display bins: ``edges`` (n+1) in the variable's unit, ``count`` and ``weight`` (n)."""

    edges: Floats
    count: Floats
    weight: Floats


class FineHistogram:
    """Counts and weight sums of one variable in fine bins of equal width.

    Parameters
    ----------
    low, high, width : float
        Range and width of the fine bins, in the variable's unit.
    """

    def __init__(self, low: float, high: float, width: float) -> None:
        n = round((high - low) / width)
        self.low = low
        self.width = width
        self.count = np.zeros(n)
        self.weight = np.zeros(n)

    def add(self, values: Floats, weights: Floats) -> None:
        """Count values, each with its weight; both shape (m,), values that are not finite are left out."""
        known = np.isfinite(values)
        index = bin_index(values[known], self.low, self.width, self.count.size)
        self.count += np.bincount(index, minlength=self.count.size)
        self.weight += np.bincount(index, weights=weights[known], minlength=self.count.size)

    def used(self) -> tuple[int, int] | None:
        """First and one past the last fine bin that holds a value; None when there is none."""
        filled = np.flatnonzero(self.count)
        return (int(filled[0]), int(filled[-1]) + 1) if filled.size else None

    def bins(self, most: int, used: tuple[int, int] | None = None) -> Bins:
        """Merge to at most ``most`` bins over the used range (or a given range of fine bins)."""
        first, last = used or self.used() or (0, 1)
        first, last, factor = merged_range(first, last, most)
        edges = self.low + self.width * np.arange(first, last + 1, factor, dtype=np.float64)
        return Bins(edges, merge(self.count, first, last, factor), merge(self.weight, first, last, factor))

    def weighted_quantile(self, share: float) -> float:
        """Value below which this share of the weight lies, to the width of a fine bin; NaN without weight."""
        total = float(self.weight.sum())
        if total <= 0.0:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self.weight), share * total))
        return float(self.low + self.width * (min(index, self.weight.size - 1) + 0.5))


def bin_index(values: Floats, low: float, width: float, n: int) -> npt.NDArray[np.int64]:
    """Index of each value's bin; values beyond the range go to the outermost bins."""
    # A value such as 0.3 on bins of 0.1 must not fall below its edge by rounding.
    raw = np.floor((values - low) / width + 1e-9)
    return np.clip(raw, 0, n - 1).astype(np.int64)


def merged_range(first: int, last: int, most: int) -> tuple[int, int, int]:
    """Range of fine bins on whole display bins, and how many fine bins make one."""
    for factor in MERGE_FACTORS:
        low, high = first // factor * factor, -(-last // factor) * factor
        if (high - low) // factor <= most:
            break
    return low, high, factor


def merge(values: Floats, first: int, last: int, factor: int) -> Floats:
    """Sum groups of ``factor`` neighbours of ``values[first:last]``, zeros beyond its end."""
    padded = np.zeros(last - first)
    part = values[first:last]
    padded[: part.size] = part
    return np.asarray(padded.reshape(-1, factor).sum(axis=1))
