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
    """Sums of the surrogates' weighted crashes."""

    def __init__(self) -> None:
        self.n = 0
        self.n_lost = 0
        self.method: Method | None = None
        self._known: KnownRates | None = None
        self._cap = 0.0
        self._hits: FloatArray = np.zeros(0)
        self._sum: FloatArray = np.zeros(0)
        self._products: FloatArray = np.zeros((0, 0))

    @property
    def asked(self) -> bool:
        """Whether any test was replayed."""
        return self._known is not None

    def add(self, block: Block) -> None:
        """Add one block, if surrogates were asked about it."""
        if block.known_rates is None or block.surrogates_crash is None:
            return
        if self._known is None:
            self._begin(block.known_rates)
        h = _weighted_surrogates(block)
        self.method = block.method
        self.n += len(block)
        self.n_lost += int(np.count_nonzero(block.failed & ~block.cut_in))
        self._cap = max(self._cap, _cap(block))
        self._hits += np.count_nonzero(h, axis=0)
        self._sum += h.sum(axis=0)
        self._products += h.T @ h

    def _begin(self, known: KnownRates) -> None:
        d = len(known.mu)
        self._known = known
        self._hits, self._sum, self._products = np.zeros(d), np.zeros(d), np.zeros((d, d))

    def result(self) -> dict[str, Any]:
        """Means against known rates, and whether the alarm is raised.

        Raises
        ------
        ValueError
            No test was replayed.
        """
        if self._known is None:
            raise ValueError("no surrogate was asked about any test")
        known, n = self._known, self.n
        mean = self._sum / n
        covariance = (self._products / n - np.outer(mean, mean)) / n + known.covariance
        error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        z = np.divide(mean - known.mu, error, out=np.zeros_like(mean), where=error > 0.0)
        squares = np.diag(self._products)
        effective = np.divide(self._sum**2, squares, out=np.zeros_like(mean), where=squares > 0.0)
        normal = effective >= MANY_HITS
        p_each = np.where(normal, 2.0 * ndtr(-np.abs(z)), self._bounded(mean))
        statistic, freedom = _joint((mean - known.mu)[normal], covariance[np.ix_(normal, normal)])
        p_joint = float(chdtrc(freedom, statistic)) if freedom else 1.0
        p_holm = float(min(1.0, p_each.min() * len(p_each)))  # the smallest decides whether any is rejected
        no_verdict = self._no_verdict()
        raised = no_verdict is None and min(p_holm, p_joint) < LEVEL
        return {
            "raised": raised,
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
        if self.method == "step_mixture":
            return _UNBOUNDED
        return _LOST.format(n=self.n_lost) if self.n_lost else None

    def _bounded(self, mean: FloatArray) -> FloatArray:
        """Bound on the p-value of a mean of values in [0, cap] that are too few for the normal distribution.

        W. Hoeffding, Probability inequalities for sums of bounded random variables, JASA 58, 1963, Theorem 1.
        """
        assert self._known is not None
        slack = KNOWN_ERRORS * np.sqrt(np.diag(self._known.covariance))
        mu = self._known.mu
        nearest = np.clip(mean, mu - slack, mu + slack)
        exponent = [_relative_entropy(a / self._cap, b / self._cap) for a, b in zip(mean, nearest, strict=True)]
        bound: FloatArray = np.minimum(1.0, 2.0 * np.exp(-self.n * np.array(exponent)))
        return bound


def _weighted_surrogates(block: Block) -> FloatArray:
    """Weighted crashes W f_k of the surrogates, shape (n, D); 0 where none crashes, whatever the weight."""
    crashes = block.surrogates_crash
    assert crashes is not None
    rows = crashes.any(axis=1)
    values = np.zeros(crashes.shape)
    values[rows] = np.exp(block.log_weight[rows])[:, None] * crashes[rows]
    return values


def _cap(block: Block) -> float:
    """Bound on W f_k that holds for the tests of a block: what the design says, or P(cut-in | path) over its share."""
    if block.weight_cap is not None:
        return block.weight_cap
    share = {"forced": 1.0, "episode_mixture": float(block.alpha[0]) if len(block.alpha) else 0.0}.get(block.method)
    if block.log_p_cut_in is None or not share:
        return 1.0
    return float(np.exp(np.max(block.log_p_cut_in))) / share


def _relative_entropy(a: float, b: float) -> float:
    """KL divergence of a coin with share ``a`` from one with probability ``b``; 0 where that is impossible."""
    if not 0.0 < b < 1.0 or a > 1.0:
        return 0.0
    hit = a * math.log(a / b) if a > 0.0 else 0.0
    return hit - (1.0 - a) * math.log1p((a - b) / (1.0 - a)) if a < 1.0 else hit


def _joint(distance: FloatArray, covariance: FloatArray) -> tuple[float, int]:
    """χ² of several means at once, and its degrees of freedom; directions without variance are left out."""
    if distance.size == 0:
        return 0.0, 0
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-10
    along = vectors.T[kept] @ (distance / scale)
    return float((along**2 / values[kept]).sum()), int(np.count_nonzero(kept))
