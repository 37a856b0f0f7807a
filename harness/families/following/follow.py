"""Drivers behind the vehicle ahead: how each comes to the event, and which of them crash."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.compiled import compiled_inline, compiled_threads
from harness.families.following.approach import (
    AV_START_M,
    LEAD,
    REVEALED,
    FollowingTraffic,
    Motion,
    happen,
    in_scope,
    walk,
)
from harness.families.protocol import Events
from harness.families.script import NEVER
from harness.vehicles.drivers import Followers
from harness.vehicles.following import Ahead, braking_seen_after, follow_on, headway_of, seen_after
from harness.vehicles.kinematics import CONTACT_M, STEP_S, gap, next_position, next_speed
from harness.vehicles.references import Memory
from harness.vocabulary import FloatArray, Int8Array, IntArray, Record, RecordArray

GOES_ON, NO_CRASH = -2, -1
"""Of a driver: on its way; or at the end of a test without a crash."""
DRIVING_DTYPE = np.dtype(
    [
        *((name, np.float64) for name in ("x_m", "speed_mps", "acceleration_mps2", "danger", "headway_s")),
        *((name, np.int64) for name in ("perceived", "reacts", "end")),
    ]
)
"""A driver in a test: where and how fast, what it remembers, from which steps on it sees and reacts; and ``end``, the
step after which it has run into a vehicle ahead, `NO_CRASH` or `GOES_ON`."""
STATE = 3
"""Of a driver at the onset: position (m), speed (m/s), acceleration (m/s²)."""


class Tests(NamedTuple):
    """Tests (n,): how they begin, what the vehicle ahead draws in each second (n, seconds), and what it then does."""

    start: RecordArray
    accelerations: Int8Array
    event: RecordArray


@compiled_inline
def behind(motion: Motion, vehicle: int, step: int, x: float) -> Ahead:
    """A vehicle ahead of a driver at a position (m)."""
    before = motion.v[max(step - 1, 0), vehicle]
    v = motion.v[step, vehicle]
    return Ahead(v, gap(motion.x[step, vehicle], x), (v - before) / STEP_S)


@compiled_inline
def set_out(
    driver: Record,
    natural_s: float,
    event: Record,
    clear: int,
    x: float,
    v: float,
    a: float,
    traffic: FollowingTraffic,
    motion: Motion,
    at: Record,
) -> None:
    """A driver at a position (m), speed (m/s) and acceleration (m/s²), who is to meet an event."""
    n = traffic.numbers
    at.x_m, at.speed_mps, at.acceleration_mps2, at.danger, at.end = x, v, a, math.inf, GOES_ON
    at.headway_s = headway_of(driver, natural_s, motion.v[0, LEAD])
    at.perceived = n.onset + braking_seen_after(driver)
    if clear < NEVER:  # nobody sees through the one that leaves
        least_m = max(driver.perceives_lateral_m, n.visible_from_m)
        at.perceived = n.onset + seen_after(least_m, event.lateral_mps, clear - n.onset)
    at.reacts = at.perceived + int(driver.delay_steps)


@compiled_inline
def drive_step(driver: Record, step: int, clear: int, onset: int, motion: Motion, at: Record) -> None:
    """Drive on by a step. Where both stand after the onset the test is over."""
    reveals, x, v = clear < NEVER, at.x_m, at.speed_mps
    nobody = Ahead(v, math.inf, 0.0)
    lead = behind(motion, LEAD, step, x) if step < clear else nobody
    slow = behind(motion, REVEALED, step, x) if reveals and step >= at.perceived else nobody
    memory, late = Memory(at.acceleration_mps2, at.danger, 0.0), onset < step < at.reacts
    memory = follow_on(driver, at.headway_s, memory, step - at.reacts, late, v, lead, slow)
    v_after = next_speed(v, memory.acceleration)
    x_after = next_position(x, v, v_after)
    at.x_m, at.speed_mps, at.acceleration_mps2, at.danger = x_after, v_after, memory.acceleration, memory.danger
    ahead = LEAD if step + 1 < clear else REVEALED
    if (step < clear and gap(motion.x[step + 1, LEAD], x_after) < CONTACT_M) or (
        reveals and step >= onset and gap(motion.x[step + 1, REVEALED], x_after) < CONTACT_M
    ):
        at.end = step + 1
    elif step >= onset and v_after == 0.0 and motion.v[step + 1, ahead] == 0.0:
        at.end = NO_CRASH


@compiled_inline
def drive_on(
    drivers: RecordArray, first: int, until: int, clear: int, onset: int, motion: Motion, at: RecordArray
) -> None:
    """Drive those who go on from a step to another, side by side: none waits for the arithmetic of another."""
    for step in range(first, until):
        on = 0
        for d in range(drivers.size):
            if at[d].end == GOES_ON:
                drive_step(drivers[d], step, clear, onset, motion, at[d])
                on += 1
        if on == 0:
            return


@compiled_inline
def hits_hard_enough(at: Record, clear: int, above_mps: float, motion: Motion) -> bool:
    """Whether a driver has crashed, with an impact (m/s) that counts."""
    end = at.end
    if end < 0:
        return False
    ahead = LEAD if end - 1 < clear and gap(motion.x[end, LEAD], at.x_m) < CONTACT_M else REVEALED
    return bool(above_mps == 0.0 or at.speed_mps - motion.v[end, ahead] > above_mps)


@compiled_threads
def enumerate_events(
    start: RecordArray,
    accelerations: Int8Array,
    stride: int,
    offset: IntArray,
    traffic: FollowingTraffic,
    followers: Followers,
    motion: Motion,
    at: RecordArray,
    at_onset: FloatArray,
    found: Events,
) -> None:
    """Every ``stride``-th event of paths (n,), and who crashes; see `harness.families.protocol.Family.events`.

    ``motion``, ``at`` (D,), `DRIVING_DTYPE`, and ``at_onset`` (D, 3) are room to work in.
    """
    n, drivers, above = traffic.numbers, followers.drivers, followers.counts_above_mps
    for i in range(start.size):
        early, natural_s, nothing, v = 0, start[i].natural_headway_s, traffic.grid[0], start[i].speed_mps
        walk(v, accelerations[i], n, motion)
        for d in range(drivers.size):
            set_out(drivers[d], natural_s, nothing, NEVER, AV_START_M, v, 0.0, traffic, motion, at[d])
        drive_on(drivers, 0, n.onset, NEVER, n.onset, motion, at)
        for d in range(drivers.size):
            at_onset[d, 0], at_onset[d, 1], at_onset[d, 2] = at[d].x_m, at[d].speed_mps, at[d].acceleration_mps2
            if hits_hard_enough(at[d], NEVER, above, motion):
                early |= 1 << d
        total = 0.0
        for e in range(traffic.grid.size):
            event = traffic.grid[e]
            if not in_scope(event, motion.v[n.onset, LEAD], n):
                continue
            total += traffic.share[e]
            if e % stride != offset[i]:
                continue
            found.probability[i, e] = stride * traffic.share[e]
            if drivers.size == 0:
                continue
            found.crashes[i, e] = early
            clear = happen(event, n.max_steps, n, motion)
            for d in range(drivers.size):
                x, v, a = at_onset[d, 0], at_onset[d, 1], at_onset[d, 2]
                set_out(drivers[d], natural_s, event, clear, x, v, a, traffic, motion, at[d])
                if early >> d & 1:
                    at[d].end = NO_CRASH
            drive_on(drivers, n.onset, n.max_steps, clear, n.onset, motion, at)
            for d in range(drivers.size):
                if hits_hard_enough(at[d], clear, above, motion):
                    found.crashes[i, e] |= 1 << d
        found.log_any[i] = math.log(min(total, 1.0)) if total > 0.0 else -math.inf


@compiled_threads
def move_others(
    tests: Tests, traffic: FollowingTraffic, motion: Motion, x: FloatArray, speed: FloatArray, clear: IntArray
) -> None:
    """The others' motion in tests (n,): first positions (n, O), speeds (n, steps, O), steps from which they are clear.

    ``x`` and ``speed`` have as many vehicles as the family; ``motion`` is room to work in.
    """
    most = traffic.numbers.max_steps
    for i in range(clear.size):
        walk(tests.start[i].speed_mps, tests.accelerations[i], traffic.numbers, motion)
        clear[i] = happen(tests.event[i], most, traffic.numbers, motion)
        for other in range(x.shape[1]):
            x[i, other] = motion.x[0, other]
            for step in range(most):
                speed[i, step, other] = motion.v[step + 1, other]


@compiled_threads
def drive_others(
    tests: Tests,
    traffic: FollowingTraffic,
    drivers: RecordArray,
    motion: Motion,
    at: RecordArray,
    tracks: FloatArray,
    end: IntArray,
) -> None:
    """Drive others in the AV's place in tests (n,); ``tracks`` (D, steps + 1, 2) holds the last of them afterwards.

    ``end`` (n, D) receives `NO_CRASH`, or the step after which each has crashed. ``motion`` and ``at`` (D,) are room to
    work in.
    """
    n = traffic.numbers
    for i in range(len(end)):
        event, natural_s, v = tests.event[i], tests.start[i].natural_headway_s, tests.start[i].speed_mps
        walk(v, tests.accelerations[i], n, motion)
        clear = happen(event, n.max_steps, n, motion)
        for d in range(drivers.size):
            tracks[d] = 0.0
            tracks[d, 0, 0], tracks[d, 0, 1] = AV_START_M, v
            set_out(drivers[d], natural_s, event, clear, AV_START_M, v, 0.0, traffic, motion, at[d])
            for step in range(n.max_steps):
                if at[d].end == GOES_ON:
                    drive_step(drivers[d], step, clear, n.onset, motion, at[d])
                    tracks[d, step + 1, 0], tracks[d, step + 1, 1] = at[d].x_m, at[d].speed_mps
            end[i, d] = max(at[d].end, NO_CRASH)
