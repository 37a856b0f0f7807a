"""What tests of strata have come to: counts, the rate with its limits, the pool's own error, the paths of crashes.

Tests that failed count as no crash in the rate and in every lower limit, as crashes in every upper one: the limits are
monotone in each stratum's crashes, so that [L(k), U(k + f)] holds whatever the f failed tests would have come to.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from harness.estimators.likelihood import Counts, Level, likelihood_limit
from harness.estimators.limits import clopper_pearson
from harness.vocabulary import BoolArray, FloatArray, IntArray

FEWEST_PATHS = 40.0
"""Below so many paths that count there is no interval: their error alone would be above 16 %, and is not known."""
FEWEST_PAIRS = 3
"""Pairs of crashed tests on one path that say something: with ever so many paths one pair may happen."""


class RateLimits(NamedTuple):
    """A rate with a lower and an upper limit, and the half-width that the error of the p_s would leave for itself.

    ``from_pool`` takes the shares as they were seen, ``from_pool_at_least`` their lower limits: one crash in a rarely
    tested stratum, where paths are few, can make the former large for a while.
    """

    rate: float
    low: float
    high: float
    from_pool: float
    from_pool_at_least: float

    @property
    def rhw(self) -> float:
        """Half of the interval's length over the rate; infinite at rate 0."""
        return (self.high - self.low) / 2.0 / self.rate if self.rate > 0.0 else math.inf

    def from_pool_relative(self) -> tuple[float, float]:
        """The pool's part of `rhw`, and what of it more tests of the same pool will not take away; 0 at rate 0."""
        rate = self.rate if self.rate > 0.0 else math.inf
        return self.from_pool / rate, self.from_pool_at_least / rate


class Tally(NamedTuple):
    """What tests of strata have come to.

    ``tests``, ``crashes``, ``failed`` (S,). ``crash_mass``, ``failed_mass`` (S, S): over the crashed or failed tests of
    each stratum, the sum of their paths' probability of a cut-in of every stratum.
    """

    tests: IntArray
    crashes: Counts
    failed: Counts
    crash_mass: FloatArray
    failed_mass: FloatArray

    def part(self, strata: slice) -> Tally:
        """That of some strata."""
        counts = self.tests[strata], self.crashes[strata], self.failed[strata]
        return Tally(*counts, self.crash_mass[strata, strata], self.failed_mass[strata, strata])

    def plus(self, other: Tally) -> Tally:
        """With further tests of the same strata."""
        counts = self.tests + other.tests, self.crashes + other.crashes, self.failed + other.failed
        return Tally(*counts, self.crash_mass + other.crash_mass, self.failed_mass + other.failed_mass)

    def joined(self, groups: FloatArray) -> Tally:
        """That of groups of strata: ``groups``, shape (S, G), is 1 where a stratum belongs to one."""
        tests, crashes, failed = (np.rint(each @ groups).astype(np.int64) for each in self[:3])
        return Tally(tests, crashes, failed, groups.T @ self.crash_mass @ groups, groups.T @ self.failed_mass @ groups)

    def failed_as_crashes(self, where: BoolArray | None = None) -> Tally:
        """The same tests, had all failed ones crashed; with ``where``, shape (S,) bool, those of some strata alone."""
        if not self.failed.any():
            return self
        counted = np.ones(self.tests.size, np.bool_) if where is None else where
        failed, mass = self.failed * counted, self.failed_mass * counted[:, None]
        return Tally(
            self.tests, self.crashes + failed, self.failed - failed, self.crash_mass + mass, self.failed_mass - mass
        )

    @property
    def outcomes(self) -> Counts:
        """Crashes and other tests, shape (S, 2)."""
        return np.column_stack([self.crashes, self.tests - self.crashes])

    @property
    def totals(self) -> tuple[int, int, int]:
        """Tests, crashes and failed tests of all strata."""
        return int(self.tests.sum()), int(self.crashes.sum()), int(self.failed.sum())

    @property
    def share(self) -> FloatArray:
        """Share of tests that crashed, shape (S,)."""
        return np.asarray(self.crashes / self.at_least_one)

    @property
    def at_least_one(self) -> IntArray:
        """Number of tests, 1 where there is none, shape (S,)."""
        return np.maximum(self.tests, 1)


