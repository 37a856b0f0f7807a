"""The search for a limit of Σ w_sj θ_sj along its Lagrange multiplier, and the stratum whose next tests move it most.

The equations are in `harness.estimators.stratified`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from harness.compiled import compiled
from harness.vocabulary import FloatArray, IntArray

Counts = IntArray | FloatArray
"""Of outcomes; where tests are planned, expected ones."""
MARGIN = 0.395
"""Two-sided threshold for few crashes, ln(1/tail) less this: 2.60, 3.29 and 4.90 at 0.90, 0.95 and 0.99 (measured)."""
FEW_TESTS = 9
"""Below so many tests in all, the one-sided threshold is ln(2/tail) instead of ln(1/tail) (measured)."""
_GRID = 64
_MOST_DOUBLINGS = 80
_MOST_STEPS = 200


class Level(NamedTuple):
    """A threshold and the normal quantile that belongs to it.

    Attributes
    ----------
    threshold : float
        λ for few crashes.
    z : float
        Quantile of the normal distribution for many.
    """

    threshold: float
    z: float

    @classmethod
    def two_sided(cls, confidence: float) -> Level:
        """For both limits of an interval."""
        tail = (1.0 - confidence) / 2.0
        return cls(-math.log(tail) - MARGIN, -float(ndtri(tail)))

    @classmethod
    def one_sided(cls, confidence: float, n: int) -> Level:
        """For an upper bound from n tests in all."""
        tail = 1.0 - confidence
        return cls(math.log((2.0 if n < FEW_TESTS else 1.0) / tail), -float(ndtri(tail)))


class Seen(NamedTuple):
    """What limits are asked of: ``weights``, ``share`` (S, J), ``tests`` (S,); ``room`` (J,) is for `_profile`."""

    weights: FloatArray
    tests: FloatArray
    share: FloatArray
    side: float
    variance: float
    room: FloatArray

    @classmethod
    def of(cls, weights: FloatArray, counts: Counts, side: float, variance: float = 0.0) -> Seen:
        """From counts of outcomes, shape (S, J)."""
        tests = counts.sum(1).astype(np.float64)
        share = counts / np.maximum(tests, 1.0)[:, None]
        return cls(np.ascontiguousarray(weights), tests, share, side, variance, np.empty(weights.shape[1]))


@compiled
def outermost(seen: Seen, level: Level) -> tuple[float, float]:
    """A limit and its multiplier, 0 where no test says anything."""
    steepest = total = 0.0
    for s in range(seen.tests.size):
        low, high = math.inf, -math.inf
        for j in range(seen.room.size):
            low, high = min(low, seen.weights[s, j]), max(high, seen.weights[s, j])
        total += high if seen.side > 0.0 else low
        if seen.tests[s] > 0.0:
            steepest = max(steepest, (high - low) / seen.tests[s])
    if steepest == 0.0:
        return total, 0.0
    high = 1.0 / steepest
    for _ in range(_MOST_DOUBLINGS):
        if _refusal(seen, level, high, False) > 0.0:
            break
        high *= 2.0
    else:
        return _at(seen, level, high, level.threshold)[0], high  # shares are at their end: nothing is refused
    outer = _root(seen, level, 0.0, high, False)
    if _refusal(seen, level, outer, True) > 0.0:
        step = outer / (_GRID - 1)  # with many crashes: the outermost accepted multiplier, searched from outside
        k = _GRID - 2
        while _refusal(seen, level, k * step, True) > 0.0:  # at 0 nothing is refused
            k -= 1
        outer = _root(seen, level, k * step, (k + 1) * step, True)
    threshold = _threshold(level, _at(seen, level, outer, level.threshold)[2])
    return _at(seen, level, outer, threshold)[0], outer


@compiled
def give(below: Seen, above: Seen, level: Level, size: int, portion: int, most: IntArray, given: IntArray) -> None:
    """See `spread`; ``given`` and the numbers of tests, whose shares stay, grow."""
    while size > 0:
        nu_below, nu_above = outermost(below, level)[1], outermost(above, level)[1]
        best, largest = 0, -1.0
        for s in range(most.size):
            if given[s] < most[s]:
                gain = _gain(below, s, nu_below) + _gain(above, s, nu_above)
                if gain > largest:
                    best, largest = s, gain
        more = min(portion, size, most[best] - given[best])
        given[best] += more
        below.tests[best] += more
        above.tests[best] += more
        size -= more


@compiled
def _gain(seen: Seen, s: int, nu: float) -> float:
    """By how much one more test of a stratum moves the limit that has a multiplier."""
    if seen.tests[s] == 0.0:
        return math.inf
    if nu == 0.0:
        return 0.0
    part = slice(s, s + 1)
    _, cost, _ = _profile(seen.side * nu, seen.weights[part], seen.tests[part], seen.share[part], 0.0, seen.room)
    return float(cost / (seen.tests[s] * nu))


@compiled
def _root(seen: Seen, level: Level, low: float, high: float, by_crashes: bool) -> float:
    """Where a multiplier begins to be refused: regula falsi, an end that stays counting half (Illinois).

    Compiled code cannot call scipy's roots, and this is a planner's hot loop.
    """
    at_low, at_high = _refusal(seen, level, low, by_crashes), _refusal(seen, level, high, by_crashes)
    end = 1e-13 * high
    kept = 0
    for _ in range(_MOST_STEPS):
        middle = (low * at_high - high * at_low) / (at_high - at_low)
        found = _refusal(seen, level, middle, by_crashes)
        if found > 0.0:
            high, at_high = middle, found
            at_low *= 0.5 if kept == -1 else 1.0
            kept = -1
        else:
            low, at_low = middle, found
            at_high *= 0.5 if kept == 1 else 1.0
            kept = 1
        if found == 0.0 or high - low <= end:
            break
    return low


@compiled
def _refusal(seen: Seen, level: Level, nu: float, by_crashes: bool) -> float:
    """By how much T at a multiplier is above the threshold, that for few crashes or that for their effective number."""
    _, cost, crashes = _at(seen, level, nu, level.threshold)
    if not by_crashes:
        return cost - level.threshold
    threshold = _threshold(level, crashes)
    return _at(seen, level, nu, threshold)[1] - threshold


@compiled
def _threshold(level: Level, crashes: float) -> float:
    """Threshold at an effective number of crashes: λ up to 1.25 λ, χ² with a margin from 2 λ on, linear between."""
    few = level.threshold
    if crashes <= 1.25 * few:
        return few
    many = min(few, level.z**2 / 2.0 * (1.0 + 2.0 / math.sqrt(max(crashes, 2.0 * few))))
    return few + (many - few) * min((crashes / few - 1.25) / 0.75, 1.0)


@compiled
def _at(seen: Seen, level: Level, nu: float, threshold: float) -> tuple[float, float, float]:
    """See `_profile`; the further error's variance is that which its own interval at the threshold would have."""
    variance = seen.variance * level.z**2 / (2.0 * threshold)
    return _profile(seen.side * nu, seen.weights, seen.tests, seen.share, variance, seen.room)


@compiled
def _profile(
    nu: float, weights: FloatArray, tests: FloatArray, share: FloatArray, variance: float, theta: FloatArray
) -> tuple[float, float, float]:
    """Sum, T and effective number of crashes at a multiplier; a stratum without a test is at its end at no cost.

    ``theta``, shape (J,), is room for the shares of one stratum.
    """
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
        if n == 0.0:
            total += weights[s, best]
            continue
        slope = nu / n
        excess = _excess(slope, weights[s, best], weights[s], share[s])
        left = 1.0
        for j in range(n_outcomes):
            theta[j] = 0.0
            if share[s, j] > 0.0:
                apart = excess + slope * (weights[s, best] - weights[s, j])
                theta[j] = share[s, j] / apart
                left -= theta[j]
                cost += n * share[s, j] * math.log(apart)
        if excess == 0.0:
            theta[best] = max(left, 0.0)
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
