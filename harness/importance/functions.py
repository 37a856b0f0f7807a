"""Importance functions q_j at a critical moment, before and after the cut-in.

    q_j(a|s) = ε p(a|s) + (1 − ε) p(a|s) C_j(s, a)/V_j(s),   V_j(s) = Σ_a p(a|s) C_j(s, a);   q_j = p where V_j = 0.

A moment is critical if any V_j exceeds the threshold. Before the cut-in the maneuvers are {stay, cut_in}; after it, at
redraw times, the 31 accelerations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from harness.compiled import compiled_inline
from harness.importance.before_cut_in import level_of
from harness.importance.grid import AFTER, BEFORE, interpolate, interpolate_maneuvers, locate
from harness.maneuvers import N_ACCELERATIONS
from harness.traffic.cut_in import acceptance
from harness.traffic.driving import Environment
from harness.vehicles.kinematics import CONTACT_M, STEP_S, next_speed
from harness.vocabulary import BoolArray, Float32Array, FloatArray, State


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
