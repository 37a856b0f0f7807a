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
"""``end`` of a driver: on its way; or at the end of a test without a crash."""
DRIVING_DTYPE = np.dtype(
    [
        *((name, np.float64) for name in ("x_m", "speed_mps", "acceleration_mps2", "danger", "headway_s")),
        *((name, np.int64) for name in ("perceived", "reacts", "end")),
    ]
)
"""A driver in a test: its motion, what it remembers, the steps from which on it sees the event and reacts; and ``end``,
the step after which it has run into a vehicle ahead, `NO_CRASH` or `GOES_ON`."""
STATE = 3
"""Numbers of a driver's state at the onset: position (m), speed (m/s), acceleration (m/s²)."""


class Tests(NamedTuple):
    """Tests (n,): how they begin, accelerations of the vehicle ahead by seconds (n, seconds), and events."""

    start: RecordArray
    accelerations: Int8Array
    event: RecordArray


@compiled_inline
def behind(motion: Motion, vehicle: int, step: int, x: float) -> Ahead:
    """A vehicle, as a driver behind it at a position (m) sees it."""
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
    now: Record,
) -> None:
    """Set up a driver who is to meet an event, at a position (m), speed (m/s) and acceleration (m/s²)."""
    n = traffic.numbers
    now.x_m, now.speed_mps, now.acceleration_mps2, now.danger, now.end = x, v, a, math.inf, GOES_ON
    now.headway_s = headway_of(driver, natural_s, motion.v[0, LEAD])
    now.perceived = n.onset + braking_seen_after(driver)
    if clear < NEVER:  # nobody sees through the one that leaves
        least_m = max(driver.perceives_lateral_m, n.visible_from_m)
        now.perceived = n.onset + seen_after(least_m, event.lateral_mps, clear - n.onset)
    now.reacts = now.perceived + int(driver.delay_steps)


@compiled_inline
def drive_step(driver: Record, step: int, clear: int, onset: int, motion: Motion, now: Record) -> None:
    """Drive on by a step. Where both stand after the onset the test is over."""
    x, v = now.x_m, now.speed_mps
    reveals = clear < NEVER
    nobody = Ahead(v, math.inf, 0.0)
    lead = behind(motion, LEAD, step, x) if step < clear else nobody
    slow = behind(motion, REVEALED, step, x) if reveals and step >= now.perceived else nobody
    memory = Memory(now.acceleration_mps2, now.danger, 0.0)
    late = onset < step < now.reacts
    memory = follow_on(driver, now.headway_s, memory, step - now.reacts, late, v, lead, slow)
    v_after = next_speed(v, memory.acceleration)
    x_after = next_position(x, v, v_after)
    now.x_m, now.speed_mps, now.acceleration_mps2, now.danger = x_after, v_after, memory.acceleration, memory.danger
    ahead = LEAD if step + 1 < clear else REVEALED
    if (step < clear and gap(motion.x[step + 1, LEAD], x_after) < CONTACT_M) or (
        reveals and step >= onset and gap(motion.x[step + 1, REVEALED], x_after) < CONTACT_M
    ):
        now.end = step + 1
    elif step >= onset and v_after == 0.0 and motion.v[step + 1, ahead] == 0.0:
        now.end = NO_CRASH


@compiled_inline
def drive_on(
    drivers: RecordArray, first: int, until: int, clear: int, onset: int, motion: Motion, now: RecordArray
) -> None:
    """Drive those who go on from a step ``until`` another, side by side: none waits for the arithmetic of another."""
    for step in range(first, until):
        n_driving = 0
        for d in range(drivers.size):
            if now[d].end == GOES_ON:
                drive_step(drivers[d], step, clear, onset, motion, now[d])
                n_driving += 1
        if n_driving == 0:
            return


@compiled_inline
def hits_hard_enough(now: Record, clear: int, above_mps: float, motion: Motion) -> bool:
    """Whether a driver has crashed, with an impact (m/s) that counts."""
    end = now.end
    if end < 0:
        return False
    ahead = LEAD if end - 1 < clear and gap(motion.x[end, LEAD], now.x_m) < CONTACT_M else REVEALED
    return bool(above_mps == 0.0 or now.speed_mps - motion.v[end, ahead] > above_mps)


