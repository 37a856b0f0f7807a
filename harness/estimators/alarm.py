"""The alarm that weights, traffic and pool do not belong together: surrogates must crash as often as the pool says.

W f_k has mean μ_k whatever the tests were drawn from and whatever the AV is. μ_k is tested by bets (I. Waudby-Smith, A.
Ramdas, JRSS B 86, 2024; why nothing is taken from the sample's variance: docs/estimators.md): a capital of 1 is
multiplied in every test by a factor that has mean 1 if μ_k is right. So has the product, which then exceeds 1/p with a
probability of p at most, after any number of tests and for any weights.

* Too many crashes: (1 + λ W f_k)/(1 + λ μ_k).
* Too few: exp(-λ W f_k) over its mean, which is at most 1 - (μ_k/c)(1 - exp(-λc)) where W f_k has the mean square cμ_k
  at most (Jensen's inequality; it makes W. Hoeffding's, JASA 58, 1963, out of a mean square instead of a bound). With
  forced cut-ins at a share α_0, W is P(cut-in | path)/α_0 at most, and the pool knows its mean where surrogates crash.
"""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
from scipy.special import logsumexp

from harness.estimators.block import Block
from harness.strata import KnownRates
from harness.vocabulary import FloatArray, Method

LEVEL = 1e-4
"""Probability of a false alarm, at most, after any given number of tests."""
BETS = 2.0 ** -np.arange(1.0, 25.0)
"""λ μ_k of the bets, whose capitals are averaged. The best λ is within a factor of 1.5 of one of them, which costs a
tenth of its growth; smaller ones would win nothing below 1e8 tests."""
_UNBOUNDED = "weights of the step mixture are not bounded: rare large ones may be missing, so that nothing is concluded"


class Alarm:
    """Sums of the surrogates' weighted crashes W f_k, arrays of shape (D,), and of log(1 + λ W f_k), (bets, D)."""

    def __init__(self) -> None:
        self._n = self._n_lost = 0
        self._method: Method | None = None
        self._known: KnownRates | None = None
        self._hits = self._sum = self._squares = self._mean_weight = np.zeros(0)
        self._won = np.zeros((BETS.size, 0))

    def add(self, block: Block) -> None:
        """Add one block, if surrogates were asked about it."""
        if block.known_rates is None or block.surrogates_crash is None:
            return
        h = np.where(block.surrogates_crash, block.weights()[:, None], 0.0)
        if self._known is None:
            d = h.shape[1]
            self._known, self._method = block.known_rates, block.method
            self._hits, self._sum, self._squares = np.zeros(d), np.zeros(d), np.zeros(d)
            self._mean_weight, self._won = _mean_weight(block, block.known_rates), np.zeros((BETS.size, d))
        self._n += len(block)
        self._n_lost += int(np.count_nonzero(block.failed & ~block.cut_in))
        self._hits += np.count_nonzero(h, axis=0)
        self._sum += h.sum(axis=0)
        self._squares += (h * h).sum(axis=0)
        relative = h / _unit(self._known)
        self._won += [np.log(1.0 + bet * relative).sum(axis=0) for bet in BETS]

    def result(self) -> dict[str, Any] | None:
        """Means against known rates, and whether the alarm is raised; None where no surrogate was asked."""
        if self._known is None:
            return None
        known, n = self._known, self._n
        mean = self._sum / n
        effective = np.divide(self._sum**2, self._squares, out=np.zeros_like(mean), where=self._squares > 0.0)
        log_capital = self._log_capital(known)
        p_value = _p_value(float(logsumexp(log_capital)) - math.log(mean.size))
        no_verdict = _UNBOUNDED if self._method == "step_mixture" else None
        if no_verdict is None and self._n_lost:
            lost = "failed tests have no cut-in, and what surrogates would have done in them is not known"
            no_verdict = f"{self._n_lost} {lost}"
        return {
            "raised": no_verdict is None and p_value <= LEVEL,
            "no_verdict": no_verdict,
            "pool": known.pool,
            "n_episodes": n,
            "p_value": p_value,
            "surrogates": [
                {
                    "surrogate": name,
                    "n_crashes": int(self._hits[k]),
                    "n_effective": float(effective[k]),
                    "mean": float(mean[k]),
                    "mu": float(known.mu[k]),
                    "mu_std_error": float(np.sqrt(known.covariance[k, k])),
                    "p_value": _p_value(float(log_capital[k])),
                }
                for k, name in enumerate(known.names)
            ],
        }

    def _log_capital(self, known: KnownRates) -> FloatArray:
        """Log of the mean capital of all bets on each surrogate, shape (D,).

        The pool's own error of μ_k is taken as normal. The log of each product then has a normal error too, and half
        its variance is what that adds to the log of the product's mean.
        """
        n, unit, bets = self._n, _unit(known), BETS[:, None]
        error = np.sqrt(np.diag(known.covariance)) / unit
        heavy = np.maximum(self._mean_weight / unit, 1.0)
        many, few = bets, np.expm1(-bets * heavy) / heavy  # mean factors are 1 + these, their errors these times μ_k's
        won = np.stack([self._won, -bets * self._sum / unit])
        gain = np.stack([np.broadcast_to(many, few.shape), few]) * (known.mu > 0.0)
        price = n * np.log1p(gain) + 0.5 * (n * gain * error / (1.0 + gain)) ** 2
        found: FloatArray = logsumexp(won - price, axis=(0, 1)) - math.log(2 * BETS.size)
        return found


def _unit(known: KnownRates) -> FloatArray:
    """Rates that bets are measured in, shape (D,); infinite where there is none, and then nothing is bet."""
    return np.where(known.mu > 0.0, known.mu, np.inf)


def _mean_weight(block: Block, known: KnownRates) -> FloatArray:
    """Mean square of W f_k over its mean, shape (D,), at most; infinite where nothing bounds W."""
    if block.weight_cap is not None:
        return np.full(known.mu.shape, block.weight_cap)
    share = block.forced_share
    return known.p_cut_in_at_crash / share if share else np.full(known.mu.shape, np.inf)


def _p_value(log_capital: float) -> float:
    """Probability of so much capital, at most (Markov); never 0, which no test can show."""
    return max(math.exp(-max(log_capital, 0.0)), sys.float_info.min)
