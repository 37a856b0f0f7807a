"""Likelihood ratios and the weight of an episode: log p/q_sampled, which estimators take the exponential of.

Per importance function j the logarithm L_j = Σ log(q_j/p) over the control steps so far is kept. The probability that a
step was sampled with, *given the shared history*, is the mixture Σ_j w_j q_j with

* step mixture: w_j = α_j in every step;
* episode mixture: the posterior weights w_j ∝ α_j exp(L_j). The drawn component itself is not part of the history.

Hence log q_sampled/p accumulates to Σ log Σ_j α_j q_j/p (step), or to log Σ_j α_j exp(L_j) (episode). Forced cut-ins
and shells know it at the beginning of the episode (`harness.episode.begin`): P(cut-in | path), and the shell's p_s.
Each control step adds its ratios (`harness.episode.critical_moment.update_ratios`), and the end of the episode asks for
`log_weight`, which is the record's (`harness.episode.judge.end_episode`).
"""

from __future__ import annotations

import math

from harness.compiled import compiled_inline
from harness.vocabulary import EPISODE_MIXTURE, FORCED, FloatArray


@compiled_inline
def log_weight(method: int, alpha: FloatArray, log_ratio: FloatArray, log_sampled: float, log_p_cut_in: float) -> float:
    """Log p(x_c) − log q_sampled(x_c) of a finished episode; exactly 0 without control.

    ``alpha``, ``log_ratio`` (M,) are weights and L_j of the importance functions; ``log_sampled`` is Σ log q_α/p of the
    step mixture, or −log p_s of the shell; ``log_p_cut_in`` is the path's, log P(cut-in | path).
    """
    if method == FORCED:
        return log_p_cut_in
    if method == EPISODE_MIXTURE:
        return -log_mixture(alpha, log_ratio)
    return -log_sampled


@compiled_inline
def log_mixture(alpha: FloatArray, log_ratio: FloatArray) -> float:
    """Log Σ_j α_j exp(L_j); ``alpha`` and ``log_ratio`` have shape (M,)."""
    largest = -math.inf
    for j in range(alpha.size):
        largest = max(largest, log_ratio[j])
    if largest == -math.inf:
        return -math.inf
    total = 0.0
    for j in range(alpha.size):
        total += alpha[j] * math.exp(log_ratio[j] - largest)
    return largest + math.log(total)


@compiled_inline
def accumulate(
    method: int,
    first: int,
    alpha: FloatArray,
    ratio: FloatArray,
    v: FloatArray,
    log_sampled: float,
    log_ratio: FloatArray,
    martingale: FloatArray,
) -> float:
    """Take the maneuver of one step into an episode's likelihood ratios; returns q_α/p, given the shared history.

    ``ratio`` (M,) is q_j/p of the maneuver, surrogates from index ``first`` on; ``v`` (J,) is V_j(s), 0 where the
    moment is not critical; ``log_sampled`` is the step mixture's Σ log q_α/p of the steps before. ``log_ratio`` (M,)
    is updated, ``martingale`` (J,) increased by W_{t−1} V_j (q_{j,t}/q_{α,t} − 1).
    """
    before = log_mixture(alpha, log_ratio) if method == EPISODE_MIXTURE else log_sampled
    sampled = 0.0
    for j in range(ratio.size):
        weight = alpha[j] * math.exp(log_ratio[j] - before) if method == EPISODE_MIXTURE else alpha[j]
        sampled += weight * ratio[j]
        log_ratio[j] += math.log(ratio[j])
    weight_before = math.exp(-before)
    for j in range(v.size):
        if v[j] > 0.0:
            martingale[j] += weight_before * v[j] * (ratio[first + j] / sampled - 1.0)
    return sampled


@compiled_inline
def forced_ratio(before: float, after: float, total: float, cut: bool) -> float:
    """q/p of a step under the forced cut-in: P(the step | a cut-in will come)/P(the step).

    ``before`` and ``after`` are the hazards accumulated until and including the step, ``total`` that of the path.
    """
    coming = -math.expm1(before - total)
    if coming <= 0.0:  # nothing was left of the path's hazard: the ratio so far is 0 and stays it
        return 1.0
    if cut:
        return 1.0 / coming
    return -math.expm1(min(after - total, 0.0)) / coming
