"""Importance functions q_j at a critical moment, before and after the cut-in.

    q_j(a|s) = ε p(a|s) + (1 − ε) p(a|s) C_j(s, a)/V_j(s),   V_j(s) = Σ_a p(a|s) C_j(s, a);   q_j = p where V_j = 0.

A moment is critical if any V_j exceeds the threshold. Before the cut-in the maneuvers are {stay, cut_in}; after it, at
redraw times, the 31 accelerations.

What a test that is sampled with them is worth: `harness.families.cut_in.nade.likelihood_ratio`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.campaign.campaign import Campaign
from harness.compiled import compiled_inline
from harness.families.cut_in.laws import Environment, acceptance
from harness.families.cut_in.nade.challenge import level_of, level_steps
from harness.families.cut_in.nade.grid import AFTER, BEFORE, interpolate, interpolate_maneuvers, locate
from harness.families.cut_in.nade.tables import Tables
from harness.families.cut_in.vocabulary import N_ACCELERATIONS, State
from harness.vehicles.kinematics import CONTACT_M, STEP_S, next_speed
from harness.vocabulary import BoolArray, Float32Array, FloatArray, read_only


class Importance(NamedTuple):
    """All that kernels need to sample critical moments.

    Flags are 0 or 1. ``recursive`` says which challenge is used, ``mixes_episodes`` whether one importance function is
    drawn per episode (else all are mixed in every critical step). ``n_surrogates`` is 0 without importance functions of
    surrogates; ``n_forced`` is 1 where importance function 0 is the forced cut-in, and those of surrogates come after
    it. ``steps_per_level`` lie between two levels of ``value``.
    ``alpha`` (M,) are the mixture weights. ``value`` (J, levels + 1, v, R2, R2dot), ``maneuvers`` (J, v, R2, R2dot, 31)
    and ``before`` (J, redraw times + 1, v, R2, R2dot) are the challenge tables (see `tables`).
    ``harmless`` (J, levels + 1, v - 1, R2 - 1, R2dot - 1) marks the grid cells after the cut-in in which no
    acceleration challenges a surrogate within a remaining time: most of what is driven lies there, and nothing needs
    to be interpolated.
    """

    recursive: int
    mixes_episodes: int
    n_surrogates: int
    n_forced: int
    steps_per_level: int
    epsilon: float
    threshold: float
    alpha: FloatArray
    value: Float32Array
    maneuvers: Float32Array
    before: Float32Array
    harmless: BoolArray


_ROUNDING_M = 1e-9
"""More than interpolation between gaps of up to a kilometre can lose."""


def build_importance(campaign: Campaign, tables: Tables | None) -> Importance:
    """Importance functions of a campaign; ``nde`` and ``forced`` need no challenge tables."""
    testing, sampling = campaign.testing, campaign.sampling
    recursive = testing.challenge != "immediate"  # one of the user's own is a probability, too
    # Read-only like tables that are mapped, for kernels to be compiled once.
    no_table = read_only(np.zeros((0, 1, 1, 1, 1), np.float32))
    none = no_table, no_table, no_table, no_table.astype(np.bool_)
    return Importance(
        int(recursive),
        int(sampling.mixes_episodes),
        len(campaign.surrogates) if sampling.mixes else 0,
        int(sampling.forces),
        level_steps(round(campaign.environment.acceleration_hold_s * 10)),
        testing.epsilon,
        testing.criticality_threshold,
        np.array(campaign.mixture_weights, dtype=np.float64),
        *(none if tables is None else (*tables[:3], harmless_cells(tables, recursive=recursive))),
    )


def harmless_cells(tables: Tables, *, recursive: bool) -> BoolArray:
    """Grid cells in which every acceleration has challenge 0, wherever in the cell it is interpolated.

    By remaining time, (J, levels + 1, v - 1, R2 - 1, R2dot - 1); with the longest that of the maneuvers' own table.
    """
    safe_m = CONTACT_M + _ROUNDING_M
    cells: BoolArray = tables.value == 0.0 if recursive else tables.least > safe_m
    cells[:, -1] = tables.maneuvers.max(-1) == 0.0 if recursive else tables.maneuvers.min(-1) > safe_m
    for axis in (2, 3, 4):
        n = cells.shape[axis]
        cells = cells.take(range(n - 1), axis) & cells.take(range(1, n), axis)
    return cells


@compiled_inline
def as_challenge(tabulated: float, recursive: int) -> float:
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
            this_step = stay_challenge[i, j]
            stay_challenge[i, j] = later
            later += this_step


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
def challenges_nobody(state: State, level: int, importance: Importance) -> bool:
    """Whether a state after the cut-in is known to be uncritical without evaluating any acceleration.

    ``level`` is the `remaining_level` of the test.
    """
    i, _, j, _, k, _ = locate(AFTER, state.v_bv_mps, state.r2_m, state.r2dot_mps)
    harmless = True
    for surrogate in range(importance.n_surrogates):
        harmless = harmless and importance.harmless[surrogate, level, i, j, k]
    return harmless


@compiled_inline
def propose_acceleration(
    state: State, level: int, p: FloatArray, importance: Importance, q: FloatArray, v: FloatArray
) -> bool:
    """Probabilities of the 31 accelerations under every surrogate's importance function.

    ``level`` is the `remaining_level` of the test, ``p`` (31,) the exposure; ``q`` (J, 31) and ``v`` (J,) receive the
    results. Returns whether the moment is critical.
    """
    where = locate(AFTER, state.v_bv_mps, state.r2_m, state.r2dot_mps)
    critical = False
    for j in range(importance.n_surrogates):
        if importance.harmless[j, level, where[0], where[2], where[4]]:
            v[j] = 0.0
            for m in range(N_ACCELERATIONS):
                q[j, m] = p[m]
            continue
        interpolate_maneuvers(importance.maneuvers[j], where, q[j])
        total = 0.0
        for m in range(N_ACCELERATIONS):
            q[j, m] = p[m] * as_challenge(q[j, m], importance.recursive)
            total += q[j, m]
        v[j] = total
        critical = critical or total > importance.threshold
        for m in range(N_ACCELERATIONS):
            q[j, m] = (
                importance.epsilon * p[m] + (1.0 - importance.epsilon) * (q[j, m] / total) if total > 0.0 else p[m]
            )
    return critical
