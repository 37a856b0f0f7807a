"""After a step: which episodes are over and how (crash, impact speed, ...), and what stays of them."""

from __future__ import annotations

import math

import numpy as np

from harness.compiled import compiled, compiled_inline
from harness.episode.beside import note_if_ahead
from harness.episode.cells import Bench, state_of
from harness.episode.motion import mixed
from harness.importance.functions import log_weight
from harness.vehicles.kinematics import CONTACT_M, STEP_S, overlaps
from harness.vocabulary import (
    AV,
    BV,
    BV_LV_CONTACT,
    CRASH,
    FAILED,
    PASSED,
    RUNNING,
    TIMEOUT,
    BoolArray,
    FloatArray,
    Int8Array,
    IntArray,
    State,
)

PASSED_M, PASSED_UNDER_CONTROL_M = 0.0, -10.0
"""R2 at which the AV has passed BV: at once if it holds its speed, with a margin if its controller acts."""


@compiled
def judge(bench: Bench, contact: BoolArray) -> int:
    """End the episodes that are over after a step; ``contact`` (K,) are the world's own collision flags.

    Returns how many have ended (``cells.ended`` receives which); -1 - k if flag and crash criterion differ in cell k.
    """
    cells = bench.cells
    ended = 0
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        if cell.row < 0:
            continue
        cell.step += 1
        state = state_of(k, bench)
        if cell.cut_step >= 0 and state.r2dot_mps < 0.0 and state.r2_m >= 0.0:
            cell.min_ttc = min(cell.min_ttc, state.r2_m / -state.r2dot_mps)
        if bench.boundary.size > 0:
            note_if_ahead(k, bench)
        outcome = outcome_of(k, state, bench)
        if contact[k] != (outcome in (CRASH, BV_LV_CONTACT)):
            return -1 - k
        if bench.traffic.motion.size > 0 and strays(k, outcome, bench):
            outcome = FAILED
        if outcome != RUNNING:
            end_episode(k, outcome, ended, bench)
            ended += 1
    return ended


@compiled_inline
def outcome_of(k: int, state: State, bench: Bench) -> int:
    """How the episode ends in its present state, or `RUNNING`."""
    cell = bench.cells.cell[k]
    if cell.cut_step >= 0:
        if cell.step == cell.cut_step + 1 and state.r1_m < CONTACT_M:
            return BV_LV_CONTACT  # it touched LV before it had left the lane
        if state.r2_m < CONTACT_M:
            return CRASH if overlaps(bench.x[k, BV], bench.x[k, AV]) else PASSED
    elif state.r1_m < CONTACT_M:
        return BV_LV_CONTACT
    elif state.r2_m <= bench.passed_m and not (0 <= cell.onset_step < cell.step):
        return PASSED
    if cell.step >= bench.environment.numbers.max_steps:
        return TIMEOUT
    return RUNNING


@compiled_inline
def strays(k: int, outcome: int, bench: Bench) -> bool:
    """Whether the AV has done something else than in its shadow run: what follows would count with a wrong weight."""
    cell, traffic = bench.cells.cell[k], bench.traffic
    if 0 <= cell.onset_step < cell.step - 1:
        return False
    x, v = bench.x.view(np.uint64), bench.v.view(np.uint64)
    cell.motion = mixed(mixed(cell.motion, x[k, AV]), v[k, AV])
    if 0 <= cell.onset_step < cell.step:
        return bool(cell.motion != traffic.motion[cell.row])
    return outcome != RUNNING  # before the onset that its shadow run has come to


@compiled
def fail(bench: Bench, failed: IntArray) -> None:
    """End the episodes of the given cells as failed, with the weight they have so far."""
    for n in range(failed.size):
        end_episode(failed[n], FAILED, n, bench)


@compiled_inline
def end_episode(k: int, outcome: int, n: int, bench: Bench) -> None:
    """Write the finished episode of cell ``k`` to its row, idle the cell, and list it in place ``n`` of those ended."""
    cells, results, v = bench.cells, bench.results, bench.v
    cell = cells.cell[k]
    row = results.episode[cell.row]
    row.outcome, row.n_steps, row.cut_in_step = outcome, cell.step, cell.cut_step
    row.cut_in_r2_m, row.cut_in_r2dot_mps, row.min_ttc_s = cell.cut_r2, cell.cut_r2dot, cell.min_ttc
    row.lead_steps, row.onset_step = cell.lead, cell.onset_step
    row.onset_r2_m, row.onset_r2dot_mps = cell.onset_r2, cell.onset_r2dot
    row.crash_time_s = cell.step * STEP_S if outcome == CRASH else math.nan
    row.impact_speed_mps = v[k, AV] - v[k, BV] if outcome == CRASH else math.nan
    row.av_distance_m = bench.x[k, AV] - cell.av_start
    row.n_control_steps, row.component = cell.n_control, cell.component
    method, alpha = bench.importance.method, bench.importance.alpha
    row.log_weight = log_weight(method, alpha, cells.log_ratio[k], cell.log_sampled, cell.log_p_cut_in)
    row.log_p_cut_in = cell.log_p_cut_in
    row.n_lv, row.n_bv = cell.n_lv, cell.n_path
    row.ahead_step = cell.ahead_step
    copy_row(cells.log_ratio[k], results.log_q[cell.row])
    copy_row(cells.martingale[k], results.martingale[cell.row])
    copy_row(cells.lv_path[k], results.lv_path[cell.row])
    copy_row(cells.bv_path[k], results.bv_path[cell.row])
    if bench.keep_traces:
        for vehicle in range(3):
            here = cells.trace[k, cell.step, vehicle]
            here[0], here[1], here[2] = bench.x[k, vehicle], v[k, vehicle], math.nan
    cells.ended[n], cells.ended_row[n] = k, cell.row
    cells.cut_in[k] = 0
    cell.row = -1


@compiled_inline
def copy_row(source: FloatArray | Int8Array, target: FloatArray | Int8Array) -> None:
    """Copy element by element: an array assignment would allocate."""
    for i in range(source.size):
        target[i] = source[i]
