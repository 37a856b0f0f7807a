"""Limits of a mean of weighted tests: Clopper-Pearson, skewness-corrected, Hoeffding's (of shells: `likelihood`)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaincinv, gammaincinv, ndtri

from harness.vocabulary import FloatArray


def clopper_pearson(
    crashes: ArrayLike, tests: ArrayLike, tail: float, failed: ArrayLike = 0
) -> tuple[FloatArray, FloatArray]:
    """Exact limits of binomial shares, leaving out the probability ``tail`` at each end; [0, 1] without a test.

    Counts and limits have shape (S,); ``failed`` tests may have been crashes: only the upper limit counts them.
    """
    k, n = np.asarray(crashes, dtype=np.float64), np.asarray(tests, dtype=np.float64)
    worst = k + np.asarray(failed)
    low = np.where(k > 0, betaincinv(np.maximum(k, 0.5), n - k + 1.0, tail), 0.0)
    high = np.where(worst < n, betaincinv(worst + 1.0, np.maximum(n - worst, 0.5), 1.0 - tail), 1.0)
    return low, high


def garwood(counts: ArrayLike, tail: float) -> tuple[FloatArray, FloatArray]:
    """Exact limits of Poisson means (n,), leaving out the probability ``tail`` at each end (F. Garwood, 1936)."""
    k = np.asarray(counts, dtype=np.float64)
    low = np.where(k > 0, gammaincinv(np.maximum(k, 0.5), tail), 0.0)
    return low, np.asarray(gammaincinv(k + 1.0, 1.0 - tail), np.float64)


def skewed_distances(std_error: float, third_moment: float, tail: float) -> tuple[float, float]:
    """Distances of the limits of an estimate whose error is skewed, below and above: the farther of Hall's and normal.

    A mean of rare large values is skewed: samples without the largest have both a mean and a standard error that are
    too small, so that normal limits miss the truth above. Hall's transformation (P. Hall, On the removal of skewness by
    transformation, JRSS B 54, 1992) makes the studentised mean T nearly normal by g(T) = T + κT²/3 + κ²T³/27 + κ/6,
    which moves both limits towards the skew κ, the third central moment of the estimate's error over std_error³. But
    its lower limit is nearer than the normal one on the word of a skewness that is itself estimated, and misses too
    often (measured in docs/estimators.md). ``tail`` is left out on each side.
    """
    z = -float(ndtri(tail))
    normal = z * std_error
    if third_moment == 0.0 or not 0.0 < std_error < math.inf:
        return normal, normal
    skewness = third_moment / std_error**3
    return max(normal, _hall(z, skewness) * std_error), max(normal, -_hall(-z, skewness) * std_error)


def _hall(z: float, skewness: float) -> float:
    """g⁻¹(z) = (3/κ)[(1 + κ(z - κ/6))^(1/3) - 1]."""
    shifted = skewness * (z - skewness / 6.0)
    if abs(shifted) < 1e-6:  # the cube root would cancel; its series leaves out less than 1e-12
        return (z - skewness / 6.0) * (1.0 - shifted / 3.0)
    return 3.0 / skewness * (math.cbrt(1.0 + shifted) - 1.0)


def capped_mean_upper(mean: float, cap: float, n: int, confidence: float) -> float:
    """One-sided upper bound for the mean of n independent values in [0, cap], valid at every n, at most 1.

    It inverts Hoeffding's inequality in its relative-entropy form (W. Hoeffding, Probability inequalities for sums of
    bounded random variables, JASA 58, 1963, Theorem 1): P(mean ≤ x) ≤ exp(-n·KL(x/cap, μ/cap)) for x ≤ μ. For a mean
    of 0 it *is* the Clopper-Pearson bound times the cap; with crashes it uses their weights and not only their number.
    With an unknown, infinite cap only the trivial bound 1 is left.
    """
    if not math.isfinite(cap):
        return 1.0
    needed = -math.log1p(-confidence) / n
    if mean <= 0.0:
        return min(1.0, cap * -math.expm1(-needed))
    share, almost_one = mean / cap, math.log1p(-(2.0**-53))
    if share >= 1.0 or relative_entropy(share, almost_one) <= needed:
        return min(1.0, cap)
    from scipy.optimize import brentq  # noqa: PLC0415 - a page asks for no limit

    log_bound = brentq(
        lambda log_p: relative_entropy(share, log_p) - needed, math.log(share), almost_one, xtol=1e-14, rtol=1e-13
    )
    return min(1.0, cap * math.exp(float(log_bound)))


def relative_entropy(share: float, log_p: float) -> float:
    """KL divergence of a coin with a share in [0, 1] from one with probability exp(log_p), above 0 and below 1."""
    hit = share * (math.log(share) - log_p) if share > 0.0 else 0.0
    if share >= 1.0:
        return hit
    return hit + (1.0 - share) * (math.log1p(-share) - math.log(-math.expm1(log_p)))
