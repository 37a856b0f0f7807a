"""Accelerations of built-in AVs for the coming step, what other controllers see of it, and the speeds commanded."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harness.compiled import compiled, compiled_inline
from harness.controllers.protocol import BatchObservation
from harness.families.script import NEVER
from harness.loop.cells import KernelState
from harness.vehicles.following import Ahead, braking_seen_after, follow_on, headway_of, seen_after
from harness.vehicles.kinematics import STEP_S, gap, next_speed
from harness.vehicles.references import Memory, react, reaction_steps, still_cruises
from harness.vehicles.sideways import lateral_position, perceived_in
from harness.vocabulary import FloatArray, Int8Array, IntArray, read_only


@compiled
def drive(kernel: KernelState) -> None:
    """Set the acceleration of a built-in AV in every cell where it follows, or where an event has begun."""
    x, v, cells, driver = kernel.x, kernel.v, kernel.cells, kernel.driver
    av, other = x.shape[1] - 1, kernel.principal
    perceives_m = driver[0].perceives_lateral_m
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        if cell.row >= 0 and cell.acts_from == 0:
            follow(k, kernel)
        if cell.row < 0 or cell.acts_from == 0 or cell.onset_step < 0 or cell.step <= cell.onset_step:
            continue
        perceived, earlier = perceived_in(perceives_m, cell.planned, cell.lead, kernel.sideways_m)
        step = cell.step - perceived - reaction_steps(driver[0], kernel.seed, cell.episode)
        if step >= 0:
            memory = Memory(cells.acceleration[k], cell.danger, driver[0].used_up_steps + earlier)
            memory = react(driver[0], memory, step, v[k, av], v[k, other], gap(x[k, other], x[k, av]))
            cells.acceleration[k], cell.danger = held_if_cruising(k, memory.acceleration, kernel), memory.danger


@compiled_inline
def follow(k: int, kernel: KernelState) -> None:
    """Set the acceleration of a built-in AV that follows from the start; see `harness.vehicles.following`."""
    cells, driver, script, lane = kernel.cells, kernel.driver[0], kernel.script, kernel.cells.lane_before
    cell, speed = cells.cell[k], kernel.v[k, kernel.x.shape[1] - 1]
    perceived, reacts = 0, NEVER
    lead = revealed = Ahead(speed, math.inf, 0.0)
    if cell.onset_step >= 0:
        clear, perceived = cell.planned + 1 - cell.onset_step, cell.onset_step + braking_seen_after(driver)
        if script.sideways_mps[cell.row] > 0.0:
            perceived = cell.onset_step + seen_after(driver.perceives_lateral_m, script.sideways_mps[cell.row], clear)
        for other in range(kernel.x.shape[1] - 1):
            perceived = max(perceived, script.visible_from[cell.row, other])
        reacts = perceived + reaction_steps(driver, kernel.seed, cell.episode)
    for other in range(kernel.x.shape[1] - 1):
        hidden = script.visible_from[cell.row, other] > 0
        if not is_ahead_of(k, other, lane, kernel) or (hidden and (cell.onset_step < 0 or cell.step < perceived)):
            continue
        ahead = ahead_of(k, other, kernel)
        if hidden and ahead.gap < revealed.gap:
            revealed = ahead
        elif not hidden and ahead.gap < lead.gap:
            lead = ahead
    waits = 0 <= cell.onset_step < cell.step < reacts
    memory = Memory(cells.acceleration[k], cell.danger, 0.0)
    headway_s = headway_of(driver, script.headway_s[cell.row], script.v[cell.row, script.v.shape[1] - 1])
    memory = follow_on(driver, headway_s, memory, cell.step - reacts, waits, speed, lead, revealed)
    cells.acceleration[k], cell.danger = memory.acceleration, memory.danger
    kernel.episode[cell.row].took_over_step = 0


@compiled_inline
def ahead_of(k: int, other: int, kernel: KernelState) -> Ahead:
    """Another vehicle, as the AV sees it ahead."""
    cell, v = kernel.cells.cell[k], kernel.v[k, other]
    before = v
    if cell.step == 1:
        before = kernel.script.v[cell.row, other]
    elif cell.step > 1:
        before = kernel.script.speed[cell.row, cell.step - 2, other]
    return Ahead(v, gap(kernel.x[k, other], kernel.x[k, kernel.x.shape[1] - 1]), (v - before) / STEP_S)


@compiled_inline
def held_if_cruising(k: int, asked: float, kernel: KernelState) -> float:
    """Acceleration (m/s²) of an AV that asks for one: 0 while it cruises."""
    cell = kernel.cells.cell[k]
    test = kernel.episode[cell.row]
    if still_cruises(cell.cruises, 0 <= cell.event_step < cell.step, asked):
        test.asked_to_speed_up |= asked > 0.0
        return 0.0
    if test.took_over_step < 0:
        cell.cruises, test.took_over_step = 0, cell.step
    return asked


@compiled
def hold_cruising(kernel: KernelState, n: int) -> None:
    """Hold those of the first ``n`` AVs of the observation that still cruise; the others do what they ask for."""
    for i in range(n):
        k = kernel.observation.cell[i]
        kernel.cells.acceleration[k] = held_if_cruising(k, kernel.cells.acceleration[k], kernel)


@compiled
def observe(kernel: KernelState) -> int:
    """Write to ``kernel.observation`` what the AVs that are to act see; returns their number."""
    x, v, cells, out = kernel.x, kernel.v, kernel.cells, kernel.observation
    av, bv, lv, distance_m = x.shape[1] - 1, kernel.principal, kernel.ahead, kernel.sideways_m
    n = 0
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        if cell.row < 0 or cell.step < cell.acts_from:
            continue
        leader = leader_of(k, cells.lane_before, False, kernel)
        begun = 0 <= cell.onset_step < cell.step
        on_lane = cells.lane_before[k, bv] == cells.lane_before[k, av] and is_visible(k, bv, kernel)
        out.cell[n], out.episode[n], out.time_s[n] = k, cell.announced_index, cell.step * STEP_S
        out.position_m[n], out.speed_mps[n] = x[k, av], v[k, av]
        out.acceleration_mps2[n] = cells.acceleration[k]
        out.gap_m[n] = gap(x[k, leader], x[k, av]) if leader >= 0 else math.inf
        out.lead_speed_mps[n] = v[k, leader] if leader >= 0 else math.nan
        out.bv_position_m[n], out.bv_speed_mps[n] = seen_of(k, bv, kernel)
        out.bv_lane[n] = cells.lane_before[k, bv]
        out.lv_position_m[n], out.lv_speed_mps[n] = seen_of(k, lv, kernel)
        out.lv_lane[n] = cells.lane_before[k, lv] if lv >= 0 else 0
        out.bv_overlaps[n], out.set_speed_mps[n] = 1 if on_lane else 0, cell.set_speed
        out.bv_lateral_m[n] = out.bv_lateral_speed_mps[n] = out.lv_lateral_m[n] = out.lv_lateral_speed_mps[n] = 0.0
        if begun and kernel.script.sideways_mps[cell.row] > 0.0:  # the vehicle ahead leaves the lane
            leaving = kernel.script.sideways_mps[cell.row]
            out.lv_lateral_m[n] = min(leaving * ((cell.step - cell.onset_step) * STEP_S), distance_m)
            out.lv_lateral_speed_mps[n] = leaving if cell.step <= cell.planned else 0.0
        elif begun and distance_m > 0.0:
            out.bv_lateral_m[n] = lateral_position(cell.step, cell.planned, cell.lead, distance_m)
            out.bv_lateral_speed_mps[n] = 0.0 if on_lane else distance_m / (cell.lead * STEP_S)
        n += 1
    return n


@compiled_inline
def is_visible(k: int, other: int, kernel: KernelState) -> bool:
    """Whether an AV sees another vehicle."""
    cell = kernel.cells.cell[k]
    return bool(cell.step >= kernel.script.visible_from[cell.row, other])


@compiled_inline
def is_ahead_of(k: int, other: int, lane: Int8Array, kernel: KernelState) -> bool:
    """Whether another vehicle is ahead of the AV and on its ``lane`` (K, V)."""
    x, av = kernel.x, kernel.x.shape[1] - 1
    return bool(lane[k, other] == lane[k, av] and x[k, other] > x[k, av])


@compiled_inline
def leader_of(k: int, lane: Int8Array, sees_all: bool, kernel: KernelState) -> int:
    """The nearest vehicle ahead on the AV's ``lane`` (K, V), of all or of those that it sees; -1 for none."""
    x, leader = kernel.x, -1
    for other in range(x.shape[1] - 1):
        ahead = is_ahead_of(k, other, lane, kernel) and (sees_all or is_visible(k, other, kernel))
        if ahead and (leader < 0 or x[k, other] < x[k, leader]):
            leader = other
    return leader


