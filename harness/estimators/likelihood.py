"""Limits of weighted sums of shares within strata, Σ w_sj θ_sj, by the likelihood ratio.

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
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from harness.compiled import compiled
from harness.vocabulary import FloatArray, IntArray

Counts = IntArray | FloatArray
"""Of outcomes; where tests are planned, expected ones."""
CRASH = np.array([1.0, 0.0])
"""What outcomes count for where a test can only crash or not."""
PORTIONS = 6
"""Of further tests; with 4 or 12 campaigns take as many within 1 % (measured: IDM, brakes-8)."""
MARGIN = 0.395
"""Two-sided threshold for few crashes, ln(1/tail) less this: 2.60, 3.29 and 4.90 at 0.90, 0.95 and 0.99 (measured)."""
FEW_TESTS = 9
"""Below so many tests in all, a bound's threshold goes without the margin (measured)."""
LIKELY_Z = 0.84
"""Added to a quantile, it makes 80 % of repetitions of a normal sum: of pairs of tests 98 %, as limits are wide."""
_GRID = 64
_MOST_DOUBLINGS = 80
_MOST_STEPS = 200
_MOST_OCTAVES = 7


class Level(NamedTuple):
    """A threshold λ for few crashes, and the normal quantile for many that belongs to it."""

    threshold: float
    z: float

    @classmethod
    def two_sided(cls, confidence: float) -> Level:
        """For both limits of an interval."""
        tail = (1.0 - confidence) / 2.0
        return cls(-math.log(tail) - MARGIN, -float(ndtri(tail)))

    @classmethod
    def of_bound(cls, confidence: float, n: int) -> Level:
        """For an upper bound from n tests in all: that of an interval's upper limit.

        One that leaves out all of 1 - confidence above holds at a fixed number of tests, but not where a campaign has
        stopped: of a vehicle with a rare hole in 0.85 of 0.90 campaigns (docs/estimators.md).
        """
        few = cls.two_sided(confidence)
        return few._replace(threshold=few.threshold + MARGIN) if n < FEW_TESTS else few

    def likely(self) -> Level:
        """That of limits so wide that, where they leave out a number, those of this level mostly do in a repetition."""
        return Level((math.sqrt(2.0 * self.threshold) + LIKELY_Z) ** 2 / 2.0, self.z + LIKELY_Z)


class WeightedSum(NamedTuple):
    """What a limit is asked of: ``weights``, ``share`` (S, J), ``tests`` (S,); ``scratch`` (J,) is for `_profile`."""

    weights: FloatArray
    tests: FloatArray
    share: FloatArray
    side: float
    variance: float
    scratch: FloatArray

    @classmethod
    def of(cls, weights: FloatArray, counts: Counts, side: float, variance: float = 0.0) -> WeightedSum:
        """From counts of outcomes, shape (S, J)."""
        tests = counts.sum(1).astype(np.float64)
        share = counts / np.maximum(tests, 1.0)[:, None]
        return cls(np.ascontiguousarray(weights), tests, share, side, variance, np.empty(weights.shape[1]))


def likelihood_limit(
    weights: FloatArray, crashes: Counts, tests: IntArray, level: Level, side: float, variance: float = 0.0
) -> float:
    """One limit of Σ w_s θ_s, θ_s being the share of tests that crash; arrays (S,), the rest see `contrast_limit`."""
    outcomes = np.column_stack([crashes, tests - crashes])
    return contrast_limit(np.outer(weights, CRASH), outcomes, level, side, variance)


def contrast_limit(weights: FloatArray, counts: Counts, level: Level, side: float, variance: float = 0.0) -> float:
    """One limit, upper (``side`` +1) or lower (-1), of Σ w_sj θ_sj.

    ``weights`` (S, J) are known factors of all outcomes, 0 for one that does not count, and ``counts`` (S, J) how often
    each was seen; a stratum without a test may have any shares. ``variance`` is that of a further error of the sum
    itself (the pool's), normal and independent of the tests.
    """
    return float(outermost(WeightedSum.of(weights, counts, side, variance), level)[0])


