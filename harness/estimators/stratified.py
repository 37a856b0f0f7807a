"""Weighted sums of shares within strata, Σ w_sj θ_sj: counts, limits by the likelihood ratio, and the pool's own error.

Each test of stratum s has one of several outcomes j: crash or not; of a pair of tests, which of the two crashed. An
interval holds every value of the weighted sum that some shares θ explain well enough: those for which the least
T(θ) = Σ n_s KL(c_s ‖ θ_s) is at most a threshold λ, c_s being the shares seen. Along one Lagrange multiplier ν,

    θ_sj = c_sj/(η_s - ν w_sj/n_s),  with the root η_s of Σ_j θ_sj = 1,

T grows with |ν| and the sum with ν, so that each limit is one root. No η_s is below the largest ν w_sj/n_s: where it
would be, it stays there, and an outcome that was never seen takes what is left. Two outcomes of weights w and 0 are a
binomial stratum. Weights may be negative (differences). Limits of each stratum combined by their squares hold 90 %, but
not 95 and 99 % where several strata with few crashes decide.

The threshold that holds whatever the counts is wider than needed where crashes are many. There χ²'s takes its place,
by the effective number of crashes m = v²/f, with v = ΣΣ θ_i θ_j (w_i - w_j)²/n over strata and pairs of outcomes, which
is the sum's variance, and f = ΣΣ θ_i θ_j (w_i - w_j)⁴/n³. All thresholds are measured, not derived: worst coverage over
adversarial strata, docs/estimators.md. The search for a root is in `harness.estimators.limit_search`.

Tests that failed count as no crash in the rate and in every lower limit, as crashes in every upper one: the limits are
monotone in each stratum's crashes, so that [L(k), U(k + f)] holds whatever the f failed tests would have come to.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from harness.estimators.intervals import clopper_pearson
from harness.estimators.limit_search import Counts, Level, Seen, give, outermost
from harness.vocabulary import BoolArray, FloatArray, IntArray

CRASH = np.array([1.0, 0.0])
"""What outcomes count for where a test can only crash or not."""
PORTIONS = 6
"""Of further tests; with 4 or 12 campaigns take as many within 1 % (measured: IDM, brakes-8)."""
_MOST_OCTAVES = 7


class Limits(NamedTuple):
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

    def from_pool_relative(self) -> dict[str, float]:
        """The pool's part of `rhw`, and what of it more tests of the same pool will not take away; 0 at rate 0."""
        rate = self.rate if self.rate > 0.0 else math.inf
        return {"rhw_from_pool": self.from_pool / rate, "rhw_from_pool_at_least": self.from_pool_at_least / rate}


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

    def scaled(self, tests: IntArray) -> Tally:
        """What so many tests of each stratum are expected to come to."""
        scale = tests / self.at_least_one
        mass = self.crash_mass * scale[:, None], self.failed_mass * scale[:, None]
        return Tally(tests, self.crashes * scale, self.failed * scale, *mass)

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

    It is (Σ E[x_s x_t] - μ²)/n, see `mean_square`. A stratum in which no crash was seen adds nothing.

    Parameters
    ----------
    p : ndarray, shape (S,)
        Probabilities of the strata.
    factor : ndarray, shape (S,)
        By which crashes of each stratum are fewer than seen.
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


def combined(p: FloatArray, tally: Tally, n_paths: int, level: Level) -> Limits:
    """Rate Σ p_s c_s with the two limits of an interval; ``p`` (S,) are known from ``n_paths`` paths of a pool."""
    worst, variance = tally.failed_as_crashes(), pool_variance(p, tally, n_paths)
    variance_of_worst = variance if worst is tally else pool_variance(p, worst, n_paths)
    low = likelihood_limit(p, tally.crashes, tally.tests, level, -1.0, variance)
    high = likelihood_limit(p, worst.crashes, worst.tests, level, 1.0, variance_of_worst)
    least = clopper_pearson(tally.crashes, tally.tests, float(ndtr(-level.z)))[0]
    least = np.divide(least, tally.share, out=np.zeros_like(least), where=tally.crashes > 0)
    from_pool, at_least = level.z * math.sqrt(variance), level.z * math.sqrt(pool_variance(p, tally, n_paths, least))
    return Limits(float(p @ tally.share), max(low, 0.0), min(high, float(p.sum())), from_pool, at_least)


