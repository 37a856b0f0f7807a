"""Crash rate as Σ p_s c_s with known p_s: intervals of the shares c_s combined, and the error of the p_s added.

Each share has its own exact (Clopper-Pearson) limits; they are combined by the method of variance estimates recovery
(G. Y. Zou and A. Donner, Statistics in Medicine 27, 2008, 1693): the distance of each limit of the sum is the root of
the summed squares of the terms' distances. A stratum without a crash widens the upper limit only.

Tests that failed count as no crash in the rate and in every lower limit, as crashes in every upper one: the limits are
monotone in each stratum's crashes, so that [L(k), U(k + f)] holds whatever the f failed tests would have come to.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import betaincinv, ndtri

from harness.arrays import FloatArray, IntArray


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
        return (self.high - self.low) / 2.0 / self.rate if self.rate > 0.0 else float("inf")

    @property
    def rhw_from_pool(self) -> float:
        """The pool's part of `rhw`; 0 at rate 0."""
        return self.from_pool / self.rate if self.rate > 0.0 else 0.0

    @property
    def rhw_from_pool_at_least(self) -> float:
        """What more tests of the same pool will not take away; 0 at rate 0."""
        return self.from_pool_at_least / self.rate if self.rate > 0.0 else 0.0


def share_limits(
    crashes: IntArray, tests: IntArray, tail: float, failed: IntArray | int = 0
) -> tuple[FloatArray, FloatArray]:
    """Clopper-Pearson limits of shares, each with the given tail probability; [0, 1] without a test.

    Parameters
    ----------
    crashes, tests : ndarray of int64, shape (S,)
    tail : float
        Probability left out at each end.
    failed : ndarray of int64, shape (S,)
        Tests that may have been crashes.

    Returns
    -------
    low, high : ndarray, shape (S,)
    """
    k, worst, n = crashes.astype(np.float64), (crashes + failed).astype(np.float64), tests.astype(np.float64)
    low = np.where(k > 0, betaincinv(np.maximum(k, 0.5), n - k + 1.0, tail), 0.0)
    high = np.where(worst < n, betaincinv(worst + 1.0, np.maximum(n - worst, 0.5), 1.0 - tail), 1.0)
    return low, high


def pool_variance(share: FloatArray, moments: FloatArray, rate: float, n_paths: int) -> float:
    """Variance of Σ p_s c_s that comes from the pool's finite number of paths.

    A path contributes at most its whole probability in the part of the strata in which the vehicle crashes. If its
    crashes were spread over paths, the mean square would be Σ c_s c_t m_st; if they were the same paths in all strata,
    Σ min(c_s, c_t) m_st. The latter is taken: an upper bound for a vehicle whose crashes do not favour the paths of
    largest probability within a shell. A stratum in which no crash was seen adds nothing.
    """
    worst = float((np.minimum(share[:, None], share[None, :]) * moments).sum())
    return max(worst - rate * rate, 0.0) / n_paths


def combined(
    p: FloatArray,
    crashes: IntArray,
    tests: IntArray,
    moments: FloatArray,
    n_paths: int,
    tail: float,
    failed: IntArray | int = 0,
) -> Limits:
    """Rate Σ p_s c_s with limits that leave out ``tail`` at each end.

    Parameters
    ----------
    p : ndarray, shape (S,)
        Probabilities of the strata.
    crashes, tests : ndarray of int64, shape (S,)
    moments, n_paths
        Of the pool, see `pool_variance`.
    failed : ndarray of int64, shape (S,)
        Tests that may have been crashes.
    """
    if np.any(failed):
        worst = combined(p, crashes + failed, tests, moments, n_paths, tail)
        return combined(p, crashes, tests, moments, n_paths, tail)._replace(high=worst.high)
    share = crashes / np.maximum(tests, 1)
    low, high = share_limits(crashes, tests, tail)
    rate = float(p @ share)
    z = -float(ndtri(tail))
    pool = z * z * pool_variance(share, moments, rate, n_paths)
    down = np.sqrt(((p * (share - low)) ** 2).sum() + pool)
    up = np.sqrt(((p * (high - share)) ** 2).sum() + pool)
    at_least = z * np.sqrt(pool_variance(low, moments, float(p @ low), n_paths))
    return Limits(rate, max(rate - float(down), 0.0), min(rate + float(up), 1.0), float(np.sqrt(pool)), float(at_least))
