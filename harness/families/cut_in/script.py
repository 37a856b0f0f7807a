"""The facts that are needed to repeat a cut-in, its motion, and which other drivers crash on it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harness.compiled import compiled_threads, unboxed
from harness.families.cut_in.events import Maneuvers
from harness.families.cut_in.laws import Environment, acceleration
from harness.families.cut_in.path import NO_CRASH, Trajectory, empty_trajectory, follow, place, take_over
from harness.families.cut_in.vocabulary import STATE_COLUMNS, states_from
from harness.families.protocol import Chosen, Driven
from harness.families.script import Script, natural_script
from harness.vehicles.kinematics import next_position, next_speed
from harness.vehicles.sideways import onset_of
from harness.vocabulary import AV, BV, LV, FloatArray, Int8Array, IntArray, RecordArray

LEFT, RIGHT = 1, 0
_LENGTHS = {"lv_maneuvers": "n_lv", "bv_maneuvers": "n_bv"}


def facts_of(state: RecordArray, maneuvers: Maneuvers) -> RecordArray:
    """Initial states (n,), and the maneuvers of LV and BV from there on, 31 of BV's marking the cut-in."""
    draws = maneuvers.lv.shape[1]
    lists = [(name, np.int8, (draws,)) for name in _LENGTHS]
    lengths = [(name, np.int64) for name in _LENGTHS.values()]
    facts: RecordArray = np.zeros(len(state), np.dtype([*state.dtype.descr, *lists, *lengths]))
    for name in STATE_COLUMNS:
        facts[name] = state[name]
    facts["lv_maneuvers"], facts["bv_maneuvers"] = maneuvers.lv, maneuvers.bv
    facts["n_lv"], facts["n_bv"] = maneuvers.n_lv, maneuvers.n_bv
    return facts


def beginning(state: RecordArray) -> tuple[FloatArray, FloatArray, Int8Array]:
    """Positions (m), speeds (m/s) and lanes (n, 3) of LV, BV and AV in initial states (n,)."""
    columns: Any = state.view(np.recarray)
    x, v = np.zeros((2, len(state), AV + 1))
    place(columns, x.T, v.T)
    lane = np.zeros(x.shape, np.int8)
    lane[:, [LV, BV]] = LEFT
    return x, v, lane


def script_of(traffic: Environment, chosen: Chosen) -> Script:
    """The motion of LV and BV, to the end of the longest test; after its last maneuver BV keeps its speed."""
    facts, n, steps = chosen.facts, len(chosen.facts), int(traffic.numbers["max_steps"])
    x, v, lane = beginning(states_from(facts[name] for name in STATE_COLUMNS))
    lv, bv, n_lv, n_bv = (np.ascontiguousarray(facts[name]) for name in (*_LENGTHS, *_LENGTHS.values()))
    maneuvers = unboxed(Maneuvers(lv, bv, n_lv, n_bv, chosen.lead))
    speed, lanes = np.zeros((n, steps, BV + 1)), np.full((n, steps, BV + 1), LEFT, np.int8)
    _move(maneuvers, chosen.at, int(traffic.numbers["hold_steps"]), v, speed, lanes)
    return natural_script(x, v, lane, speed, lanes, chosen.at, chosen.lead)


@compiled_threads
def _move(
    maneuvers: Maneuvers, cut: IntArray, hold_steps: int, v: FloatArray, speed: FloatArray, lanes: Int8Array
) -> None:
    for i in range(cut.size):
        v_lv, v_bv, a_lv, a_bv, used = v[i, LV], v[i, BV], 0.0, 0.0, 0
        for step in range(speed.shape[1]):
            has_cut_in = 0 <= cut[i] < step
            redraws = step % hold_steps == 0
            if redraws and step // hold_steps < maneuvers.n_lv[i]:
                a_lv = acceleration(maneuvers.lv[i, step // hold_steps])
            if has_cut_in:
                redraws = (step - cut[i] - 1) % hold_steps == 0
            if redraws:
                a_bv = acceleration(maneuvers.bv[i, used]) if used < maneuvers.n_bv[i] else 0.0
                used += 1
            if step == cut[i]:
                used += 1  # the mark
            v_lv, v_bv = next_speed(v_lv, a_lv), next_speed(v_bv, a_bv)
            speed[i, step, LV], speed[i, step, BV] = v_lv, v_bv
            if 0 <= cut[i] <= step:
                lanes[i, step, BV] = RIGHT


def drive_along(
    traffic: Environment, chosen: Chosen, start: FloatArray, drivers: RecordArray, *, last: bool = False
) -> Driven:
    """See `harness.families.protocol.Family.drive`."""
    path, steps = empty_trajectory(traffic), int(traffic.numbers["max_steps"])
    motion = np.zeros((len(drivers), steps + 1, 2) if last else (0, 0, 0))
    out = Driven(np.zeros((len(chosen.at), len(drivers)), np.int64), motion, np.zeros((0, 0)))
    _drive(unboxed(script_of(traffic, chosen)), start, unboxed(traffic), drivers, unboxed(path), unboxed(out))
    return out._replace(ahead=np.stack((path.x_after, path.v_after), axis=1))


@compiled_threads
def _drive(
    script: Script, start: FloatArray, environment: Environment, drivers: RecordArray, path: Trajectory, out: Driven
) -> None:
    """Drive others along cut-ins (n,); ``path`` is room to work in, and holds BV's motion of the last afterwards."""
    max_steps, motion = environment.numbers.max_steps, out.motion
    path.slowest[:] = -math.inf  # so that nobody is taken to stay behind BV before the end
    for i in range(start.shape[0]):
        cut, lead = script.at[i], script.lead[i]
        after = onset_of(cut, lead) + 1
        path.x[0], path.v[0] = script.x[i], script.v[i]
        for step in range(max_steps):
            path.v[step + 1, BV], path.v[step + 1, AV] = script.speed[i, step, BV], path.v[0, AV]
            for vehicle in (BV, AV):
                v, v_after = path.v[step, vehicle], path.v[step + 1, vehicle]
                path.x[step + 1, vehicle] = next_position(path.x[step, vehicle], v, v_after)
        path.x_after[:], path.v_after[:] = path.x[:, BV], path.v[:, BV]
        if not math.isnan(start[i, 0]):
            path.x[after, AV], path.v[after, AV] = start[i]
        for d in range(drivers.size):
            for until in range(after if motion.size > 0 else max_steps, max_steps + 1):
                take_over(0, d, drivers, drivers[d].delay_steps, False, cut, lead, environment, path)
                follow(1, drivers, cut, lead, until, path)
                if motion.size > 0:
                    motion[d, until, 0], motion[d, until, 1] = path.follower[0].x, path.follower[0].v
                out.end[i, d] = path.follower[0].end
                if out.end[i, d] != NO_CRASH:
                    break
