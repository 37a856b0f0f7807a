"""Limits of Σ w_s θ_s from counts within strata, by the likelihood ratio.

An interval holds every value of the sum that some shares θ explain well enough: those for which the least
T(θ) = Σ n_s KL(c_s ‖ θ_s) is at most a threshold λ, c_s being the shares seen. Along one Lagrange multiplier ν,

    a = ν w_s/n_s,  D² = (1 - a)² + 4 a c_s,  θ_s = 2c_s/(1 - a + D),  1 - θ_s = 2(1 - c_s)/(1 + a + D),

T grows with |ν| and the sum with ν, so that each limit is one root. Weights may be negative (differences). Limits
of each stratum combined by their squares hold 90 %, but not 95 and 99 % where several strata with few crashes decide.

The threshold that holds whatever the counts is wider than needed where crashes are many. There χ²'s takes its place,
by the effective number of crashes m = v²/Σ w⁴θ(1-θ)/n³ with v = Σ w²θ(1-θ)/n. All thresholds are measured, not derived:
worst coverage over adversarial strata, docs/estimators.md.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtri

from harness.arrays import FloatArray, IntArray
from harness.compiled import compiled

MARGIN = 0.395
"""Two-sided threshold for few crashes, ln(1/tail) less this: 2.60, 3.29 and 4.90 at 0.90, 0.95 and 0.99 (measured)."""
FEW_TESTS = 9
"""Below so many tests in all, the one-sided threshold is ln(2/tail) instead of ln(1/tail) (measured)."""
_GRID = 64
_MOST_DOUBLINGS = 80


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

    def at(self, crashes: float) -> float:
        """Threshold at an effective number of crashes: λ up to 1.25 λ, χ² with a margin from 2 λ on, linear between."""
        few = self.threshold
        if crashes <= 1.25 * few:
            return few
        many = min(few, self.z**2 / 2.0 * (1.0 + 2.0 / math.sqrt(max(crashes, 2.0 * few))))
        return few + (many - few) * min((crashes / few - 1.25) / 0.75, 1.0)


def likelihood_limit(
    weights: FloatArray, crashes: IntArray, tests: IntArray, level: Level, side: float, variance: float = 0.0
) -> float:
    """One limit of Σ w_s θ_s.

    Parameters
    ----------
    weights : ndarray, shape (S,)
        Known factors, negative ones for what is subtracted; 0 or more tests each.
    crashes, tests : ndarray of int64, shape (S,)
    level : Level
    side : float
        +1 for the upper limit, -1 for the lower one.
    variance : float
        Of a further error, normal and independent of the tests, of the sum itself (the pool's).
    """
    n = tests.astype(np.float64)
    share = crashes / np.maximum(n, 1.0)
    tested = n > 0.0
    if not tested.any():
        return float(np.maximum(side * weights, 0.0).sum()) * side

    def at(nu: float, threshold: float) -> tuple[float, float, float]:
        kappa = level.z**2 / (2.0 * threshold)
        return _profile(side * nu, weights, n, share, variance * kappa)

    def excess(nu: float) -> float:
        return at(nu, level.threshold)[1] - level.threshold

    def refused(nu: float) -> float:
        threshold = level.at(at(nu, level.threshold)[2])
        return at(nu, threshold)[1] - threshold

    high = 1.0 / float(np.max(np.abs(weights[tested]) / n[tested]))
    for _ in range(_MOST_DOUBLINGS):
        if excess(high) > 0.0:
            break
        high *= 2.0
    else:
        return at(high, level.threshold)[0]  # all shares are at their end: nothing is left to be refused
    outer = float(brentq(excess, 0.0, high, xtol=1e-12 * high, rtol=1e-12))
    if refused(outer) > 0.0:  # with many crashes: the outermost accepted multiplier, searched from outside
        grid = pairwise(np.linspace(outer, 0.0, _GRID).tolist())
        outer, inner = next(pair for pair in grid if refused(pair[1]) <= 0.0)  # at 0 nothing is refused
        outer = float(brentq(refused, inner, outer, xtol=1e-12 * high, rtol=1e-12))
    return at(outer, level.at(at(outer, level.threshold)[2]))[0]


@compiled
def _profile(
    nu: float, weights: FloatArray, tests: FloatArray, share: FloatArray, variance: float
) -> tuple[float, float, float]:
    """Sum, T and effective number of crashes at a multiplier; a stratum without a test is at its end at no cost."""
    total = variance * nu
    cost = 0.5 * variance * nu * nu
    spread = fourth = 0.0
    for s in range(weights.size):
        w, n, c = weights[s], tests[s], share[s]
        if n == 0.0:
            total += w if nu * w > 0.0 else 0.0
            continue
        a = nu * w / n
        # Each root is a sum of what is not negative, and each quotient has a numerator that does not cancel.
        root = math.sqrt((1.0 - a) ** 2 + 4.0 * a * c if a > 0.0 else (1.0 + a) ** 2 - 4.0 * a * (1.0 - c))
        # A root of 0 belongs to a stratum whose tests all went one way, at its kink: 0/0 there, and 0 in the limit.
        below, above = 1.0 - a + root, 1.0 + a + root
        crash = (a - 1.0 + root) / (2.0 * a) if a > 1.0 else 2.0 * c / below if below > 0.0 else 0.0
        miss = (a + 1.0 - root) / (2.0 * a) if a < -1.0 else 2.0 * (1.0 - c) / above if above > 0.0 else 0.0
        if c > 0.0:
            cost += n * c * math.log(c / crash)
        if c < 1.0:
            cost += n * (1.0 - c) * math.log((1.0 - c) / miss)
        total += w * crash
        term = w * w * crash * miss / n
        spread += term
        fourth += term * (w / n) ** 2
    return total, cost, spread * spread / fourth if fourth > 0.0 else 0.0
