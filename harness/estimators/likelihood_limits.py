"""Limits of Σ w_sj θ_sj from counts of outcomes within strata, by the likelihood ratio.

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
adversarial strata, docs/estimators.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from harness.arrays import FloatArray, IntArray
from harness.estimators.limit_search import Counts, Level, Seen, give, outermost

PORTIONS = 6
"""Of further tests; with 4 or 12 campaigns take as many within 1 % (measured: IDM, brakes-8)."""
_MOST_OCTAVES = 7


def likelihood_limit(
    weights: FloatArray, crashes: Counts, tests: IntArray, level: Level, side: float, variance: float = 0.0
) -> float:
    """One limit of Σ w_s θ_s, θ_s being the share of tests that crash.

    Parameters
    ----------
    weights : ndarray, shape (S,)
        Known factors, negative ones for what is subtracted; 0 or more tests each.
    crashes, tests : ndarray of int64, shape (S,)
    level, side, variance
        See `contrast_limit`.
    """
    of_outcomes = np.column_stack([weights, np.zeros(weights.size)])
    return contrast_limit(of_outcomes, np.column_stack([crashes, tests - crashes]), level, side, variance)


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
    counts: IntArray,
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

    def lower(x: float) -> float:
        return contrast_limit(above - x * below, counts, level, -1.0, variance(x))

    def upper(x: float) -> float:
        return contrast_limit(above - x * below, counts, level, 1.0, variance(x))

    return _crossing(lower, end=0.0), _crossing(upper, end=math.inf)


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
