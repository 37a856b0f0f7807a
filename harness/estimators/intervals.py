"""Intervals and bounds for a crash rate: Clopper-Pearson, skewness-corrected, and Hoeffding's for capped weights."""

from __future__ import annotations

import math

from scipy.optimize import brentq
from scipy.special import betaincinv, ndtri


def clopper_pearson(n_crashes: int, n: int, confidence: float) -> tuple[float, float]:
    """Exact two-sided interval for a binomial share.

    Parameters
    ----------
    n_crashes, n : int
        Crashes among n tests, n ≥ 1.
    confidence : float
        Level; each side keeps half of the rest.
    """
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if n_crashes == 0 else float(betaincinv(n_crashes, n - n_crashes + 1, tail))
    return low, clopper_pearson_upper(n_crashes, n, 1.0 - tail)


def clopper_pearson_upper(n_crashes: int, n: int, confidence: float) -> float:
    """Exact one-sided upper bound for a binomial share; without a crash 1 - (1 - confidence)^(1/n)."""
    if n_crashes == n:
        return 1.0
    if n_crashes == 0:
        return -math.expm1(math.log1p(-confidence) / n)
    return float(betaincinv(n_crashes + 1, n - n_crashes, confidence))


def normal_half_width(std_error: float, confidence: float) -> float:
    """Half-width of the two-sided normal interval."""
    return -float(ndtri((1.0 - confidence) / 2.0)) * std_error


def hall_distances(std_error: float, third_moment: float, tail: float) -> tuple[float, float]:
    """Distances of Hall's lower and upper limit from an estimate whose error is skewed.

    His transformation (P. Hall, On the removal of skewness by transformation, JRSS B 54, 1992) makes the studentised
    mean T nearly normal by g(T) = T + κT²/3 + κ²T³/27 + κ/6, which moves both limits towards the skew.

    Parameters
    ----------
    std_error : float
        Of the estimate.
    third_moment : float
        Third central moment of the estimate's error; over std_error³ it is the skewness κ.
    tail : float
        Probability to be left out on each side, below 1/2.
    """
    z = -float(ndtri(tail))
    if third_moment == 0.0 or not 0.0 < std_error < math.inf:
        return z * std_error, z * std_error
    skewness = third_moment / std_error**3
    return _hall(z, skewness) * std_error, -_hall(-z, skewness) * std_error


def skewed_distances(std_error: float, third_moment: float, tail: float) -> tuple[float, float]:
    """Distances of the lower and the upper limit that are reported for an estimate whose error is skewed.

    A mean of rare large values is skewed: samples without the largest have both a mean and a standard error that are
    too small, so that normal limits miss the truth above. Hall's limits mend that. But their lower limit is nearer than
    the normal one on the word of a skewness that is itself estimated, and misses too often. So each side keeps the
    farther one of the two (measured in docs/estimators.md).

    Parameters
    ----------
    std_error, third_moment, tail : float
        See `hall_distances`.

    Returns
    -------
    (float, float)
        Both at least the normal distance.
    """
    normal = -float(ndtri(tail)) * std_error
    below, above = hall_distances(std_error, third_moment, tail)
    return max(normal, below), max(normal, above)


def _hall(z: float, skewness: float) -> float:
    """g⁻¹(z) = (3/κ)[(1 + κ(z - κ/6))^(1/3) - 1]."""
    shifted = skewness * (z - skewness / 6.0)
    if abs(shifted) < 1e-6:  # the cube root would cancel; its series leaves out less than 1e-12
        return (z - skewness / 6.0) * (1.0 - shifted / 3.0)
    return 3.0 / skewness * (math.cbrt(1.0 + shifted) - 1.0)


def capped_mean_upper(mean: float, cap: float, n: int, confidence: float) -> float:
    """One-sided upper bound for the mean of independent values in [0, cap], valid at every n.

    It inverts Hoeffding's inequality in its relative-entropy form (W. Hoeffding, Probability inequalities for sums of
    bounded random variables, JASA 58, 1963, Theorem 1): P(mean ≤ x) ≤ exp(-n·KL(x/cap, μ/cap)) for x ≤ μ. For a mean
    of 0 it *is* the Clopper-Pearson bound times the cap; with crashes it uses their weights and not only their number.

    Parameters
    ----------
    mean : float
        Observed mean, in [0, cap].
    cap : float
        Largest possible value; infinite if unknown, and then only the trivial bound 1 is left.
    n : int
        Number of values.
    confidence : float
        Level of the bound.

    Returns
    -------
    float
        At most 1, since the mean is a probability.
    """
    if not math.isfinite(cap):
        return 1.0
    if mean <= 0.0:
        return min(1.0, cap * clopper_pearson_upper(0, n, confidence))
    share = mean / cap
    if share >= 1.0:
        return min(1.0, cap)
    needed = -math.log1p(-confidence) / n
    almost_one = math.log1p(-(2.0**-53))
    if _relative_entropy(share, almost_one) <= needed:
        return min(1.0, cap)
    log_bound = brentq(
        lambda log_p: _relative_entropy(share, log_p) - needed, math.log(share), almost_one, xtol=1e-14, rtol=1e-13
    )
    return min(1.0, cap * math.exp(float(log_bound)))


def _relative_entropy(share: float, log_p: float) -> float:
    """KL divergence of a coin with the given share from one with probability exp(log_p)."""
    log_miss = math.log(-math.expm1(log_p)) if log_p < 0.0 else -math.inf
    return share * (math.log(share) - log_p) + (1.0 - share) * (math.log1p(-share) - log_miss)
