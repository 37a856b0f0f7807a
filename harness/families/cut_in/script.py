"""What is to be known of a cut-in to repeat it, and the motion that this is."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.compiled import compiled_threads, unboxed
from harness.families.cut_in.events import Maneuvers
from harness.families.cut_in.laws import Environment, acceleration
from harness.families.cut_in.path import place
from harness.families.cut_in.vocabulary import STATE_COLUMNS, states_from
from harness.families.protocol import Chosen
from harness.families.script import Script, natural_script
from harness.vehicles.kinematics import next_speed
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


def states_of(facts: RecordArray) -> RecordArray:
    """Initial states (n,)."""
    return states_from(facts[name] for name in STATE_COLUMNS)


def maneuvers_of(chosen: Chosen) -> Maneuvers:
    """Maneuvers of chosen cut-ins (n,)."""
    lv, bv, n_lv, n_bv = (np.ascontiguousarray(chosen.facts[name]) for name in (*_LENGTHS, *_LENGTHS.values()))
    return Maneuvers(lv, bv, n_lv, n_bv, chosen.lead)


def beginning(state: RecordArray) -> tuple[FloatArray, FloatArray, Int8Array]:
    """Positions (m), speeds (m/s) and lanes (n, 3) of LV, BV and AV in initial states (n,)."""
    columns: Any = state.view(np.recarray)
    x, v = np.zeros((2, len(state), AV + 1))
    place(columns, x.T, v.T)
    lane = np.zeros(x.shape, np.int8)
    lane[:, [LV, BV]] = LEFT
    return x, v, lane


def script_of(traffic: Environment, chosen: Chosen) -> Script:
    """The motion of LV and BV, to the end of the longest test; beyond the last maneuver nothing can be meant."""
    facts, n, steps = chosen.facts, len(chosen.facts), int(traffic.numbers["max_steps"])
    x, v, lane = beginning(states_of(facts))
    speed, lanes = np.zeros((n, steps, BV + 1)), np.full((n, steps, BV + 1), LEFT, np.int8)
    _move(unboxed(maneuvers_of(chosen)), chosen.at, int(traffic.numbers["hold_steps"]), v, speed, lanes)
    return natural_script(x, v, lane, speed, lanes, chosen.at, chosen.lead)


@compiled_threads
def _move(told: Maneuvers, cut: IntArray, hold_steps: int, v: FloatArray, speed: FloatArray, lanes: Int8Array) -> None:
    for i in range(cut.size):
        v_lv, v_bv, a_lv, a_bv, used = v[i, LV], v[i, BV], 0.0, 0.0, 0
        for step in range(speed.shape[1]):
            left, redraws = 0 <= cut[i] < step, step % hold_steps == 0
            if redraws and step // hold_steps < told.n_lv[i]:
                a_lv = acceleration(told.lv[i, step // hold_steps])
            if left:
                redraws = (step - cut[i] - 1) % hold_steps == 0
            if redraws and used < told.n_bv[i]:
                a_bv = acceleration(told.bv[i, used])
                used += 1
            if step == cut[i]:
                used += 1  # the mark
            v_lv, v_bv = next_speed(v_lv, a_lv), next_speed(v_bv, a_bv)
            speed[i, step, LV], speed[i, step, BV] = v_lv, v_bv
            if 0 <= cut[i] <= step:
                lanes[i, step, BV] = RIGHT
