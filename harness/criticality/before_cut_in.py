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

from harness.arrays import Float32Array, FloatArray, RecordArray
from harness.compiled import compiled_inline, compiled_threads
from harness.criticality.grid import (
    BEFORE_R2,
    BEFORE_RATE,
    BEFORE_V,
    interpolate,
    locate_after,
    locate_before,
    quadratic_points,
    uniform_points,
)
from harness.environment.cut_in import acceptance
from harness.environment.driving import Environment, car_following_pmf
from harness.environment.initial_state import InitialStates
from harness.maneuvers import N_ACCELERATIONS, acceleration
from harness.vehicles.kinematics import STEP_S, next_speed

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
        total += STEP_S * accepted * interpolate(value[level], locate_after(speed, r2, speed - follower))
    if r2 > 0.0:
        total += interpolate(later, locate_before(speed, r2, speed - follower))
    return total


@compiled_threads
def backward_period(
    step: int,
    steps_per_level: int,
    environment: Environment,
    value: Float32Array,
    pmf: FloatArray,
    speeds: FloatArray,
    gaps: FloatArray,
    rates: FloatArray,
    later: Float32Array,
    out: Float32Array,
) -> None:
    """``out`` = G at ``step`` from ``later`` = G one hold period later; both (v, R2, R2dot)."""
    for i in range(speeds.size):
        for j in range(1, gaps.size):
            for k in range(rates.size):
                total = 0.0
                for m in range(N_ACCELERATIONS):
                    if pmf[i, m] > _NEGLIGIBLE:
                        total += pmf[i, m] * period_value(
                            speeds[i],
                            gaps[j],
                            rates[k],
                            acceleration(m),
                            step,
                            steps_per_level,
                            environment,
                            value,
                            later,
                        )
                out[i, j, k] = total


@compiled_threads
def mean_car_following_pmf(states: RecordArray, environment: Environment, out: FloatArray) -> None:
    """Car-following probabilities averaged over states (n,), written to ``out`` (31,)."""
    one = np.empty(N_ACCELERATIONS)
    out[:] = 0.0
    for i in range(states.shape[0]):
        car_following_pmf(states[i], environment, one)
        for k in range(N_ACCELERATIONS):
            out[k] += one[k] / states.shape[0]


def naturalistic_pmf(environment: Environment) -> FloatArray:
    """BV's accelerations at the grid speeds, averaged over (R1, R1dot): shape (v, 31)."""
    speeds = uniform_points(BEFORE_V)
    side = (np.arange(24) + 0.5) / 24
    gap_u, rate_u = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    sampler = InitialStates(environment.numbers)
    out = np.empty((speeds.size, N_ACCELERATIONS))
    for i, speed in enumerate(speeds):
        states = sampler.given_speed(float(speed), gap_u, rate_u)
        mean_car_following_pmf(states, environment, out[i])
    return out


def build_before_cut_in(
    environment: Environment, value: Float32Array, pmf: FloatArray, steps_per_level: int
) -> Float32Array:
    """G of one surrogate at every redraw time.

    Parameters
    ----------
    environment : Environment
    value : ndarray of float32, shape (levels + 1, v, R2, R2dot)
        The surrogate's U after the cut-in.
    pmf : ndarray, shape (v, 31)
        From `naturalistic_pmf`.
    steps_per_level : int
        Steps between two levels of ``value``.

    Returns
    -------
    ndarray of float32, shape (redraw times + 1, v, R2, R2dot)
        Challenge per unit of OL (dimensionless); zero at R2 = 0 and at the end of the episode.
    """
    speeds, gaps, rates = uniform_points(BEFORE_V), quadratic_points(BEFORE_R2), uniform_points(BEFORE_RATE)
    hold, steps = int(environment.numbers["hold_steps"]), int(environment.numbers["max_steps"])
    periods = -(-steps // hold)
    table = np.zeros((periods + 1, speeds.size, gaps.size, rates.size), np.float32)
    for period in range(periods - 1, -1, -1):
        backward_period(
            period * hold,
            steps_per_level,
            environment,
            value,
            pmf,
            speeds,
            gaps,
            rates,
            table[period + 1],
            table[period],
        )
    return table