def likelihood_limit(
    weights: FloatArray, crashes: Counts, tests: IntArray, level: Level, side: float, variance: float = 0.0
) -> float:
    """One limit of Σ w_s θ_s, θ_s being the share of tests that crash.

    ``weights`` (known factors, negative for what is subtracted), ``crashes`` and ``tests`` have shape (S,); the rest
    see `contrast_limit`.
    """
    outcomes = np.column_stack([crashes, tests - crashes])
    return contrast_limit(np.outer(weights, CRASH), outcomes, level, side, variance)


def contrast_limit(weights: FloatArray, counts: Counts, level: Level, side: float, variance: float = 0.0) -> float:
    """One limit of Σ w_sj θ_sj, θ_sj being the share of a stratum's tests with an outcome.

    Parameters
    ----------
    weights : ndarray, shape (S, J)
        Known factors of all outcomes; 0 for one that does not count.
    counts : ndarray of int64, shape (S, J)
        How often each was seen; a stratum without a test may have any shares.
    level : Level
    side : float
        +1 for the upper limit, -1 for the lower one.
    variance : float
        Of a further error, normal and independent of the tests, of the sum itself (the pool's).
    """
    return float(outermost(Seen.of(weights, counts, side, variance), level)[0])


def spread(weights: FloatArray, lower: Counts, upper: Counts, level: Level, size: int, most: IntArray) -> IntArray:
    """Divide further tests among strata, shape (S,), so that they narrow the interval of Σ w_sj θ_sj most.

    Portions are given one after the other. With shares and threshold as they are one more test of a stratum moves
    a limit by KL(c_s ‖ θ_s)/ν, by the envelope theorem; a stratum without a test comes first.

    Parameters
    ----------
    weights : ndarray, shape (S, J)
    lower, upper : ndarray, shape (S, J)
        Counts of outcomes that either limit is from: they differ by what failed tests may have been.
    level : Level
    size : int
        How many tests.
    most : ndarray of int64, shape (S,)
        How many there are of each stratum.
    """
    given = np.zeros_like(most)
    below, above = Seen.of(weights, lower, -1.0), Seen.of(weights, upper, 1.0)
    give(below, above, level, min(size, int(most.sum())), -(-size // PORTIONS), most, given)
    return given


def ratio_limits(
    above: FloatArray,
    below: FloatArray,
    counts: Counts,
    level: Level,
    variance: Callable[[float], float] = lambda _: 0.0,
) -> tuple[float, float]:
    """Limits of x = Σ a_sj θ_sj / Σ b_sj θ_sj: the ratios x for which Σ (a - x b)θ may be 0.

    Both limits of that contrast fall as x grows, so that the set is an interval: from 0 where the sum above may be
    nothing, to infinity where the one below may.

    Parameters
    ----------
    above, below : ndarray, shape (S, J)
        Factors of the outcomes in both sums, none negative.
    counts : ndarray of int64, shape (S, J)
    level : Level
    variance : callable
        Of the further error of the contrast at a ratio, see `contrast_limit`.
    """

    def limit(side: float, x: float) -> float:
        return contrast_limit(above - x * below, counts, level, side, variance(x))

    return _crossing(partial(limit, -1.0), end=0.0), _crossing(partial(limit, 1.0), end=math.inf)


def _crossing(falling: Callable[[float], float], end: float) -> float:
    """Positive argument at which a function falls through 0; ``end``, 0 or infinity, where it does not before that."""
    outwards = 1.0 if end else -1.0

    def at(log_x: float) -> float:
        return outwards * falling(math.exp(log_x))

    inner = outer = 0.0
    for step in range(_MOST_OCTAVES):
        if at(outer) < 0.0:
            break
        inner, outer = outer, outer + outwards * 2.0**step
    else:
        return end
    for step in range(_MOST_OCTAVES):
        if at(inner) >= 0.0:
            break
        inner, outer = inner - outwards * 2.0**step, inner
    else:
        return 0.0 if end else math.inf  # beyond the other end
    return math.exp(float(brentq(at, inner, outer, xtol=1e-10)))
