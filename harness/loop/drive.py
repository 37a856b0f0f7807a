"""What AVs do in the coming step, or see if a controller is to say it; and the speeds commanded."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harness.compiled import compiled, compiled_inline
from harness.controllers.protocol import BatchObservation
from harness.families.cut_in.lateral import lateral_position, perceived_in
from harness.loop.cells import KernelState
from harness.vehicles.kinematics import STEP_S, gap, next_speed
from harness.vehicles.references import Memory, react, reaction_steps, still_cruises
from harness.vocabulary import AV, BV, LV, FloatArray, IntArray, read_only


@compiled_inline
def drive_av(kernel: KernelState) -> None:
    """Acceleration of a built-in AV wherever it is cut in on; it acts from the step after the onset at most."""
    x, v, cells, driver = kernel.x, kernel.v, kernel.cells, kernel.driver
    perceives_m, distance_m = driver[0].perceives_lateral_m, kernel.environment.lateral.distance_m
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        if cell.row < 0 or cell.onset_step < 0 or cell.step <= cell.onset_step:
            continue
        first, earlier = perceived_in(perceives_m, cell.planned, cell.lead, distance_m)
        step = cell.step - first - reaction_steps(driver[0], kernel.seed, cell.episode)
        if step >= 0:
            memory = Memory(cells.acceleration[k, AV], cell.danger, driver[0].used_up_steps + earlier)
            memory = react(driver[0], memory, step, v[k, AV], v[k, BV], gap(x[k, BV], x[k, AV]))
            cells.acceleration[k, AV], cell.danger = held_if_cruising(k, memory.acceleration, kernel), memory.danger


@compiled_inline
def held_if_cruising(k: int, asked: float, kernel: KernelState) -> float:
    """Acceleration (m/s²) of an AV that asks for one: none while it cruises."""
    cell = kernel.cells.cell[k]
    if still_cruises(cell.cruises, 0 <= cell.cut_step < cell.step, asked):
        cell.asked_to_speed_up |= asked > 0.0
        return 0.0
    if cell.took_over_step < 0:
        cell.cruises, cell.took_over_step = 0, cell.step
    return asked


@compiled
def hold_cruising(kernel: KernelState, n: int) -> None:
    """The first ``n`` AVs that were asked do what they ask for, unless they are still to keep their speed."""
    for i in range(n):
        k = kernel.observation.cell[i]
        kernel.cells.acceleration[k, AV] = held_if_cruising(k, kernel.cells.acceleration[k, AV], kernel)


@compiled
def observe(kernel: KernelState) -> int:
    """Write what the AVs that are to act see to ``kernel.observation``; returns their number."""
    x, v, cells, out = kernel.x, kernel.v, kernel.cells, kernel.observation
    distance_m = kernel.environment.lateral.distance_m
    n = 0
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        followed, comes = 0 <= cell.cut_step < cell.step, 0 <= cell.onset_step < cell.step
        if cell.row < 0 or not (comes or kernel.acts_before_cut_in):
            continue
        out.cell[n], out.episode[n], out.time_s[n] = k, cell.announced_index, cell.step * STEP_S
        out.position_m[n], out.speed_mps[n] = x[k, AV], v[k, AV]
        out.acceleration_mps2[n] = cells.acceleration[k, AV]
        out.gap_m[n] = gap(x[k, BV], x[k, AV]) if followed else math.inf
        out.lead_speed_mps[n] = v[k, BV] if followed else math.nan
        out.bv_position_m[n], out.bv_speed_mps[n] = x[k, BV], v[k, BV]
        out.bv_lane[n] = 0 if followed else 1
        out.lv_position_m[n], out.lv_speed_mps[n] = x[k, LV], v[k, LV]
        out.bv_lateral_m[n] = lateral_position(cell.step, cell.planned, cell.lead, distance_m) if comes else 0.0
        out.bv_lateral_speed_mps[n] = distance_m / (cell.lead * STEP_S) if comes and not followed else 0.0
        out.bv_overlaps[n], out.set_speed_mps[n] = 1 if followed else 0, cell.set_speed
        n += 1
    return n


def empty_observation(n_cells: int) -> BatchObservation:
    """Room for the observations of K cells: rows of one array of whole numbers and of one of floats."""
    return _rows(np.zeros((4, n_cells), np.int64), np.zeros((13, n_cells)))


def first(observation: BatchObservation, n: int) -> BatchObservation:
    """The first ``n`` entries of every array, as copies that a controller may keep, and that nobody can write into."""
    whole: Any = observation.cell.base
    real: Any = observation.time_s.base
    return _rows(read_only(whole[:, :n].copy()), read_only(real[:, :n].copy()))


class Past:
    """The last states of K cells: what a controller whose AV keeps its speed until the cut-in is shown of them."""

    def __init__(self, n_steps: int, n_cells: int) -> None:
        self._states = np.zeros((n_steps, 2, n_cells, 3))
        self._n_noted = 0

    def note(self, x: FloatArray, v: FloatArray) -> None:
        """Keep positions and speeds (K, 3) before a step."""
        if n_steps := len(self._states):
            self._states[self._n_noted % n_steps] = x, v
            self._n_noted += 1

    def before(self, seen: BatchObservation) -> list[BatchObservation]:
        """What the AVs (n,) of observations would have seen in each of the last steps, the oldest first.

        Nobody was ahead, and nobody changed speed before the episode began: there time is negative.
        """
        n_steps, step = len(self._states), np.rint(seen.time_s / STEP_S).astype(np.int64)
        ago = np.arange(n_steps, 0, -1)[:, None]
        known = np.minimum(ago, step)
        x, v = np.moveaxis(self._states[(self._n_noted - known) % n_steps, :, seen.cell], (2, 3), (0, 1))
        x = x - v * ((ago - known) * STEP_S)
        nobody = np.full(known.shape, math.inf), np.full(known.shape, math.nan)
        zero = np.zeros(known.shape)
        set_speed = np.broadcast_to(seen.set_speed_mps, known.shape)
        real = (step - ago) * STEP_S, x[AV], v[AV], zero, *nobody, x[BV], v[BV], x[LV], v[LV], zero, zero, set_speed
        whole = read_only(np.stack((seen.cell, seen.episode, np.ones_like(seen.cell), np.zeros_like(seen.cell))))
        return [_rows(whole, rows) for rows in read_only(np.stack(real, axis=1))]


def _rows(whole: IntArray, real: FloatArray) -> BatchObservation:
    cell, episode, bv_lane, bv_overlaps = whole
    return BatchObservation._make([cell, episode, *real[:8], bv_lane, *real[8:12], bv_overlaps, real[12]])


@compiled
def command(kernel: KernelState) -> None:
    """Turn accelerations into the speeds at the end of the step; idle cells stand still."""
    x, v, cells = kernel.x, kernel.v, kernel.cells
    for k in range(cells.cell.size):
        running = cells.cell[k].row >= 0
        for vehicle in range(3):
            a = cells.acceleration[k, vehicle]
            cells.speed[k, vehicle] = next_speed(v[k, vehicle], a) if running else 0.0
            if kernel.keep_traces and running:
                here = cells.trace[k, cells.cell[k].step, vehicle]
                here[0], here[1], here[2] = x[k, vehicle], v[k, vehicle], a
