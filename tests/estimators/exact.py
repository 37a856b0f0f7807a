"""What limits from counts are held against: coverage summed over all outcomes, nearest shares in closed form."""

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product

import numpy as np
from scipy.special import gammaln, xlogy


def _outcomes(share: Sequence[float], n: int) -> Iterator[tuple[float, np.ndarray]]:
    """How often ``n`` tests may have each outcome, the last being all that have no ``share``, and its probability."""
    counts = np.array([(*k, n - sum(k)) for k in product(range(n + 1), repeat=len(share)) if sum(k) <= n])
    shares = np.array([*share, max(1.0 - sum(share), 0.0)])
    chance = np.exp(gammaln(n + 1) - gammaln(counts + 1).sum(1) + xlogy(counts, shares).sum(1))
    likely = chance > 1e-6
    return zip(chance[likely].tolist(), counts[likely], strict=True)


def coverage(
    shares: Sequence[Sequence[float]],
    tests: Sequence[int],
    truth: float,
    limits: Callable[[np.ndarray], tuple[float, float]],
) -> float:
    """Probability that limits of counts (S, J) of independent strata hold the truth, unlikely counts being misses."""
    covered = 0.0
    for drawn in product(*(list(_outcomes(share, n)) for share, n in zip(shares, tests, strict=True))):
        chance = math.prod(probability for probability, _ in drawn)
        if chance > 1e-8:
            low, high = limits(np.array([counts for _, counts in drawn]))
            covered += chance * (low - 1e-9 <= truth <= high + 1e-9)  # up to rounding
    return covered


def tilted(a: np.ndarray, crashes: np.ndarray, tests: np.ndarray) -> tuple[np.ndarray, float]:
    """Shares nearest to those seen, tilted by ``a`` per test, as roots of a quadratic; and Σ n KL of them."""
    c = crashes / tests
    root = np.sqrt((1 - a) ** 2 + 4 * a * c)
    shares = np.where(a <= 1, 2 * c / (1 - a + root), (a - 1 + root) / (2 * np.where(a > 1, a, 1)))
    cost = xlogy(c, c) - xlogy(c, shares) + xlogy(1 - c, 1 - c) - xlogy(1 - c, 1 - shares)
    return shares, float((tests * cost).sum())
