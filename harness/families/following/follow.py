"""Drivers behind the vehicle ahead: how each comes to the event, and which of them crash."""

from __future__ import annotations

import math
from typing import NamedTuple

from harness.compiled import compiled_inline, compiled_threads
from harness.families.following.approach import AV_START_M, LEAD, REVEALED, Following, Motion, happen, in_scope, walk
from harness.families.protocol import Events
from harness.loop.cells import NEVER
from harness.vehicles.drivers import Followers
from harness.vehicles.following import Ahead, braking_seen_after, follow_on, headway_of, seen_after
from harness.vehicles.kinematics import CONTACT_M, STEP_S, gap, next_position, next_speed
from harness.vehicles.references import Memory
from harness.vocabulary import FloatArray, Int8Array, IntArray, Record, RecordArray

NO_CRASH = -1
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
def drive_on(
    driver: Record,
    natural_s: float,
    event: Record,
    clear: int,
    first: int,
    until: int,
    acceleration: float,
    numbers: Record,
    motion: Motion,
    track: FloatArray,
) -> tuple[int, float]:
    """Drive from a step to another; ``track`` (steps + 1, 2) receives positions (m) and speeds (m/s).

    Returns `NO_CRASH`, or the step after which the driver has run into a vehicle ahead, and its acceleration (m/s²). It
    is also `NO_CRASH` where both stand after the onset; then the test is over.
    """
    headway_s, memory = headway_of(driver, natural_s, motion.v[0, LEAD]), Memory(acceleration, math.inf, 0.0)
    onset, reveals = numbers.onset, clear < NEVER
    perceived = onset + braking_seen_after(driver)
    if reveals:  # nobody sees through the one that leaves
        least_m = max(driver.perceives_lateral_m, numbers.visible_from_m)
        perceived = onset + seen_after(least_m, event.lateral_mps, clear - onset)
    reacts = perceived + int(driver.delay_steps)
    for step in range(first, until):
        x, v = track[step, 0], track[step, 1]
        nobody = Ahead(v, math.inf, 0.0)
        lead = behind(motion, LEAD, step, x) if step < clear else nobody
        slow = behind(motion, REVEALED, step, x) if reveals and step >= perceived else nobody
        memory = follow_on(driver, headway_s, memory, step - reacts, onset < step < reacts, v, lead, slow)
        v_after = next_speed(v, memory.acceleration)
        x_after = next_position(x, v, v_after)
        track[step + 1, 0], track[step + 1, 1] = x_after, v_after
        if step < clear and gap(motion.x[step + 1, LEAD], x_after) < CONTACT_M:
            return step + 1, memory.acceleration
        if reveals and step >= onset and gap(motion.x[step + 1, REVEALED], x_after) < CONTACT_M:
            return step + 1, memory.acceleration
        ahead = LEAD if step + 1 < clear else REVEALED
        if step >= onset and v_after == 0.0 and motion.v[step + 1, ahead] == 0.0:
            return NO_CRASH, memory.acceleration
    return NO_CRASH, memory.acceleration


@compiled_inline
def hits_hard_enough(end: int, clear: int, above_mps: float, motion: Motion, track: FloatArray) -> bool:
    """Whether a driver that has crashed after a step did so with an impact (m/s) that counts."""
    ahead = LEAD if end - 1 < clear and gap(motion.x[end, LEAD], track[end, 0]) < CONTACT_M else REVEALED
    return bool(above_mps == 0.0 or track[end, 1] - motion.v[end, ahead] > above_mps)


@compiled_threads
def enumerate_events(
    start: RecordArray,
    accelerations: Int8Array,
    stride: int,
    offset: IntArray,
    traffic: Following,
    followers: Followers,
    motion: Motion,
    track: FloatArray,
    at_onset: FloatArray,
    found: Events,
) -> None:
    """Every ``stride``-th event of paths (n,), and who crashes; see `harness.families.protocol.Family.events`.

    ``motion``, ``track`` (steps + 1, 2) and ``at_onset`` (D, 3) are room to work in.
    """
    n, drivers, above = traffic.numbers, followers.drivers, followers.counts_above_mps
    for i in range(start.size):
        early, natural_s, nothing = 0, start[i].natural_headway_s, traffic.grid[0]
        walk(start[i].speed_mps, accelerations[i], n, motion)
        track[0, 0], track[0, 1] = AV_START_M, start[i].speed_mps
        for d in range(drivers.size):
            end, a = drive_on(drivers[d], natural_s, nothing, NEVER, 0, n.onset, 0.0, n, motion, track)
            at_onset[d, 0], at_onset[d, 1], at_onset[d, 2] = track[n.onset, 0], track[n.onset, 1], a
            if end != NO_CRASH and hits_hard_enough(end, NEVER, above, motion, track):
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
                if early >> d & 1:
                    continue
                track[n.onset, 0], track[n.onset, 1] = at_onset[d, 0], at_onset[d, 1]
                a, most = at_onset[d, 2], n.max_steps
                end, a = drive_on(drivers[d], natural_s, event, clear, n.onset, most, a, n, motion, track)
                if end != NO_CRASH and hits_hard_enough(end, clear, above, motion, track):
                    found.crashes[i, e] |= 1 << d
        found.log_any[i] = math.log(min(total, 1.0)) if total > 0.0 else -math.inf


@compiled_threads
def move_others(
    tests: Tests, traffic: Following, motion: Motion, x: FloatArray, speed: FloatArray, clear: IntArray
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
    tests: Tests, traffic: Following, drivers: RecordArray, motion: Motion, tracks: FloatArray, end: IntArray
) -> None:
    """Drive others in the AV's place in tests (n,); ``tracks`` (D, steps + 1, 2) holds the last of them afterwards.

    ``end`` (n, D) receives `NO_CRASH`, or the step after which each has crashed. ``motion`` is room to work in.
    """
    n = traffic.numbers
    for i in range(len(end)):
        event, natural_s = tests.event[i], tests.start[i].natural_headway_s
        walk(tests.start[i].speed_mps, tests.accelerations[i], n, motion)
        clear = happen(event, n.max_steps, n, motion)
        for d in range(drivers.size):
            tracks[d] = 0.0
            tracks[d, 0, 0], tracks[d, 0, 1] = AV_START_M, tests.start[i].speed_mps
            end[i, d], _ = drive_on(drivers[d], natural_s, event, clear, 0, n.max_steps, 0.0, n, motion, tracks[d])
