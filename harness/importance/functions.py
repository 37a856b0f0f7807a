"""Importance functions q_j at a critical moment, before and after the cut-in.

    q_j(a|s) = ε p(a|s) + (1 − ε) p(a|s) C_j(s, a)/V_j(s),   V_j(s) = Σ_a p(a|s) C_j(s, a);   q_j = p where V_j = 0.

A moment is critical if any V_j exceeds the threshold. Before the cut-in the maneuvers are {stay, cut_in}; after it, at
redraw times, the 31 accelerations.

**The weight of an episode** is p/q_sampled; what is kept is its logarithm. Per importance function j the logarithm
L_j = Σ log(q_j/p) over the control steps so far is kept. The probability that a step was sampled with, *given the
shared history*, is the mixture Σ_j w_j q_j with

* step mixture: w_j = α_j in every step;
* episode mixture: the posterior weights w_j ∝ α_j exp(L_j). The drawn component itself is not part of the history.

Hence log q_sampled/p accumulates to Σ log Σ_j α_j q_j/p (step), or to log Σ_j α_j exp(L_j) (episode). Forced cut-ins
and shells know it at the beginning of the episode (`harness.episode.decide`): P(cut-in | path), and the shell's p_s.
Each control step adds its ratios (`harness.episode.decide.update_ratios`), and the end of the episode asks for
`log_weight`, which is the record's (`harness.episode.judge.end_episode`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from harness.compiled import compiled_inline
from harness.importance.challenge import level_of
from harness.importance.grid import AFTER, BEFORE, interpolate, interpolate_maneuvers, locate
from harness.maneuvers import N_ACCELERATIONS
from harness.traffic.laws import Environment, acceptance
from harness.vehicles.kinematics import CONTACT_M, STEP_S, next_speed
from harness.vocabulary import EPISODE_MIXTURE, FORCED, BoolArray, Float32Array, FloatArray, State


class Importance(NamedTuple):
    """All that kernels need to sample critical moments.

    ``method`` is one of `harness.vocabulary.METHODS`; ``recursive`` says which challenge; ``n_surrogates`` is 0 where
    nobody is asked; ``first`` is the index of the first surrogate among the importance functions: 1 when the forced
    cut-in is component 0. ``steps_per_level`` lie between two levels of ``value``.
    ``alpha`` (M,) are the mixture weights. ``value`` (J, levels + 1, v, R2, R2dot), ``maneuvers`` (J, v, R2, R2dot, 31)
    and ``before`` (J, redraw times + 1, v, R2, R2dot) are the challenge tables (see `harness.importance.tables`).
    ``harmless`` (J, v - 1, R2 - 1, R2dot - 1) marks the grid cells after the cut-in in which no acceleration challenges
    a surrogate: most of what is driven lies there, and nothing needs to be interpolated.
    """

    method: int
    recursive: bool
    n_surrogates: int
    first: int
    steps_per_level: int
    epsilon: float
    threshold: float
    alpha: FloatArray
    value: Float32Array
    maneuvers: Float32Array
    before: Float32Array
    harmless: BoolArray


@compiled_inline
def as_challenge(tabulated: float, recursive: bool) -> float:
    """Challenge from a table entry: a probability (recursive), or a smallest gap in metres (immediate)."""
    if recursive:
        return tabulated
    return 1.0 if tabulated < CONTACT_M else 0.0


@compiled_inline
def look_ahead(
    state: State,
    bv_acceleration: float,
    step: int,
    environment: Environment,
    importance: Importance,
    cut_challenge: FloatArray,
    stay_challenge: FloatArray,
) -> None:
    """Challenges of cutting in and of staying, for every step of the hold period that begins now.

    Until its next redraw BV's motion is known and the AV holds its speed, so one sweep serves the whole period.
    ``cut_challenge`` (hold, J) receives C_j(s_i, cut_in); ``stay_challenge`` (hold, J) the challenge of staying per
    unit of OL (zero for the immediate challenge).
    """
    n, hold = environment.numbers, environment.numbers.hold_steps
    speed, r2 = state.v_bv_mps, state.r2_m
    follower = speed - state.r2dot_mps
    for i in range(hold):
        accepted = acceptance(r2, speed - follower, environment)
        passed = r2 <= 0.0
        after = next_speed(speed, bv_acceleration)
        r2 += (0.5 * (speed + after) - follower) * STEP_S
        speed = after
        where = locate(AFTER, speed, r2, speed - follower)
        level = level_of(step + i, n.max_steps, importance.steps_per_level, importance.value.shape[1] - 1)
        for j in range(importance.n_surrogates):
            challenge = 0.0
            if not passed and level >= 0:
                challenge = as_challenge(interpolate(importance.value[j, level], where), importance.recursive)
            cut_challenge[i, j] = challenge
            stay_challenge[i, j] = STEP_S * accepted * challenge
    if not importance.recursive:
        stay_challenge[:, :] = 0.0
        return
    period = (step + hold) // hold
    where_end = locate(BEFORE, speed, r2, speed - follower)
    for j in range(importance.n_surrogates):
        later = 0.0
        if r2 > 0.0 and period < importance.before.shape[1]:
            later = interpolate(importance.before[j, period], where_end)
        for i in range(hold - 1, -1, -1):
            here = stay_challenge[i, j]
            stay_challenge[i, j] = later
            later += here


@compiled_inline
def propose_cut_in(
    p: float,
    opportunity_1s: float,
    cut_challenge: FloatArray,
    stay_challenge: FloatArray,
    importance: Importance,
    q: FloatArray,
    v: FloatArray,
) -> bool:
    """Probability of ``cut_in`` under every surrogate's importance function; returns whether the moment is critical.

    ``p`` is the exposure of ``cut_in``, ``opportunity_1s`` OL of the state, which turns ``stay_challenge`` (J,) into a
    probability. ``q`` (J,) receives q_j(cut_in | s), ``v`` (J,) V_j(s).
    """
    critical = False
    for j in range(importance.n_surrogates):
        staying = -math.expm1(-opportunity_1s * stay_challenge[j]) if importance.recursive else 0.0
        cutting = p * cut_challenge[j]
        total = cutting + (1.0 - p) * staying
        v[j] = total
        q[j] = p
        if total > 0.0:
            q[j] = importance.epsilon * p + (1.0 - importance.epsilon) * (cutting / total)
        critical = critical or total > importance.threshold
    return critical


@compiled_inline
def challenges_nobody(state: State, importance: Importance) -> bool:
    """Whether a state after the cut-in is seen to be uncritical without a look at any acceleration."""
    i, _, j, _, k, _ = locate(AFTER, state.v_bv_mps, state.r2_m, state.r2dot_mps)
    harmless = True
    for surrogate in range(importance.n_surrogates):
        harmless = harmless and importance.harmless[surrogate, i, j, k]
    return harmless


@compiled_inline
def propose_acceleration(state: State, p: FloatArray, importance: Importance, q: FloatArray, v: FloatArray) -> bool:
    """Probabilities of the 31 accelerations under every surrogate's importance function.

    ``p`` (31,) is the exposure; ``q`` (J, 31) and ``v`` (J,) receive the results. Returns whether the moment is
    critical.
    """
    where = locate(AFTER, state.v_bv_mps, state.r2_m, state.r2dot_mps)
    critical = False
    for j in range(importance.n_surrogates):
        if importance.harmless[j, where[0], where[2], where[4]]:
            v[j] = 0.0
            for m in range(N_ACCELERATIONS):
                q[j, m] = p[m]
            continue
        interpolate_maneuvers(importance.maneuvers[j], where, q[j])
        for m in range(N_ACCELERATIONS):
            q[j, m] = p[m] * as_challenge(q[j, m], importance.recursive)
        total = 0.0
        for m in range(N_ACCELERATIONS):
            total += q[j, m]
        v[j] = total
        critical = critical or total > importance.threshold
        for m in range(N_ACCELERATIONS):
            q[j, m] = (
                importance.epsilon * p[m] + (1.0 - importance.epsilon) * (q[j, m] / total) if total > 0.0 else p[m]
            )
    return critical


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
