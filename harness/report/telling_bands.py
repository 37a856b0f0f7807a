"""Which quantity, and which band of it, tells crashes from tests without a crash: a scan with an honest p-value.

For each quantity every band of neighbouring bins is tried, also a narrow one in the middle of the range, and judged by
the likelihood ratio of «crashes are more frequent inside» against «equally frequent everywhere» (the Bernoulli scan
statistic: M. Kulldorff, Communications in Statistics 26, 1997, 1481). With so many bands some fit by chance. So crashes
and others are relabelled at random, and the largest ratio over *all* bands of *all* quantities is what an observed one
must beat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import xlogy

from harness.vocabulary import BoolArray, FloatArray, IntArray

BINS = 50
"""Per quantity, equally full: a band that holds 2 % of all tests is a bin of its own."""
RELABELINGS = 499
"""The smallest possible p-value is 1/500; the whole takes about a second."""
SIGNIFICANT = 0.01
"""One report in a hundred says that something stands out where nothing does."""
SEED = 20_240
"""Any fixed number: the same folder gives the same page."""


@dataclass(frozen=True)
class Band:
    """The band of one quantity (by index) in which crashes are most over-represented.

    Its ends are rounded outwards to a tenth, and infinite where no test lies beyond. The shares of the crashes and of
    the tests without a crash in it are by weight; the p-value is over all bands and quantities.
    """

    quantity: int
    low: float
    high: float
    crash_share: float
    other_share: float
    n_crashes: int
    p_value: float

    @property
    def significant(self) -> bool:
        """Whether chance is an unlikely explanation."""
        return self.p_value <= SIGNIFICANT


def telling_bands(values: FloatArray, crash: BoolArray, weight: FloatArray) -> list[Band]:
    """Best band of each quantity, the most telling first.

    Parameters
    ----------
    values : ndarray, shape (Q, n)
        NaN where a test has no such value.
    crash : ndarray of bool, shape (n,)
    weight : ndarray, shape (n,)
        What each test stands for; equal ones within a stratum.
    """
    scan = Scan(values, weight)
    observed = scan.log_ratios(np.flatnonzero(crash))
    best, ratio = observed.argmax(axis=1), observed.max(axis=1)
    rng = np.random.Generator(np.random.Philox(key=SEED))
    relabeled = (rng.choice(crash.size, int(crash.sum()), replace=False, shuffle=False) for _ in range(RELABELINGS))
    largest = np.array([scan.log_ratios(rows).max() for rows in relabeled])
    bands = []
    for q in np.argsort(-ratio, kind="stable").tolist():
        low, high = _tight(values[q], crash & scan.inside(q, int(best[q])), crash, weight)
        p_value = (1 + int((largest >= ratio[q]).sum())) / (1 + RELABELINGS)
        bands.append(_band(q, low, high, values[q], crash, weight, p_value))
    return bands


class Scan:
    """Weights of all tests by bin, kept so that a relabeling only has to look at its crashes."""

    def __init__(self, values: FloatArray, weight: FloatArray) -> None:
        self._cell = np.stack([_bins(row) for row in values]) + (BINS + 1) * np.arange(len(values))[:, None]
        self._weight, self._square = weight, weight * weight
        self._all = self._upto(np.arange(weight.size))
        self._first, self._last = np.triu_indices(BINS + 1, 1)

    def _upto(self, rows: IntArray) -> FloatArray:
        """Weight below each edge, shape (Q, BINS + 1)."""
        n, cell = len(self._cell), self._cell[:, rows].ravel()
        held = np.bincount(cell, np.tile(self._weight[rows], n), n * (BINS + 1)).reshape(n, BINS + 1)
        return np.pad(np.cumsum(held[:, :BINS], axis=1), ((0, 0), (1, 0)))

    def log_ratios(self, crashes: IntArray) -> FloatArray:
        """Log likelihood ratio of each band for each quantity, shape (Q, bands), if these rows were the crashes."""
        sums = [float(w[crashes].sum()) for w in (self._weight, self._square)]
        rest = [max(float(w.sum()) - s, 0.0) for w, s in zip((self._weight, self._square), sums, strict=True)]
        upto = self._upto(crashes)
        inside, all_inside = (u[:, self._last] - u[:, self._first] for u in (upto, self._all))
        return _log_ratio(
            _share(inside, sums[0]), _share(all_inside - inside, rest[0]), _effective(*sums), _effective(*rest)
        )

    def inside(self, quantity: int, band: int) -> BoolArray:
        """Which tests lie in a band, shape (n,)."""
        bins = self._cell[quantity] - (BINS + 1) * quantity
        chosen: BoolArray = (bins >= self._first[band]) & (bins < self._last[band])
        return chosen


def _bins(values: FloatArray) -> IntArray:
    """Bin of each value, equally many in each; `BINS` where there is no value."""
    known = values[~np.isnan(values)]
    edges = np.quantile(known, np.arange(1, BINS) / BINS, method="inverted_cdf") if known.size else np.zeros(BINS - 1)
    return np.where(np.isnan(values), BINS, np.searchsorted(edges, values, side="left"))


def _share(part: FloatArray, whole: float) -> FloatArray:
    return np.maximum(part, 0.0) / whole if whole > 0.0 else np.zeros_like(part)


def _effective(total: float, squares: float) -> float:
    """How many equally weighted tests would say as much."""
    return total * total / squares if squares > 0.0 else 0.0


def _log_ratio(crash_share: FloatArray, other_share: FloatArray, n_crashes: float, n_others: float) -> FloatArray:
    """Log likelihood ratio of bands with given shares of effective numbers; 0 where crashes are not more frequent."""
    c, o = n_crashes * crash_share, n_others * other_share
    ratio = _fit(c, o) + _fit(n_crashes - c, n_others - o) - _fit(np.array(n_crashes), np.array(n_others))
    return np.where(crash_share > other_share, ratio, 0.0)


def _fit(crashes: FloatArray, others: FloatArray) -> FloatArray:
    """Log likelihood of counts at their own share."""
    c, o = np.maximum(crashes, 0.0), np.maximum(others, 0.0)  # differences of sums may round below zero
    return np.asarray(xlogy(c, c) + xlogy(o, o) - xlogy(c + o, c + o), np.float64)


def _tight(values: FloatArray, chosen: BoolArray, crash: BoolArray, weight: FloatArray) -> tuple[float, float]:
    """Ends of a band within its bins: the two of its crashes between which the likelihood ratio is largest."""
    if not chosen.any():
        return -math.inf, math.inf
    ends = np.unique(np.quantile(values[chosen], np.linspace(0.0, 1.0, BINS), method="inverted_cdf"))
    first, last = np.triu_indices(ends.size)
    shares, effective = [], []
    for rows in (crash, ~crash):
        order = np.argsort(values[rows], kind="stable")
        upto = np.r_[0.0, np.cumsum(weight[rows][order])]
        low, high = (np.searchsorted(values[rows][order], ends, side=side) for side in ("left", "right"))
        shares.append(_share(upto[high][last] - upto[low][first], float(weight[rows].sum())))
        effective.append(_effective(float(weight[rows].sum()), float((weight[rows] ** 2).sum())))
    best = int(_log_ratio(shares[0], shares[1], effective[0], effective[1]).argmax())
    return float(ends[first[best]]), float(ends[last[best]])


def _band(
    quantity: int, low: float, high: float, values: FloatArray, crash: BoolArray, weight: FloatArray, p_value: float
) -> Band:
    """A band as it is told: ends rounded outwards, and what lies between them."""
    low, high = float(np.floor(10.0 * low) / 10.0), float(np.ceil(10.0 * high) / 10.0)
    inside = (values >= low) & (values <= high)
    crash_share, other_share = (float(weight[inside & rows].sum() / weight[rows].sum()) for rows in (crash, ~crash))
    return Band(
        quantity=quantity,
        low=low if (values < low).any() else -math.inf,
        high=high if (values > high).any() else math.inf,
        crash_share=crash_share,
        other_share=other_share,
        n_crashes=int((inside & crash).sum()),
        p_value=p_value,
    )