def empty_tally(n_strata: int) -> Tally:
    """That of no tests."""
    none, no_mass = np.zeros((3, n_strata), np.int64), np.zeros((2, n_strata, n_strata))
    return Tally(*none, *no_mass)


def pool_variance(p: FloatArray, tally: Tally, n_paths: int, factor: FloatArray | float = 1.0) -> float:
    """Variance of Σ p_s c_s that comes from the pool's finite number of paths, wherever the vehicle crashes.

    It is (Σ E[x_s x_t] - μ²)/n, see `mean_square`. A stratum in which no crash was seen adds nothing. ``factor`` (S,)
    says by how much crashes of each stratum are fewer than seen.
    """
    scale = p / tally.at_least_one * factor
    rate = float(scale @ tally.crashes)
    return max(mean_square(scale, tally.crash_mass) - rate * rate, 0.0) / n_paths


def mean_square(scale: FloatArray, crash_mass: FloatArray) -> float:
    """Bound of Σ E[x_s x_t], x_s being a path's probability of a crash in stratum s.

    A crashed test of s is a draw in proportion to x_s, so that B_st, p_s/n_s (``scale``, shape (S,)) times the sum of
    the paths' whole probabilities m_t in t over these tests (``crash_mass``, shape (S, S)), estimates E[x_s m_t], which
    E[x_s x_t] does not exceed; so it is at most the least of B_st, B_ts and, with Cauchy and Schwarz, √(B_ss B_tt).
    """
    bound = scale[:, None] * crash_mass
    own = np.sqrt(bound.diagonal())
    return float(np.minimum(np.minimum(bound, bound.T), own[:, None] * own).sum())


def combined(p: FloatArray, tally: Tally, n_paths: int, level: Level) -> RateLimits:
    """Rate Σ p_s c_s with the two limits of an interval; ``p`` (S,) are known from ``n_paths`` paths of a pool.

    The upper limit may lie above Σ p_s, which is as uncertain as the pool: a vehicle that crashes on all cut-ins has
    that rate.
    """
    worst, variance = tally.failed_as_crashes(), pool_variance(p, tally, n_paths)
    variance_of_worst = variance if worst is tally else pool_variance(p, worst, n_paths)
    low = likelihood_limit(p, tally.crashes, tally.tests, level, -1.0, variance)
    high = likelihood_limit(p, worst.crashes, worst.tests, level, 1.0, variance_of_worst)
    least = clopper_pearson(tally.crashes, tally.tests, float(ndtr(-level.z)))[0]
    least = np.divide(least, tally.share, out=np.zeros_like(least), where=tally.crashes > 0)
    from_pool, at_least = level.z * math.sqrt(variance), level.z * math.sqrt(pool_variance(p, tally, n_paths, least))
    return RateLimits(float(p @ tally.share), max(low, 0.0), min(high, 1.0), from_pool, at_least)


class CrashPaths:
    """Crashed tests by path and stratum: whether they lie on enough paths for an interval to be made of them.

    The pool of a vehicle that acts before the cut-in knows some hundred paths. If nearly all of its crashes lie on a
    few of them, as those of a vehicle that gives way do, then the paths which would matter most may well be missing,
    and nothing in the tests says so. With G a path's probability of a crash, (ΣG)²/ΣG² is the number of paths that
    count. Two crashed tests are of one path with the probability ΣG²/(ΣG)²: so it is estimated from pairs of them,
    without knowing any G.
    """

    def __init__(self) -> None:
        self._by_path: dict[bytes, IntArray] = {}

    def add(self, cell_mass: FloatArray, crashes: IntArray) -> None:
        """Count crashed tests of each stratum (n, S) on paths known by their probabilities of all cells (n, C)."""
        for mass, of_path in zip(cell_mass.astype(np.float32), crashes, strict=True):
            key = mass.tobytes()
            self._by_path[key] = self._by_path.get(key, 0) + of_path

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
