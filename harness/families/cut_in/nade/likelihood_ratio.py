"""The weight of a test: the likelihood ratio of what happened in it, naturalistic over sampled.

**The weight of an episode** is p/q_sampled; what is kept is its logarithm. Per importance function j the logarithm
L_j = Σ log(q_j/p) over the control steps so far is kept. The probability that a step was sampled with, *given the
shared history*, is the mixture Σ_j w_j q_j with

* step mixture: w_j = α_j in every step;
* episode mixture: the posterior weights w_j ∝ α_j exp(L_j). The drawn component itself is not part of the history.

Hence log q_sampled/p accumulates to Σ log Σ_j α_j q_j/p (step), or to log Σ_j α_j exp(L_j) (episode). Each control step
adds its ratios (`record_lane`, `record_acceleration`); `decide.finish` writes the weight where the episode is over.

**What surrogates predicted** is summed up beside it: W_t C_j(s_t, a_t) − W_{t−1} V_j(s_t) over control steps, W being
the weight so far. Given the shared history its mean is 0 in every step, whatever the surrogate is, since q_sampled can
draw every maneuver that has a challenge. So the sum is a martingale, with a known mean: a control variate
(`harness.estimators.doubly_robust`).
"""

from __future__ import annotations

import math

from harness.compiled import compiled_inline
from harness.families.cut_in.nade.cells import NadeKernel
from harness.families.cut_in.nade.functions import Importance
from harness.families.cut_in.vocabulary import CUT_IN, STAY, State
from harness.loop.cells import KernelState
from harness.vocabulary import FloatArray


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
    importance: Importance,
    ratio: FloatArray,
    v: FloatArray,
    log_sampled: float,
    log_ratio: FloatArray,
    martingale: FloatArray,
) -> float:
    """Take the maneuver of one step into an episode's likelihood ratios; returns q_α/p, given the shared history.

    ``ratio`` (M,) is q_j/p of the maneuver; ``v`` (J,) is V_j(s), 0 where the moment is not critical; ``log_sampled``
    is the step mixture's Σ log q_α/p of the steps before. ``log_ratio`` (M,) is updated, ``martingale`` (J,) increased
    by W_t C_{j,t} − W_{t−1} V_j, with C_j/V_j = (q_j/p − ε)/(1 − ε): natural driving alone (ε = 1) says nothing of it.
    """
    posterior, alpha = importance.mixes_episodes, importance.alpha
    before = log_mixture(alpha, log_ratio) if posterior else log_sampled
    sampled = 0.0
    for j in range(ratio.size):
        weight = alpha[j] * math.exp(log_ratio[j] - before) if posterior else alpha[j]
        sampled += weight * ratio[j]
        log_ratio[j] += math.log(ratio[j])
    weight_before = math.exp(-before)
    for j in range(v.size):
        if v[j] > 0.0 and importance.epsilon < 1.0:
            challenge = (ratio[importance.n_forced + j] - importance.epsilon) / (1.0 - importance.epsilon)
            martingale[j] += weight_before * v[j] * (challenge / sampled - 1.0)
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


@compiled_inline
def record_lane(
    k: int, state: State, cut: bool, p: float, hazard: float, critical: bool, kernel: KernelState, nade: NadeKernel
) -> None:
    """Likelihood ratios of having stayed or cut in, and the moment if it was one of control.

    ``scratch.q`` and ``scratch.challenge`` (J,) are q_j(cut_in) and V_j where it is critical.
    """
    draws, scratch, importance = nade.cell[k], nade.scratch, nade.importance
    sampled = 1.0
    if critical or importance.n_forced == 1:
        if importance.n_forced == 1:
            scratch.ratio[0] = forced_ratio(draws.hazard, draws.hazard + hazard, draws.hazard_total, cut)
        for j in range(importance.n_surrogates):
            q = scratch.q[j]
            scratch.ratio[importance.n_forced + j] = (q / p if cut else (1.0 - q) / (1.0 - p)) if critical else 1.0
            scratch.challenge[j] = scratch.challenge[j] if critical else 0.0
        sampled = accumulate_step(k, kernel, nade)
    draws.hazard += hazard
    if critical:
        exposure = p if cut else 1.0 - p
        for j in range(importance.n_surrogates):
            scratch.q[j] = scratch.q[j] if cut else 1.0 - scratch.q[j]
        record_moment(k, state, CUT_IN if cut else STAY, exposure, exposure * sampled, kernel, nade)


@compiled_inline
def record_acceleration(k: int, state: State, maneuver: int, kernel: KernelState, nade: NadeKernel) -> None:
    """Likelihood ratios of an acceleration at a critical moment after the cut-in, and the moment.

    ``scratch.p`` (31,), ``scratch.q_acceleration`` (J, 31) and ``scratch.challenge`` (J,) are what it was drawn by.
    """
    scratch, importance, p = nade.scratch, nade.importance, nade.scratch.p[maneuver]
    if importance.n_forced == 1:
        scratch.ratio[0] = 1.0
    for j in range(importance.n_surrogates):
        scratch.q[j] = scratch.q_acceleration[j, maneuver]
        scratch.ratio[importance.n_forced + j] = scratch.q[j] / p
    sampled = accumulate_step(k, kernel, nade)
    record_moment(k, state, maneuver, p, p * sampled, kernel, nade)


@compiled_inline
def accumulate_step(k: int, kernel: KernelState, nade: NadeKernel) -> float:
    """Take ``scratch.ratio`` and ``scratch.challenge`` of a step into the likelihood ratios; returns its q_α/p."""
    scratch, importance, draws = nade.scratch, nade.importance, nade.cell[k]
    row = kernel.cells.cell[k].row
    log_ratio, martingale = nade.drawn.log_q[row], nade.drawn.martingale[row]
    sampled = accumulate(importance, scratch.ratio, scratch.challenge, draws.log_sampled, log_ratio, martingale)
    draws.log_sampled += math.log(sampled)
    return sampled


@compiled_inline
def record_moment(
    k: int, state: State, maneuver: int, p: float, q_sampled: float, kernel: KernelState, nade: NadeKernel
) -> None:
    """Count a control step, and keep it if the campaign keeps that many of an episode."""
    results, scratch, cell = nade.drawn, nade.scratch, kernel.cells.cell[k]
    kernel.episode[cell.row].n_control_steps += 1
    if kernel.episode[cell.row].n_control_steps > results.moment_limit:
        return
    i = results.moment_count[0]
    moment = results.moment[i]
    moment.row, moment.step, moment.maneuver = cell.row, cell.step, maneuver
    moment.v_bv_mps, moment.r1_m, moment.r1dot_mps = state.v_bv_mps, state.r1_m, state.r1dot_mps
    moment.r2_m, moment.r2dot_mps = state.r2_m, state.r2dot_mps
    moment.p, moment.q_sampled = p, q_sampled
    for j in range(scratch.q.size):
        results.moment_q[i, j] = scratch.q[j]
        results.moment_v[i, j] = scratch.challenge[j]
    results.moment_count[0] = i + 1
