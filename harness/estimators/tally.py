"""What tests of strata have come to: counts, the rate with its limits, the pool's own error, the paths of crashes.

Tests that failed count as no crash in the rate and in every lower limit, as crashes in every upper one: the limits are
monotone in each stratum's crashes, so that [L(k), U(k + f)] holds whatever the f failed tests would have come to.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from harness.estimators.likelihood import Counts, Level, likelihood_limit
from harness.estimators.limits import clopper_pearson
from harness.strata import weight_of_a_test
from harness.vocabulary import BoolArray, FloatArray, IntArray

FEWEST_PATHS = 40.0
"""Below so many paths that count there is no interval: their error alone would be above 16 %, and is not known."""
FEWEST_PAIRS, FEWEST_CRASHES, FEW_PAIRS = 3, 10, 10
"""Pairs of crashed tests of one baseline run, or crashes, that say something about the number of paths; pairs below
which the variance has room for one more."""
ROOM = 1.645
"""Standard errors of the variance, as told by the number of pairs, that are added to it."""


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
    """What tests of strata have come to: ``tests``, ``crashes``, ``failed`` (S,).

    ``crash_mass``, ``failed_mass`` (S, S) are, over crashed or failed tests of each stratum, the sum of their paths'
    probability of an event of every stratum; ``runs`` what is known of runs, of vehicles that act before the event.
    """

    tests: IntArray
    crashes: Counts
    failed: Counts
    crash_mass: FloatArray
    failed_mass: FloatArray
    runs: OnRuns | None = None

    @classmethod
    def counted(cls, tests: IntArray, crashes: Counts, failed: Counts) -> Tally:
        """Counts (S,) alone, of tests whose paths nobody has looked at."""
        return cls(tests, crashes, failed, *np.zeros((2, tests.size, tests.size)))  # which may be added to, each

    def part(self, strata: slice) -> Tally:
        """The tally of some strata."""
        return self.joined(np.eye(self.tests.size)[:, strata])

    def plus(self, other: Tally) -> Tally:
        """The tally with further tests of the same strata; without ``runs``."""
        counts = self.tests + other.tests, self.crashes + other.crashes, self.failed + other.failed
        return Tally(*counts, self.crash_mass + other.crash_mass, self.failed_mass + other.failed_mass)

    def joined(self, groups: FloatArray) -> Tally:
        """The tally of groups of strata: ``groups``, shape (S, G), is 1 where a stratum belongs to one."""
        tests, crashes, failed = (np.rint(counts @ groups).astype(np.int64) for counts in self[:3])
        masses = groups.T @ self.crash_mass @ groups, groups.T @ self.failed_mass @ groups
        return Tally(tests, crashes, failed, *masses, self.runs and self.runs.joined(groups))

    def failed_as_crashes(self, where: BoolArray | None = None) -> Tally:
        """The same tests, had all failed ones crashed; with ``where``, shape (S,) bool, those of some strata alone."""
        if not self.failed.any():
            return self
        chosen = np.ones(self.tests.size, np.bool_) if where is None else where
        failed, mass = self.failed * chosen, self.failed_mass * chosen[:, None]
        masses = self.crash_mass + mass, self.failed_mass - mass
        runs = self.runs and self.runs.failed_as_crashes(chosen)
        return Tally(self.tests, self.crashes + failed, self.failed - failed, *masses, runs)

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
        return weight_of_a_test(np.asarray(self.crashes, np.float64), self.tests)

    def rate(self, p: FloatArray) -> float:
        """Crashes per test: Σ p_s c_s, and no more than 1, as probabilities (S,) that the pool estimates may sum to."""
        return min(float(p @ self.share), 1.0)


def empty_tally(n_strata: int) -> Tally:
    """The tally of no tests."""
    return Tally.counted(*np.zeros((3, n_strata), np.int64))


class CrashedTests(NamedTuple):
    """Crashed and failed tests, (n,) each; ``place`` is the stratum, plus the number of strata if the test failed."""

    run: IntArray
    step: IntArray
    mass: FloatArray
    place: IntArray


class OnRuns(NamedTuple):
    """Which baseline runs the crashed and failed tests repeat: it tells the error of few paths, which a bound cannot.

    The pool of a vehicle that acts before the event knows some hundred paths, of which G_i is each one's weighted
    probability of a crash. A crashed test is a draw of an event in proportion to its probability m. So Σ y m over these
    tests, with y = p_s/n_s, estimates the mean over paths of what Σ m² is over their crashes, and Σ y y' over pairs of
    tests of one run in different steps, times the number of runs, that of Σ m m'. Both are the mean of G². Pairs alone
    would not do: an event is tested once, so that what it adds by itself does not show in them.

    ``own`` (2 S,) are sums of m, ``pairs`` (2 S, 2 S) numbers of ordered pairs, crashed tests of each stratum before
    failed ones.
    """

    n_runs: int
    own: FloatArray
    pairs: FloatArray

    @classmethod
    def of(cls, n_runs: int, n_strata: int, tests: CrashedTests) -> OnRuns:
        """What these crashed and failed tests say."""
        run, step, mass, place = tests

        def same(keys: NDArray[Any]) -> FloatArray:
            _, group = np.unique(keys, return_inverse=True)
            counts = np.zeros((group.max(initial=-1) + 1, 2 * n_strata))
            np.add.at(counts, (group, place), 1.0)
            return np.asarray(counts.T @ counts)

        own = np.bincount(place, mass, minlength=2 * n_strata).astype(np.float64)
        return cls(n_runs, own, same(run) - same(run + 1j * step))

    def _mapped(self, groups: FloatArray) -> OnRuns:
        return OnRuns(self.n_runs, self.own @ groups, groups.T @ self.pairs @ groups)

    def joined(self, groups: FloatArray) -> OnRuns:
        """The same of groups of strata, see `Tally.joined`."""
        zeros = np.zeros_like(groups)
        return self._mapped(np.block([[groups, zeros], [zeros, groups]]))

    def failed_as_crashes(self, where: BoolArray) -> OnRuns:
        """The same tests, had the failed ones of some strata (S,) crashed."""
        groups, s = np.eye(self.own.size), where.size
        groups[s:, :s], groups[s:, s:] = np.diag(where), np.diag(~where)
        return self._mapped(groups)

    def n_pairs(self, strata: BoolArray) -> float:
        """Pairs of crashed tests of one run, in different steps, within some strata (S,)."""
        return float(self.pairs[: strata.size, : strata.size][np.ix_(strata, strata)].sum()) / 2.0

    def square(self, scale: FloatArray, tally: Tally, errors: float = 0.0) -> float:
        """Estimate of the mean of G² over paths, each crash of a stratum counting ``scale`` (S,).

        ``errors`` standard errors of the variance, which the number of pairs tells, are added, or taken off. Without a
        pair the mean of G² has no upper end, and its lower one is the square of the mean.
        """
        s = scale.size
        n = self.n_pairs(scale > 0.0)
        pairs = self.pairs[:s, :s] + np.diag(self.pairs.diagonal()[:s] / np.maximum(tally.tests - 1, 1))
        square = float(scale @ self.own[:s] + self.n_runs * (scale @ pairs @ scale))
        if errors == 0.0:
            return square
        if n == 0.0:
            return math.inf if errors > 0.0 else 0.0
        square_of_mean = float(scale @ tally.crashes) ** 2
        excess = max(square - square_of_mean, 0.0) * max(1.0 + errors * math.sqrt(2.0 / n), 0.0)
        if n < FEW_PAIRS and errors > 0.0:
            excess += 2.0 * self.n_runs * float(np.max(scale[tally.crashes > 0], initial=0.0)) ** 2
        return square_of_mean + excess


def paths_that_count(p: FloatArray, tally: Tally, errors: float = 0.0) -> float:
    """On how many equally likely paths crashes would lie as close together: (ΣG)²/ΣG²; infinite while little is known.

    If nearly all crashes lie on a few paths, as those of a vehicle that gives way do, then paths which would matter
    most may well be missing, and nothing in the tests says so. ``errors`` see `OnRuns.square`.
    """
    runs, scale = tally.runs, weight_of_a_test(p, tally.tests)
    few = int(tally.crashes.sum()) < FEWEST_CRASHES
    if runs is None or (few and runs.n_pairs(p > 0.0) < FEWEST_PAIRS):
        return math.inf
    square = runs.square(scale, tally, errors)
    return runs.n_runs * float(scale @ tally.crashes) ** 2 / square if square > 0.0 else math.inf


def pool_variance(
    p: FloatArray, tally: Tally, n_paths: float, factor: FloatArray | float = 1.0, errors: float = ROOM
) -> float:
    """Variance of Σ p_s c_s that comes from the pool's finite number of paths: (Σ E[x_s x_t] - μ²)/n.

    A stratum in which no crash was seen adds nothing. ``factor`` (S,) is by how much crashes are fewer than seen.
    """
    scale = weight_of_a_test(p, tally.tests) * factor
    rate = float(scale @ tally.crashes)
    return max(crash_square(scale, tally, errors) - rate * rate, 0.0) / n_paths


def crash_square(scale: FloatArray, tally: Tally, errors: float = ROOM) -> float:
    """Σ E[x_s x_t], x_s being a path's probability of a crash in stratum s: its bound, or what is known of runs."""
    bound = mean_square(scale, tally.crash_mass)
    return bound if tally.runs is None else min(bound, tally.runs.square(scale, tally, errors))


