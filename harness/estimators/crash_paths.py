"""Whether a vehicle's crashes lie on enough of the paths that it has walked for an interval to be made of them.

The pool of a vehicle that acts before the cut-in knows some hundred paths. If nearly all of its crashes lie on a few of
them, as those of a vehicle that gives way do, then the paths which would matter most may well be missing, and nothing
in the tests says so. With G a path's probability of a crash, (ΣG)²/ΣG² is the number of paths that count. Two crashed
tests are of one path with the probability ΣG²/(ΣG)²: so it is estimated from pairs of them, without knowing any G.
"""

from __future__ import annotations

import math

import numpy as np

from harness.vocabulary import FloatArray, IntArray

FEWEST_PATHS = 40.0
"""Below so many paths that count there is no interval: their error alone would be above 16 %, and is not known."""
FEWEST_PAIRS = 3
"""Pairs of crashed tests on one path that say something: with ever so many paths one pair may happen."""


class CrashPaths:
    """Crashed tests by path and stratum."""

    def __init__(self) -> None:
        self._by_path: dict[bytes, IntArray] = {}

    def add(self, cell_mass: FloatArray, stratum: IntArray, n_strata: int) -> None:
        """Count crashed tests (n,), whose paths are known by their probabilities of all cells (n, C)."""
        for mass, s in zip(cell_mass.astype(np.float32), stratum.tolist(), strict=True):
            self._by_path.setdefault(mass.tobytes(), np.zeros(n_strata, np.int64))[s] += 1

    def number(self, weight: FloatArray) -> float:
        """Number of paths that count, crashes of a stratum having its ``weight`` (S,); infinite while little is known.

        Strata without a weight are left out.
        """
        used = np.flatnonzero(weight > 0.0)
        if not self._by_path or not used.size:
            return math.inf
        crashes = np.array(list(self._by_path.values()))[:, used].astype(np.float64)
        if (crashes.sum(1) * (crashes.sum(1) - 1.0)).sum() / 2.0 < FEWEST_PAIRS:
            return math.inf
        own, squares = crashes @ weight[used], crashes @ weight[used] ** 2
        return float((own.sum() ** 2 - squares.sum()) / (own * own - squares).sum())
