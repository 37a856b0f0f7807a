"""Prescribed motion where the AV follows: of the vehicle ahead before and after the onset, and of one it reveals."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import special

from harness import elementary
from harness.compiled import compiled_inline, compiled_threads
from harness.families.flow import Flow
from harness.families.script import NEVER
from harness.random_stream import LV_DRAWS, uniform
from harness.vehicles.following import seen_after
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M, next_position, next_speed
from harness.vocabulary import FloatArray, Int8Array, IntArray, Record, RecordArray

AV_START_M = 100.0
HOLD_STEPS = 10
"""Steps for which the vehicle ahead keeps a drawn acceleration."""
LEAD, REVEALED = 0, 1
PARKED_M = 3900.0
"""Where a vehicle stands that nothing reveals."""
_GRID_MPS2 = 0.2
START_DTYPE = np.dtype([("speed_mps", np.float64), ("natural_headway_s", np.float64)])


class FollowingTraffic(NamedTuple):
    """What kernels need of such a traffic.

    ``numbers`` is a record: steps, and parameters by their flat names. ``grid``, ``share`` (E,) are the events and
    their probabilities.
    """

    numbers: Record
    grid: RecordArray
    share: FloatArray


class Motion(NamedTuple):
    """The vehicle ahead, and the one that it reveals: positions (m) and speeds (m/s), (steps + 1, 2) each."""

    x: FloatArray
    v: FloatArray


def empty_motion(traffic: FollowingTraffic) -> Motion:
    """Room for one test."""
    return Motion(*np.zeros((2, int(traffic.numbers["max_steps"]) + 1, 2)))


def starts_from(numbers: Record, u: FloatArray) -> RecordArray:
    """How paths begin (n,), `START_DTYPE`, from uniforms (n, 2)."""
    flow = Flow(numbers)
    start: RecordArray = np.zeros(len(u), START_DTYPE)
    start["speed_mps"] = flow.speeds(u[:, 0])
    start["natural_headway_s"] = flow.gaps(u[:, 1], start["speed_mps"]) / start["speed_mps"]
    return start


def drawn_accelerations(numbers: Record, seed: int, number: IntArray, speed_mps: FloatArray) -> Int8Array:
    """Accelerations of the vehicle ahead in each second of the approaches (n, seconds), in units of 0.2 m/s²."""
    u = np.zeros((number.size, -(-int(numbers["onset"]) // HOLD_STEPS)))
    _fill(seed, number, u)
    t, v = special.stdtrit(float(numbers["free_driving__df"]), u), speed_mps.copy()
    drawn = np.zeros(u.shape, np.int8)
    for second in range(u.shape[1]):
        ahead = np.clip(v, numbers["fit_range__v_min_mps"], numbers["fit_range__v_max_mps"])
        w = (ahead - numbers["fit_range__v_centre_mps"]) / numbers["fit_range__v_scale_mps"]
        log_scale = numbers["free_driving__log_scale"] + numbers["free_driving__log_scale_u"] * w
        scale = elementary.exp(log_scale + numbers["free_driving__log_scale_uu"] * (w * w))
        unlimited = numbers["free_driving__location_mps2"] + scale * t[:, second]
        a = np.clip(unlimited, numbers["free_driving__lowest_mps2"], numbers["free_driving__highest_mps2"])
        drawn[:, second] = np.rint(a / _GRID_MPS2)
        for _ in range(HOLD_STEPS):
            v = np.maximum(v + drawn[:, second] * _GRID_MPS2 * STEP_S, 0.0)
    return drawn


@compiled_threads
def _fill(seed: int, number: IntArray, u: FloatArray) -> None:
    for i in range(u.shape[0]):
        for second in range(u.shape[1]):
            u[i, second] = uniform(seed, number[i], LV_DRAWS, second)


@compiled_inline
def walk(speed_mps: float, accelerations: Int8Array, numbers: Record, motion: Motion) -> None:
    """The vehicle ahead from the start to the onset."""
    x, v = motion.x, motion.v
    v[0, LEAD] = speed_mps
    x[0, LEAD] = AV_START_M + VEHICLE_LENGTH_M + numbers.approach__headway_s * speed_mps
    for step in range(numbers.onset):
        v[step + 1, LEAD] = next_speed(v[step, LEAD], accelerations[step // HOLD_STEPS] * _GRID_MPS2)
        x[step + 1, LEAD] = next_position(x[step, LEAD], v[step, LEAD], v[step + 1, LEAD])


@compiled_inline
def happen(event: Record, until: int, numbers: Record, motion: Motion) -> int:
    """Move the others from the onset ``until`` a step; returns the step from which on the one ahead is off the lane."""
    x, v, onset = motion.x, motion.v, numbers.onset
    n_held, a, releases = 0, 0.0, False
    for step in range(onset, until):
        if releases:
            a = min(0.0, a + event.jerk_mps3 * STEP_S)
        else:
            a = max(-event.peak_mps2, a - event.jerk_mps3 * STEP_S) if event.peak_mps2 > 0.0 else 0.0
            n_held += a == -event.peak_mps2
            releases = n_held >= max(event.held_s / STEP_S - 0.5, 1.0)
        v[step + 1, LEAD] = next_speed(v[step, LEAD], a)
        x[step + 1, LEAD] = next_position(x[step, LEAD], v[step, LEAD], v[step + 1, LEAD])
    if math.isnan(event.ratio):
        x[:, REVEALED], v[:, REVEALED] = PARKED_M, 0.0
        return NEVER
    steps = seen_after(numbers.clear_m, event.lateral_mps, NEVER)
    slow, leaves = event.ratio * v[onset, LEAD], v[onset, LEAD] * (steps * STEP_S)
    rear = x[onset, LEAD] + leaves + event.ttc_s * (v[onset, LEAD] - slow) - slow * (steps * STEP_S)
    x[0, REVEALED] = rear + VEHICLE_LENGTH_M - slow * (onset * STEP_S)
    for step in range(until):
        v[step, REVEALED] = v[step + 1, REVEALED] = slow
        x[step + 1, REVEALED] = next_position(x[step, REVEALED], slow, slow)
    return int(onset + steps)


@compiled_inline
def in_scope(event: Record, speed_mps: float, numbers: Record) -> bool:
    """Whether a follower at the scope's headway has to brake harder than a limit: a milder event endangers nobody.

    For tests of milder events alone there is an upper limit, too.
    """
    if math.isnan(event.ratio):
        return True
    closing = (1.0 - event.ratio) * speed_mps
    room = event.ttc_s * closing + numbers.scope_headway_s * speed_mps
    closing_squared = closing * closing
    return bool(2.0 * numbers.scope_mps2 * room <= closing_squared < 2.0 * numbers.below_mps2 * room)
