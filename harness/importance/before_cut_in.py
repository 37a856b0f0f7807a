"""Recursive challenge before the cut-in: what *not* cutting in now is worth.

Before the cut-in the AV keeps its speed, so (v_BV, R2, R2dot) moves with BV's acceleration alone. BV's wish to change
lanes enters as the factor OL of the current state, held at its present value. What is tabulated by backward induction
over the hold periods is therefore the expected challenge met per unit of OL,

    G_t(s) = Σ_a p̄(a | v_BV) { Σ_i Δt accept(R2_i, R2dot_i) C(s_i, cut_in) + G_{t+h}(s'_a) },

with C(s_i, cut_in) = U(state after the cut-in step), and p̄ the car-following accelerations averaged over the
naturalistic (R1, R1dot). Within a hold period the future is known; only its end needs the table.
"""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled_inline, compiled_threads
from harness.importance.after_cut_in import level_steps
from harness.importance.grid import AFTER, BEFORE, GridPoints, interpolate, locate, points_of, shape_of, state_at
from harness.maneuvers import N_ACCELERATIONS, acceleration
from harness.traffic.cut_in import acceptance
from harness.traffic.driving import Environment, acceleration_pmf, car_following
from harness.traffic.initial_state import InitialStates
from harness.vehicles.kinematics import STEP_S, next_speed
from harness.vocabulary import Float32Array, FloatArray, RecordArray

_NEGLIGIBLE = 1e-7
"""Accelerations rarer than this are left out of the induction (the table steers, it never enters a weight)."""


@compiled_inline
def level_of(step: int, max_steps: int, steps_per_level: int, levels: int) -> int:
    """Level of U that a cut-in in ``step`` has left: the cut-in itself takes one step."""
    return min((max_steps - step - 1) // steps_per_level, levels)


@compiled_inline
def period_value(
    speed: float,
    r2: float,
    r2dot: float,
    bv_acceleration: float,
    step: int,
    steps_per_level: int,
    environment: Environment,
    value: Float32Array,
    later: Float32Array,
) -> float:
    """Expected challenge per unit of OL over one hold period and after it, with a known acceleration."""
    n = environment.numbers
    follower = speed - r2dot
    total = 0.0
    for i in range(n.hold_steps):
        if r2 <= 0.0:
            return total
        accepted = acceptance(r2, speed - follower, environment)
        after = next_speed(speed, bv_acceleration)
        r2 += (0.5 * (speed + after) - follower) * STEP_S
        speed = after
        level = level_of(step + i, n.max_steps, steps_per_level, value.shape[0] - 1)
        total += STEP_S * accepted * interpolate(value[level], locate(AFTER, speed, r2, speed - follower))
    if r2 > 0.0:
        total += interpolate(later, locate(BEFORE, speed, r2, speed - follower))
    return total


@compiled_threads
def backward_period(
    step: int,
    steps_per_level: int,
    environment: Environment,
    value: Float32Array,
    pmf: FloatArray,
    points: GridPoints,
    later: Float32Array,
    out: Float32Array,
) -> None:
    """``out`` = G at ``step`` from ``later`` = G one hold period later; both (v, R2, R2dot)."""
    for i, j, k in np.ndindex(out.shape):
        v, r2, r2dot = state_at(points, i, j, k)
        total = 0.0
        for m in range(N_ACCELERATIONS):
            if pmf[i, m] > _NEGLIGIBLE:
                a = acceleration(m)
                total += pmf[i, m] * period_value(v, r2, r2dot, a, step, steps_per_level, environment, value, later)
        out[i, j, k] = total


@compiled_threads
def mean_car_following_pmf(states: RecordArray, environment: Environment, out: FloatArray) -> None:
    """Car-following probabilities averaged over states (n,), written to ``out`` (31,)."""
    one = np.empty(N_ACCELERATIONS)
    out[:] = 0.0
    for i in range(states.shape[0]):
        acceleration_pmf(car_following(states[i], environment), environment, one)
        for k in range(N_ACCELERATIONS):
            out[k] += one[k] / states.shape[0]


def naturalistic_pmf(environment: Environment) -> FloatArray:
    """BV's accelerations at the grid speeds, averaged over (R1, R1dot): shape (v, 31)."""
    side = (np.arange(24) + 0.5) / 24
    gap_u, rate_u = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    sampler = InitialStates(environment.numbers)
    speeds = points_of(BEFORE).speed
    out = np.empty((speeds.size, N_ACCELERATIONS))
    for i, speed in enumerate(speeds.tolist()):
        mean_car_following_pmf(sampler.given_speed(speed, gap_u, rate_u), environment, out[i])
    return out


def build_before_cut_in(environment: Environment, value: Float32Array) -> Float32Array:
    """G of one surrogate at every redraw time, from its U after the cut-in: ``value`` (levels + 1, v, R2, R2dot).

    Its shape is (redraw times + 1, v, R2, R2dot); it is zero at R2 = 0 and at the end of the episode.
    """
    points, pmf = points_of(BEFORE), naturalistic_pmf(environment)
    hold, steps = int(environment.numbers["hold_steps"]), int(environment.numbers["max_steps"])
    periods = -(-steps // hold)
    table = np.zeros((periods + 1, *shape_of(BEFORE)), np.float32)
    for period in range(periods - 1, -1, -1):
        later, out = table[period + 1], table[period]
        backward_period(period * hold, level_steps(hold), environment, value, pmf, points, later, out)
    return table