def mean_square(scale: FloatArray, crash_mass: FloatArray) -> float:
    """The bound of Σ E[x_s x_t].

    A crashed test of s is a draw in proportion to x_s, so that B_st, p_s/n_s (``scale``, shape (S,)) times the sum of
    the paths' whole probabilities m_t in t over these tests (``crash_mass``, shape (S, S)), estimates E[x_s m_t], which
    E[x_s x_t] does not exceed; so it is at most the least of B_st, B_ts and, with Cauchy and Schwarz, √(B_ss B_tt).
    """
    bound = scale[:, None] * crash_mass
    own = np.sqrt(bound.diagonal())
    return float(np.minimum(np.minimum(bound, bound.T), own[:, None] * own).sum())


def combined(p: FloatArray, tally: Tally, n_paths: float, level: Level) -> RateLimits:
    """Rate Σ p_s c_s with the two limits of an interval; ``p`` (S,) are known from ``n_paths`` paths of a pool.

    The upper limit may lie above Σ p_s, the rate of a vehicle that crashes on all events: it is as uncertain as that.
    """
    worst = tally.failed_as_crashes()
    variance = pool_variance(p, tally, n_paths)
    variance_of_worst = variance if worst is tally else pool_variance(p, worst, n_paths)
    low = likelihood_limit(p, tally.crashes, tally.tests, level, -1.0, variance)
    high = likelihood_limit(p, worst.crashes, worst.tests, level, 1.0, variance_of_worst)
    least = clopper_pearson(tally.crashes, tally.tests, float(ndtr(-level.z)))[0]
    least = np.divide(least, tally.share, out=np.zeros_like(least), where=tally.crashes > 0)
    from_pool = level.z * math.sqrt(variance)
    at_least = level.z * math.sqrt(pool_variance(p, tally, n_paths, least, -ROOM))
    return RateLimits(tally.rate(p), min(max(low, 0.0), 1.0), min(high, 1.0), from_pool, at_least)
