"""The cut-ins that could happen on a naturalistic path, their exact probabilities, and which drivers crash on them.

LV's and BV's motion before the cut-in does not depend on the AV; BV's motion after it is drawn from free driving, which
does not depend on the AV either. So a path is walked once, each of its cut-in times has a probability that is known
once the AV's motion is (it keeps its speed, or has been recorded), and each driver is only a follower behind a given
BV: about a microsecond.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.compiled import compiled_threads, unboxed
from harness.families.cut_in import laws
from harness.families.cut_in.lateral import draw_lead
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.path import Trajectory, empty_trajectory, leave, state_of, walk, weigh_cut_ins, who_crashes
from harness.families.cut_in.vocabulary import CUT_IN
from harness.families.protocol import HOLDING, Events, Paths, Recorded
from harness.random_stream import LV_DRAWS, uniform
from harness.vehicles.drivers import Followers
from harness.vehicles.kinematics import CONTACT_M, gap, next_speed
from harness.vocabulary import AV, LV, Int8Array, IntArray

FREE_DRAWS_PER_CUT_IN = 256
"""Uniforms for BV's free driving after one cut-in: in a pool each cut-in time of a path has draws of its own."""


class Maneuvers(NamedTuple):
    """Maneuvers of LV and BV on paths (n,).

    ``lv``, ``bv`` (n, draws) are maneuver indices, 31 marking the cut-in, of which ``n_lv``, ``n_bv`` (n,) are used.
    BV begins to move sideways ``lead`` (n,) steps before the cut-in.
    """

    lv: Int8Array
    bv: Int8Array
    n_lv: IntArray
    n_bv: IntArray
    lead: IntArray


def enumerate_cut_ins(
    traffic: Environment,
    seed: int,
    paths: Paths,
    drivers: Followers,
    recorded: Recorded = HOLDING,
    stride: int = 1,
    offset: IntArray | None = None,
) -> Events:
    """Every ``stride``-th cut-in of paths (n,), by their steps; see `harness.families.protocol.Family.events`."""
    n, steps = paths.number.size, int(traffic.numbers["max_steps"])
    events = Events(np.zeros((n, steps)), np.zeros((n, steps), np.int64), np.zeros(n), np.zeros(n))
    first = np.zeros(n, np.int64) if offset is None else offset
    given = unboxed(traffic), unboxed(drivers), unboxed(recorded)
    _enumerate(seed, unboxed(paths), stride, first, *given, unboxed(empty_trajectory(traffic)), unboxed(events))
    return events


@compiled_threads
def _enumerate(
    seed: int,
    paths: Paths,
    stride: int,
    offset: IntArray,
    environment: Environment,
    followers: Followers,
    recorded: Recorded,
    path: Trajectory,
    out: Events,
) -> None:
    max_steps = environment.numbers.max_steps
    for i in range(offset.size):
        number, keeps_speed = paths.number[i], recorded.n_steps.size == 0
        steps = reach = walk(paths.start[i], seed, number, max_steps, keeps_speed, environment, path)
        if not keeps_speed:
            steps = min(recorded.n_steps[i], reach)
            for step in range(steps + 1):
                path.x[step, AV], path.v[step, AV] = recorded.x_m[i, step], recorded.v_mps[i, step]
        weigh_cut_ins(steps, environment, path)
        hazard = 0.0
        for cut in range(steps):
            if path.hazard[cut] > 0.0 and cut % stride == offset[i]:
                out.probability[i, cut] = stride * (math.exp(-hazard) * -math.expm1(-path.hazard[cut]))
                if followers.drivers.size > 0:
                    leave(cut, max_steps, seed, number, cut * FREE_DRAWS_PER_CUT_IN, environment, path)
                    if gap(path.x[cut + 1, LV], path.x_after[cut + 1]) >= CONTACT_M:  # else it ends as bv_lv_contact
                        lead = draw_lead(cut, seed, number, environment.lateral)
                        out.crashes[i, cut] = who_crashes(followers, cut, lead, environment, path)
            hazard += path.hazard[cut]
        out.log_any[i] = math.log(-math.expm1(-hazard))
        if recorded.failed.size > 0 and recorded.failed[i]:
            hazard_beyond = 0.0
            for step in range(steps, reach):
                wish = laws.opportunity(state_of(path.x[step], path.v[step]), environment)
                hazard_beyond += laws.cut_in_hazard(wish, 1.0, environment)
            out.after_failure[i] = math.exp(-hazard) * -math.expm1(-hazard_beyond)


def write_maneuvers(
    seed: int, paths: Paths, cut: IntArray, environment: Environment, draws_per_cut_in: int = FREE_DRAWS_PER_CUT_IN
) -> Maneuvers:
    """What LV and BV do on paths (n,) with cut-ins in steps ``cut`` (n,), -1: none.

    After a cut-in LV goes on to draw, to the end of the test. ``draws_per_cut_in`` is 0 outside of pools.
    """
    scratch, n = empty_trajectory(environment), paths.number.size
    lv, bv = np.zeros((2, n, scratch.lv.size), np.int8)
    n_lv, n_bv, lead = np.zeros((3, n), np.int64)
    maneuvers = Maneuvers(lv, bv, n_lv, n_bv, lead)
    _write(seed, unboxed(paths), cut, draws_per_cut_in, unboxed(environment), unboxed(scratch), unboxed(maneuvers))
    return maneuvers


@compiled_threads
def _write(
    seed: int, paths: Paths, cut: IntArray, stride: int, environment: Environment, path: Trajectory, out: Maneuvers
) -> None:
    n, lv, bv = environment.numbers, out.lv, out.bv
    for i in range(cut.size):
        number, until = paths.number[i], cut[i] + 1 if cut[i] >= 0 else n.max_steps
        steps = walk(paths.start[i], seed, number, until, False, environment, path)
        before = (steps - 1) // n.hold_steps + 1
        for m in range(before):
            lv[i, m], bv[i, m] = path.lv[m], path.bv[m]
        out.n_lv[i] = out.n_bv[i] = before
        if cut[i] < 0:
            continue
        bv[i, before] = CUT_IN
        n_free = leave(cut[i], n.max_steps, seed, number, cut[i] * stride, environment, path)
        for m in range(n_free):
            bv[i, before + 1 + m] = path.free[m]
        out.n_bv[i] += 1 + n_free
        out.lead[i] = draw_lead(cut[i], seed, number, environment.lateral)
        out.n_lv[i] = (n.max_steps - 1) // n.hold_steps + 1
        v = path.v[0, LV]
        for step in range(n.max_steps):
            m = step // n.hold_steps
            if step % n.hold_steps == 0 and m >= before:
                u = uniform(seed, number, LV_DRAWS, m)
                lv[i, m] = laws.drive_freely(u, v, environment)
            v = next_speed(v, laws.acceleration(lv[i, m]))
