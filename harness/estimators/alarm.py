"""The alarm that weights, traffic and pool do not belong together: surrogates must crash as often as the pool says.

W f_k has mean μ_k whatever the tests were drawn from and whatever the AV is. A sample mean far from it means that a
likelihood ratio, a maneuver on record, the twin or the pool is wrong. Where weights are bounded by design this is a
test proper: of every surrogate alone (Holm's correction) and of all together (χ²), each at a level of 1e-4. Without a
bound, under the step mixture, rare large weights may be missing: the figures are shown and nothing is concluded.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import chdtrc, ndtr

from harness.arrays import FloatArray
from harness.estimators.block import Block
from harness.estimators.intervals import relative_entropy
from harness.methods import Method
from harness.strata import KnownRates

LEVEL = 1e-4
"""Probability of a false alarm, of each of the two tests."""
MANY_HITS = 100.0
"""Effective crashes of a surrogate above which its mean is taken as normal; below, Hoeffding's inequality decides."""
KNOWN_ERRORS = 4.0
"""How many standard errors of μ_k Hoeffding's inequality allows for."""
_UNBOUNDED = "weights of the step mixture are not bounded: rare large ones may be missing, so that nothing is concluded"
_LOST = "{n} failed tests have no cut-in, and what surrogates would have done in them is not known"


class Alarm:
    """Sums of the surrogates' weighted crashes W f_k, arrays of shape (D,)."""

    def __init__(self) -> None:
        self._n = self._n_lost = 0
        self._method: Method | None = None
        self._known: KnownRates | None = None
        self._cap = 0.0
        self._hits = self._sum = self._products = np.zeros(0)

    def add(self, block: Block) -> None:
        """Add one block, if surrogates were asked about it."""
        if block.known_rates is None or block.surrogates_crash is None:
            return
        h = np.where(block.surrogates_crash, block.weights()[:, None], 0.0)
        if self._known is None:
            d = h.shape[1]
            self._known, self._method = block.known_rates, block.method
            self._hits, self._sum, self._products = np.zeros(d), np.zeros(d), np.zeros((d, d))
        self._n += len(block)
        self._n_lost += int(np.count_nonzero(block.failed & ~block.cut_in))
        self._cap = max(self._cap, _cap(block))
        self._hits += np.count_nonzero(h, axis=0)
        self._sum += h.sum(axis=0)
        self._products += h.T @ h

    def result(self) -> dict[str, Any] | None:
        """Means against known rates, and whether the alarm is raised; None where no surrogate was asked."""
        if self._known is None:
            return None
        known, n = self._known, self._n
        mean = self._sum / n
        covariance = (self._products / n - np.outer(mean, mean)) / n + known.covariance
        error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        z = np.divide(mean - known.mu, error, out=np.zeros_like(mean), where=error > 0.0)
        squares = np.diag(self._products)
        effective = np.divide(self._sum**2, squares, out=np.zeros_like(mean), where=squares > 0.0)
        normal = effective >= MANY_HITS
        p_each = np.where(normal, 2.0 * ndtr(-np.abs(z)), self._bounded(mean, known))
        statistic, freedom = _joint((mean - known.mu)[normal], covariance[np.ix_(normal, normal)])
        p_joint = float(chdtrc(freedom, statistic)) if freedom else 1.0
        p_holm = float(min(1.0, p_each.min() * len(p_each)))  # the smallest decides whether any is rejected
        no_verdict = self._no_verdict()
        return {
            "raised": no_verdict is None and min(p_holm, p_joint) < LEVEL,
            "no_verdict": no_verdict,
            "pool": known.pool,
            "n_episodes": n,
            "chi2": statistic,
            "degrees_of_freedom": freedom,
            "p_value_jointly": p_joint,
            "p_value_holm": p_holm,
            "surrogates": [
                {
                    "surrogate": name,
                    "n_crashes": int(self._hits[k]),
                    "n_effective": float(effective[k]),
                    "mean": float(mean[k]),
                    "mu": float(known.mu[k]),
                    "mu_std_error": float(np.sqrt(known.covariance[k, k])),
                    "z": float(z[k]) if normal[k] else None,
                    "p_value": float(p_each[k]),
                }
                for k, name in enumerate(known.names)
            ],
        }

    def _no_verdict(self) -> str | None:
        if self._method == "step_mixture":
            return _UNBOUNDED
        return _LOST.format(n=self._n_lost) if self._n_lost else None

    def _bounded(self, mean: FloatArray, known: KnownRates) -> FloatArray:
        """Bound on the p-value of a mean of values in [0, cap] that are too few for the normal distribution.

        W. Hoeffding, Probability inequalities for sums of bounded random variables, JASA 58, 1963, Theorem 1.
        """
        slack = KNOWN_ERRORS * np.sqrt(np.diag(known.covariance))
        nearest = np.clip(mean, known.mu - slack, known.mu + slack)
        shares = zip(mean / self._cap, nearest / self._cap, strict=True)
        exponent = [relative_entropy(a, math.log(b)) if 0.0 < b < 1.0 and a <= 1.0 else 0.0 for a, b in shares]
        bound: FloatArray = np.minimum(1.0, 2.0 * np.exp(-self._n * np.array(exponent)))
        return bound


def _cap(block: Block) -> float:
    """Bound on W f_k for the tests of a block: the design's, else that of the paths driven, else 1."""
    if block.weight_cap is not None:
        return block.weight_cap
    log_cap = block.log_path_cap()
    return math.exp(log_cap) if math.isfinite(log_cap) else 1.0


def _joint(distance: FloatArray, covariance: FloatArray) -> tuple[float, int]:
    """χ² of several means at once, and its degrees of freedom; directions without variance are left out."""
    if distance.size == 0:
        return 0.0, 0
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-10
    along = vectors.T[kept] @ (distance / scale)
    return float((along**2 / values[kept]).sum()), int(np.count_nonzero(kept))