@compiled_inline
def seen_of(k: int, other: int, kernel: KernelState) -> tuple[float, float]:
    """Position (m) and speed (m/s) of another vehicle; NaN for one that is not there, or not seen."""
    if other < 0 or not is_visible(k, other, kernel):
        return math.nan, math.nan
    return kernel.x[k, other], kernel.v[k, other]


_INTEGERS = "cell", "episode", "bv_lane", "lv_lane", "bv_overlaps"
_FLOATS = [name for name in BatchObservation._fields if name not in _INTEGERS]


def empty_observation(n_cells: int) -> BatchObservation:
    """Room for the observations of K cells, as rows of one array of integers and of one of floats."""
    return _rows(np.zeros((len(_INTEGERS), n_cells), np.int64), np.zeros((len(_FLOATS), n_cells)))


def first(observation: BatchObservation, n: int) -> BatchObservation:
    """The first ``n`` entries of every array, as copies that a controller may keep, and that nobody can write into."""
    integers: Any = observation.cell.base
    floats: Any = observation.time_s.base
    return _rows(read_only(integers[:, :n].copy()), read_only(floats[:, :n].copy()))


class Past:
    """The last states of K cells, for the warm-up of a controller whose AV keeps its speed until the event.

    ``principal`` and ``ahead`` are the places of the vehicles that are BV and LV to it; see `KernelState`.
    """

    def __init__(self, n_steps: int, shape: tuple[int, ...], principal: int, ahead: int) -> None:
        self._states = np.zeros((n_steps, 2, *shape))
        self._principal, self._ahead = principal, ahead
        self._n_noted = 0

    def note(self, x: FloatArray, v: FloatArray) -> None:
        """Keep positions and speeds (K, V) before a step."""
        if n_steps := len(self._states):
            self._states[self._n_noted % n_steps] = x, v
            self._n_noted += 1

    def before(self, seen: BatchObservation) -> list[BatchObservation]:
        """What the AVs (n,) of observations would have seen in each of the last steps, the oldest first.

        Nobody was ahead, and nobody changed speed before the episode began: there time is negative.
        """
        n_steps, step = len(self._states), np.rint(seen.time_s / STEP_S).astype(np.int64)
        ago = np.arange(n_steps, 0, -1)[:, None]
        noted = np.minimum(ago, step)
        shape = noted.shape
        x, v = np.moveaxis(self._states[(self._n_noted - noted) % n_steps, :, seen.cell], (2, 3), (0, 1))
        x = x - v * ((ago - noted) * STEP_S)
        lv_x, lv_v = (x[self._ahead], v[self._ahead]) if self._ahead >= 0 else (np.full(shape, math.nan),) * 2
        columns = {
            "time_s": (step - ago) * STEP_S, "position_m": x[-1], "speed_mps": v[-1],
            "gap_m": np.full(shape, math.inf), "lead_speed_mps": np.full(shape, math.nan),
            "bv_position_m": x[self._principal], "bv_speed_mps": v[self._principal],
            "lv_position_m": lv_x, "lv_speed_mps": lv_v,
            "set_speed_mps": np.broadcast_to(seen.set_speed_mps, shape),
        }  # fmt: skip
        floats = [columns.get(name, np.zeros(shape)) for name in _FLOATS]
        left_lane = np.ones_like(seen.cell)
        integers = read_only(np.stack((seen.cell, seen.episode, left_lane, left_lane, np.zeros_like(left_lane))))
        return [_rows(integers, of_step) for of_step in read_only(np.stack(floats, axis=1))]


def _rows(integers: IntArray, floats: FloatArray) -> BatchObservation:
    return BatchObservation(**dict(zip(_INTEGERS, integers, strict=True)), **dict(zip(_FLOATS, floats, strict=True)))


@compiled
def command(kernel: KernelState) -> None:
    """Turn the AVs' accelerations into the speeds at the end of the step; idle cells stand still."""
    x, v, cells, av = kernel.x, kernel.v, kernel.cells, kernel.x.shape[1] - 1
    for k in range(cells.cell.size):
        if cells.cell[k].row < 0:
            for vehicle in range(av + 1):
                cells.speed[k, vehicle], cells.lane[k, vehicle] = 0.0, cells.lane_before[k, vehicle]
            continue
        cells.speed[k, av] = next_speed(v[k, av], cells.acceleration[k])
        if kernel.keep_traces:
            for vehicle in range(av + 1):
                here = cells.trace[k, cells.cell[k].step, vehicle]
                here[0], here[1], here[3] = x[k, vehicle], v[k, vehicle], cells.lane_before[k, vehicle]
                here[2] = (cells.speed[k, vehicle] - v[k, vehicle]) / STEP_S
            cells.trace[k, cells.cell[k].step, av, 2] = cells.acceleration[k]