@compiled_threads
def enumerate_events(
    start: RecordArray,
    accelerations: Int8Array,
    stride: int,
    offset: IntArray,
    traffic: FollowingTraffic,
    followers: Followers,
    motion: Motion,
    now: RecordArray,
    at_onset: FloatArray,
    out: Events,
) -> None:
    """Every ``stride``-th event of paths (n,), and who crashes; see `harness.families.protocol.Family.events`.

    ``motion``, ``now`` (D,), `DRIVING_DTYPE`, and ``at_onset`` (D, 3) are room to work in.
    """
    n, drivers, above = traffic.numbers, followers.drivers, followers.counts_above_mps
    for i in range(start.size):
        natural_s, v = start[i].natural_headway_s, start[i].speed_mps
        any_event = traffic.grid[0]  # before the onset it does not matter which
        early = 0  # one bit for each driver who crashes before the onset
        walk(v, accelerations[i], n, motion)
        for d in range(drivers.size):
            set_out(drivers[d], natural_s, any_event, NEVER, AV_START_M, v, 0.0, traffic, motion, now[d])
        drive_on(drivers, 0, n.onset, NEVER, n.onset, motion, now)
        for d in range(drivers.size):
            at_onset[d, 0], at_onset[d, 1], at_onset[d, 2] = now[d].x_m, now[d].speed_mps, now[d].acceleration_mps2
            if hits_hard_enough(now[d], NEVER, above, motion):
                early |= 1 << d
        total = 0.0
        for e in range(traffic.grid.size):
            event = traffic.grid[e]
            if not in_scope(event, motion.v[n.onset, LEAD], n):
                continue
            total += traffic.share[e]
            if e % stride != offset[i]:
                continue
            out.probability[i, e] = stride * traffic.share[e]
            if drivers.size == 0:
                continue
            out.crashes[i, e] = early
            clear = happen(event, n.max_steps, n, motion)
            for d in range(drivers.size):
                x, v, a = at_onset[d, 0], at_onset[d, 1], at_onset[d, 2]
                set_out(drivers[d], natural_s, event, clear, x, v, a, traffic, motion, now[d])
                if early >> d & 1:
                    now[d].end = NO_CRASH
            drive_on(drivers, n.onset, n.max_steps, clear, n.onset, motion, now)
            for d in range(drivers.size):
                if hits_hard_enough(now[d], clear, above, motion):
                    out.crashes[i, e] |= 1 << d
        out.log_any[i] = math.log(min(total, 1.0)) if total > 0.0 else -math.inf


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
    now: RecordArray,
    tracks: FloatArray,
    end: IntArray,
) -> None:
    """Drive others in the AV's place in tests (n,); ``tracks`` (D, steps + 1, 2) holds the last of them afterwards.

    ``end`` (n, D) receives `NO_CRASH`, or the step after which each has crashed. ``motion`` and ``now`` (D,) are
    room to work in.
    """
    n = traffic.numbers
    for i in range(len(end)):
        event, natural_s, v = tests.event[i], tests.start[i].natural_headway_s, tests.start[i].speed_mps
        walk(v, tests.accelerations[i], n, motion)
        clear = happen(event, n.max_steps, n, motion)
        for d in range(drivers.size):
            tracks[d] = 0.0
            tracks[d, 0, 0], tracks[d, 0, 1] = AV_START_M, v
            set_out(drivers[d], natural_s, event, clear, AV_START_M, v, 0.0, traffic, motion, now[d])
            for step in range(n.max_steps):
                if now[d].end == GOES_ON:
                    drive_step(drivers[d], step, clear, n.onset, motion, now[d])
                    tracks[d, step + 1, 0], tracks[d, step + 1, 1] = now[d].x_m, now[d].speed_mps
            end[i, d] = max(now[d].end, NO_CRASH)