def spread(weights: FloatArray, lower: Counts, upper: Counts, level: Level, size: int, most: IntArray) -> IntArray:
    """Divide ``size`` further tests among strata, shape (S,), so that they narrow the interval of Σ w_sj θ_sj most.

    They are given in portions, ``most`` (S,) to each stratum, and none where no test narrows anything. One more test of
    a stratum moves a limit by KL(c_s ‖ θ_s)/ν, by the envelope theorem; one without a test comes first. The counts
    (S, J) that either limit is from differ by what failed tests may have been.
    """
    more = np.zeros_like(most)
    below, above = WeightedSum.of(weights, lower, -1.0), WeightedSum.of(weights, upper, 1.0)
    give(below, above, level, min(size, int(most.sum())), -(-size // PORTIONS), most, more)
    return more


def ratio_limits(
    above: FloatArray,
    below: FloatArray,
    counts: Counts,
    level: Level,
    variance: Callable[[float], float] = lambda _: 0.0,
) -> tuple[float, float]:
    """Limits of x = Σ a_sj θ_sj / Σ b_sj θ_sj: the ratios x for which the contrast Σ (a - x b)θ may be 0.

    The contrast's limits fall as x grows, so that these x are an interval: from 0 where the sum above may be nothing,
    to infinity where the one below may. No factor (S, J) is negative; ``variance`` is of the contrast's further error.
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
    from scipy.optimize import brentq  # noqa: PLC0415 - a page asks for no limit

    return math.exp(float(brentq(at, inner, outer, xtol=1e-10)))


@compiled
def outermost(strata: WeightedSum, level: Level) -> tuple[float, float]:
    """A limit and its multiplier, 0 where no test says anything."""
    steepest = total = 0.0
    for s in range(strata.tests.size):
        low, high = math.inf, -math.inf
        for j in range(strata.scratch.size):
            low, high = min(low, strata.weights[s, j]), max(high, strata.weights[s, j])
        total += high if strata.side > 0.0 else low
        if strata.tests[s] > 0.0:
            steepest = max(steepest, (high - low) / strata.tests[s])
    if steepest == 0.0:
        return total, 0.0
    high = 1.0 / steepest
    for _ in range(_MOST_DOUBLINGS):
        if _refusal(strata, level, high, False) > 0.0:
            break
        high *= 2.0
    else:
        return _at(strata, level, high, level.threshold)[0], high  # shares are at their end: nothing is refused
    outer = _root(strata, level, 0.0, high, False)
    if _refusal(strata, level, outer, True) > 0.0:
        step = outer / (_GRID - 1)  # with many crashes: the outermost accepted multiplier, searched from outside
        k = _GRID - 2
        while _refusal(strata, level, k * step, True) > 0.0:  # at 0 nothing is refused
            k -= 1
        outer = _root(strata, level, k * step, (k + 1) * step, True)
    threshold = _threshold(level, _at(strata, level, outer, level.threshold)[2])
    return _at(strata, level, outer, threshold)[0], outer


@compiled
def give(
    below: WeightedSum, above: WeightedSum, level: Level, size: int, portion: int, most: IntArray, given: IntArray
) -> None:
    """See `spread`; ``given`` and the numbers of tests, whose shares stay, grow."""
    while size > 0:
        nu_below, nu_above = outermost(below, level)[1], outermost(above, level)[1]
        best, largest = 0, 0.0
        for s in range(most.size):
            if given[s] < most[s]:
                gain = _gain(below, s, nu_below) + _gain(above, s, nu_above)
                if gain > largest:
                    best, largest = s, gain
        if largest == 0.0:
            break
        more = min(portion, size, most[best] - given[best])
        given[best] += more
        below.tests[best] += more
        above.tests[best] += more
        size -= more


@compiled
def _gain(strata: WeightedSum, s: int, nu: float) -> float:
    """By how much one more test of a stratum moves the limit whose multiplier is ``nu``."""
    if strata.tests[s] == 0.0:
        return math.inf
    if nu == 0.0:
        return 0.0
    part = slice(s, s + 1)
    _, cost, _ = _profile(
        strata.side * nu, strata.weights[part], strata.tests[part], strata.share[part], 0.0, strata.scratch
    )
    return float(cost / (strata.tests[s] * nu))


@compiled
def _root(strata: WeightedSum, level: Level, low: float, high: float, by_crashes: bool) -> float:
    """Where a multiplier begins to be refused, by regula falsi (Illinois): compiled code cannot call scipy's roots."""
    at_low, at_high = _refusal(strata, level, low, by_crashes), _refusal(strata, level, high, by_crashes)
    end = 1e-13 * high
    last = 0
    for _ in range(_MOST_STEPS):
        middle = (low * at_high - high * at_low) / (at_high - at_low)
        refusal = _refusal(strata, level, middle, by_crashes)
        if refusal > 0.0:
            high, at_high = middle, refusal
            at_low *= 0.5 if last == -1 else 1.0
            last = -1
        else:
            low, at_low = middle, refusal
            at_high *= 0.5 if last == 1 else 1.0
            last = 1
        if refusal == 0.0 or high - low <= end:
            break
    return low


@compiled
def _refusal(strata: WeightedSum, level: Level, nu: float, by_crashes: bool) -> float:
    """By how much T at a multiplier is above the threshold, that for few crashes or that for their effective number."""
    _, cost, crashes = _at(strata, level, nu, level.threshold)
    if not by_crashes:
        return cost - level.threshold
    threshold = _threshold(level, crashes)
    if strata.variance == 0.0:  # the threshold has no part in T then
        return cost - threshold
    return _at(strata, level, nu, threshold)[1] - threshold


@compiled
def _threshold(level: Level, crashes: float) -> float:
    """Threshold at an effective number of crashes: λ up to 1.25 λ, χ² with a margin from 2 λ on, linear between."""
    few = level.threshold
    if crashes <= 1.25 * few:
        return few
    many = min(few, level.z**2 / 2.0 * (1.0 + 2.0 / math.sqrt(max(crashes, 2.0 * few))))
    return few + (many - few) * min((crashes / few - 1.25) / 0.75, 1.0)


@compiled
def _at(strata: WeightedSum, level: Level, nu: float, threshold: float) -> tuple[float, float, float]:
    """See `_profile`; the further error's variance is that which its own interval at the threshold would have."""
    variance = strata.variance * level.z**2 / (2.0 * threshold)
    return _profile(strata.side * nu, strata.weights, strata.tests, strata.share, variance, strata.scratch)


@compiled
def _profile(
    nu: float, weights: FloatArray, tests: FloatArray, share: FloatArray, variance: float, theta: FloatArray
) -> tuple[float, float, float]:
    """Sum, T and effective number of crashes at a multiplier; ``theta`` (J,) is room for the shares of one stratum."""
    total = variance * nu
    cost = 0.5 * variance * nu * nu
    spread = fourth = 0.0
    n_outcomes = weights.shape[1]
    for s in range(weights.shape[0]):
        best = 0
        for j in range(1, n_outcomes):
            if nu * weights[s, j] > nu * weights[s, best]:
                best = j
        n = tests[s]
        if n == 0.0:  # at its end, at no cost
            total += weights[s, best]
            continue
        slope = nu / n
        excess = _excess(slope, weights[s, best], weights[s], share[s])
        rest = 1.0
        for j in range(n_outcomes):
            theta[j] = 0.0
            if share[s, j] > 0.0:
                apart = excess + slope * (weights[s, best] - weights[s, j])
                theta[j] = share[s, j] / apart
                rest -= theta[j]
                cost += n * share[s, j] * math.log(apart)
        if excess == 0.0:
            theta[best] = max(rest, 0.0)
        for j in range(n_outcomes):
            total += weights[s, j] * theta[j]
            for i in range(j):
                square = ((weights[s, j] - weights[s, i]) / n) ** 2
                term = theta[i] * theta[j] * square * n
                spread += term
                fourth += term * square
    return total, cost, spread * spread / fourth if fourth > 0.0 else 0.0


@compiled
def _excess(slope: float, best: float, weights: FloatArray, share: FloatArray) -> float:
    """How far η of a stratum lies above its lowest value: root of Σ c_j/(x + slope·(best - w_j)) = 1, or 0.

    The sum falls and is convex in x: from a point where it is above 1 Newton's steps come up to the root and never go
    beyond it. At the largest c_j less what is added to x one term alone is 1.
    """
    x = 0.0
    for j in range(weights.size):
        x = max(x, share[j] - slope * (best - weights[j]))
    for _ in range(_MOST_STEPS):
        miss, fall = -1.0, 0.0
        for j in range(weights.size):
            if share[j] > 0.0:
                apart = x + slope * (best - weights[j])
                miss += share[j] / apart
                fall += share[j] / (apart * apart)
        if miss <= 0.0:
            break
        before = x
        x += miss / fall
        if x == before:
            break
    return x
