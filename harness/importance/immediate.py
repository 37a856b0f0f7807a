"""Immediate challenge, as published for NADE: whether the surrogate crashes if BV acts now and then keeps its speed.

The answer is yes or no, so what is tabulated is smooth: the smallest gap of the roll-out, which goes on below zero as
if the vehicles could overlap. Interpolated, it is negative where the surrogate crashes. Staying has challenge 0.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from harness.compiled import compiled_inline, compiled_threads
from harness.importance.after_cut_in import LEVELS, level_steps
from harness.importance.grid import AFTER, GridPoints, points_of, shape_of, state_at
from harness.maneuvers import N_ACCELERATIONS, acceleration
from harness.traffic.driving import Environment
from harness.vehicles.kinematics import STEP_S, next_speed
from harness.vehicles.models import FVDM_KIND, SMALLEST_GAP_M, driver_acceleration, fvdm_acceleration, fvdm_shape
from harness.vocabulary import Float32Array, FloatArray, Record, RecordArray

_KEEP_SPEED = 20
"""Maneuver index of 0 m/s²."""
_NO_CONTACT_M = 1e3
_ROUNDING_MPS2 = 1e-9


@compiled_inline
def brakes_fully(driver: Record, speed: float, lead_speed: float, shape: float) -> bool:
    """Whether FVDM's command is below its limit even for this bound on its `fvdm_shape`, rounding included."""
    if driver.kind != FVDM_KIND:
        return False
    most = fvdm_acceleration(driver, speed, lead_speed, shape)
    return bool(most < driver.min_acceleration_mps2 - _ROUNDING_MPS2)


@compiled_inline
def smallest_gaps(
    speed: float,
    r2: float,
    r2dot: float,
    maneuver: int,
    hold: int,
    steps_per_level: int,
    driver: Record,
    out: FloatArray,
) -> None:
    """Smallest gap (m) within every remaining time: ``out`` (levels + 1,), level 0 being none.

    BV takes a maneuver for one hold period and then keeps its speed.
    """
    follower = speed - r2dot
    smallest = _NO_CONTACT_M
    out[0] = smallest
    gap_of_shape, shape = math.inf, 1.0
    for step in range((out.size - 1) * steps_per_level):
        # tanh takes most of FVDM's time. While the gap shrinks, the last value computed is an upper bound.
        if r2 <= gap_of_shape and brakes_fully(driver, follower, speed, shape):
            a = driver.min_acceleration_mps2
        else:
            a = driver_acceleration(driver, follower, speed, r2)
            if driver.kind == FVDM_KIND:
                gap_of_shape, shape = r2, fvdm_shape(driver, max(r2, SMALLEST_GAP_M))
        speed_after = next_speed(speed, acceleration(maneuver) if step < hold else 0.0)
        follower_after = next_speed(follower, a)
        r2 += 0.5 * (speed + speed_after - follower - follower_after) * STEP_S
        speed, follower = speed_after, follower_after
        smallest = min(smallest, r2)
        if (step + 1) % steps_per_level == 0:
            out[(step + 1) // steps_per_level] = smallest


@compiled_threads
def roll_out(
    driver: RecordArray,
    hold: int,
    steps_per_level: int,
    points: GridPoints,
    value: Float32Array,
    maneuvers: Float32Array,
) -> None:
    """Fill ``value`` (levels + 1, v, R2, R2dot) and ``maneuvers`` (v, R2, R2dot, 31) with smallest gaps (m)."""
    by_level = np.empty(value.shape[0])
    for i, j, k, m in np.ndindex(maneuvers.shape):
        v, r2, r2dot = state_at(points, i, j, k)
        smallest_gaps(v, r2, r2dot, m, hold, steps_per_level, driver[0], by_level)
        maneuvers[i, j, k, m] = by_level[-1]
        if m == _KEEP_SPEED:
            value[:, i, j, k] = by_level


def build_immediate(environment: Environment, driver: RecordArray) -> tuple[Float32Array, Float32Array]:
    """Tables of one surrogate, in metres; the shapes are those of `build_after_cut_in`."""
    points, shape = points_of(AFTER), shape_of(AFTER)
    hold = int(environment.numbers["hold_steps"])
    value = np.empty((LEVELS + 1, *shape), np.float32)
    maneuvers = np.empty((*shape, N_ACCELERATIONS), np.float32)

    def at_speed(i: int) -> None:
        here = slice(i, i + 1)
        part = points._replace(speed=points.speed[here])
        roll_out(driver, hold, level_steps(hold), part, value[:, here], maneuvers[here])

    with ThreadPoolExecutor(os.cpu_count()) as threads:  # one surrogate may take as long as all others together
        list(threads.map(at_speed, range(points.speed.size)))
    return value, maneuvers
