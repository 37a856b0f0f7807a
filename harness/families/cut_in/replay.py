"""Stored episodes once more, without SUMO: other drivers in the AV's place, on the same cut-ins.

Initial state and maneuvers determine LV's and BV's motion to the last bit. It takes a few microseconds per episode,
where SUMO takes hundreds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from harness.compiled import compiled_inline, compiled_threads, unboxed
from harness.families.cut_in.events import Maneuvers
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.path import NO_CRASH, Trajectory, empty_trajectory, follow, leave, take_over, walk
from harness.families.cut_in.script import facts_of, maneuvers_of, states_of
from harness.families.cut_in.vocabulary import ACCELERATIONS_MPS2, CUT_IN, states_from
from harness.families.protocol import Chosen, Driven
from harness.vehicles.sideways import onset_of
from harness.vocabulary import AV, BoolArray, FloatArray, IntArray, RecordArray


class StoredPaths(NamedTuple):
    """Stored episodes of a campaign with seed ``seed``, ``episode`` (n,) being their indices.

    ``state`` (n,) are initial states; ``n_steps``, ``cut_step`` (n,) steps simulated and that of the cut-in, -1
    without one; ``script`` is what LV and BV did in them.
    """

    seed: int
    episode: IntArray
    state: RecordArray
    n_steps: IntArray
    cut_step: IntArray
    script: Maneuvers


@compiled_inline
def recall(i: int, stored: StoredPaths, path: Trajectory) -> int:
    """Put the stored maneuvers into the path; returns how many there are of both LV and BV."""
    script = stored.script
    known = min(script.n_lv[i], script.n_bv[i], path.lv.size)
    for m in range(known):
        path.lv[m], path.bv[m] = script.lv[i, m], script.bv[i, m]
    return int(known)


@compiled_inline
def leave_stored(i: int, until: int, stored: StoredPaths, environment: Environment, path: Trajectory) -> bool:
    """BV's motion from its cut-in to a step: as stored, then under p; False if no cut-in is stored where it was.

    The path up to the cut-in must have been walked.
    """
    cut, bv = stored.cut_step[i], stored.script.bv[i]
    mark = cut // environment.numbers.hold_steps + 1
    known = stored.script.n_bv[i] - mark - 1
    if known < 0 or bv[mark] != CUT_IN:
        return False
    for m in range(min(known, path.free.size)):
        path.free[m] = bv[mark + 1 + m]
    leave(cut, until, stored.seed, stored.episode[i], 0, known, environment, path)
    return True


@compiled_threads
def drive_others(
    tests: StoredPaths, start: FloatArray, environment: Environment, drivers: RecordArray, path: Trajectory, out: Driven
) -> None:
    """Drive others in the AV's place along stored episodes with a cut-in, from the end of the step of its onset.

    ``start`` (n, 2) is the AV's position (m) and speed (m/s) then, NaN where it has kept its speed until there.
    ``out.end`` receives the step after which each of ``drivers`` (D,) has run into BV, `NO_CRASH` or `WAS_AHEAD`, and
    ``out.motion`` its motion in the last of the episodes, unless that is of shape (0, 0, 0). ``path`` is room to work
    in, and holds BV's motion of the last episode, as if nobody had hit it.
    """
    most, motion = environment.numbers.max_steps, out.motion
    for i in range(tests.cut_step.size):
        cut, lead = tests.cut_step[i], tests.script.lead[i]
        known, after = recall(i, tests, path), onset_of(cut, lead) + 1
        walk(tests.state[i], tests.seed, tests.episode[i], known, cut + 1, False, environment, path)
        leave_stored(i, most, tests, environment, path)
        if not math.isnan(start[i, 0]):
            path.x[after, AV], path.v[after, AV] = start[i]
        if motion.size > 0:
            path.slowest[:] = -math.inf  # nobody is let off before the end because nothing can happen any more
        for d in range(drivers.size):
            late = drivers[d].delay_steps
            for until in range(after if motion.size > 0 else most, most + 1):
                take_over(0, d, drivers, late, False, cut, lead, environment, path)
                follow(1, drivers, cut, lead, until, path)
                if motion.size > 0:
                    motion[d, until, 0], motion[d, until, 1] = path.follower[0].x, path.follower[0].v
                out.end[i, d] = path.follower[0].end
                if out.end[i, d] != NO_CRASH:
                    break


def drive_along(
    traffic: Environment, chosen: Chosen, start: FloatArray, drivers: RecordArray, *, last: bool = False
) -> Driven:
    """See `harness.families.protocol.Family.drive`."""
    n, steps = len(chosen.facts), int(traffic.numbers["max_steps"])
    known = maneuvers_of(chosen)
    stored = StoredPaths(0, np.zeros(n, np.int64), states_of(chosen.facts), np.full(n, steps), chosen.at, known)
    motion, path = np.zeros((len(drivers), steps + 1, 2) if last else (0, 0, 0)), empty_trajectory(traffic)
    driven = Driven(np.zeros((n, len(drivers)), np.int64), motion, np.zeros((0, 0)))
    drive_others(unboxed(stored), start, unboxed(traffic), drivers, unboxed(path), unboxed(driven))
    return driven._replace(ahead=np.stack((path.x_after, path.v_after), axis=1))


def avoids(
    environment: Environment, facts: Mapping[str, FloatArray], where: FloatArray, drivers: RecordArray
) -> BoolArray:
    """See `harness.families.protocol.Family.avoidable`: of cut-ins of one step, where BV keeps its speed."""
    gap, closing = where
    n, draws = gap.size, int(environment.numbers["max_steps"] // environment.numbers["hold_steps"]) + 1
    v_bv = np.full(n, float(np.median(facts["v_bv_mps"])))
    state = states_from((v_bv, np.full(n, 200.0), np.zeros(n), gap, -closing))
    keeps_speed = int(np.argmin(np.abs(ACCELERATIONS_MPS2)))
    lv, bv = np.full((2, n, draws + 1), keeps_speed, np.int8)
    bv[:, 1] = CUT_IN
    used, at_once = np.full(n, draws), np.zeros(n, np.int64)
    chosen = Chosen(facts_of(state, Maneuvers(lv, bv, used, used + 1, at_once)), at_once, at_once)
    return drive_along(environment, chosen, np.full((n, 2), np.nan), drivers, last=False).end < 0
