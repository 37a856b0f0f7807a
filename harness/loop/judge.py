"""After a step: which episodes are over and how (crash, impact speed, ...), and what stays of them."""

from __future__ import annotations

import math

import numpy as np

from harness.compiled import compiled, compiled_inline
from harness.families.cut_in.nade.likelihood_ratio import log_weight
from harness.families.cut_in.path import state_of
from harness.loop.cells import KernelState
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
    UInt64Array,
)

PASSED_M, PASSED_UNDER_CONTROL_M = 0.0, -10.0
"""R2 at which the AV has passed BV: at once if it holds its speed, with a margin if its controller acts."""


@compiled
def judge(kernel: KernelState, contact: BoolArray) -> int:
    """End the episodes that are over after a step; ``contact`` (K,) are the world's own collision flags.

    Returns how many have ended (``cells.ended`` receives which); -1 - k if flag and crash criterion differ in cell k.
    """
    cells = kernel.cells
    ended = 0
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        if cell.row < 0:
            continue
        cell.step += 1
        state = state_of(kernel.x[k], kernel.v[k])
        if cell.cut_step >= 0 and state.r2dot_mps < 0.0 and state.r2_m >= 0.0:
            cell.min_ttc = min(cell.min_ttc, state.r2_m / -state.r2dot_mps)
        outcome = outcome_of(k, state, kernel)
        if contact[k] != (outcome in (CRASH, BV_LV_CONTACT)):
            return -1 - k
        if kernel.traffic.motion_hash.size > 0 and left_baseline(k, outcome, kernel):
            outcome = FAILED
        if outcome != RUNNING:
            end_episode(k, outcome, ended, kernel)
            ended += 1
    return ended


@compiled_inline
def outcome_of(k: int, state: State, kernel: KernelState) -> int:
    """How the episode ends in its present state, or `RUNNING`."""
    cell = kernel.cells.cell[k]
    if cell.cut_step >= 0:
        if cell.step == cell.cut_step + 1 and state.r1_m < CONTACT_M:
            return BV_LV_CONTACT  # it touched LV before it had left the lane
        if state.r2_m < CONTACT_M:
            return CRASH if overlaps(kernel.x[k, BV], kernel.x[k, AV]) else PASSED
    elif state.r1_m < CONTACT_M:
        return BV_LV_CONTACT
    elif state.r2_m <= kernel.passed_m and not (0 <= cell.onset_step < cell.step):
        return PASSED
    if cell.step >= kernel.environment.numbers.max_steps:
        return TIMEOUT
    return RUNNING


@compiled_inline
def left_baseline(k: int, outcome: int, kernel: KernelState) -> bool:
    """Whether the AV has done something else than in its baseline run: what follows would count with a wrong weight."""
    cell, traffic = kernel.cells.cell[k], kernel.traffic
    if 0 <= cell.onset_step < cell.step - 1:
        return False
    x, v = kernel.x.view(np.uint64), kernel.v.view(np.uint64)
    cell.motion_hash = mixed(mixed(cell.motion_hash, x[k, AV]), v[k, AV])
    if 0 <= cell.onset_step < cell.step:
        return bool(cell.motion_hash != traffic.motion_hash[cell.row])
    return outcome != RUNNING  # before the onset that its baseline run has come to


@compiled
def fail(kernel: KernelState, failed: IntArray) -> None:
    """End the episodes of the given cells as failed, with the weight they have so far."""
    for n in range(failed.size):
        end_episode(failed[n], FAILED, n, kernel)


@compiled_inline
def end_episode(k: int, outcome: int, n: int, kernel: KernelState) -> None:
    """Write the finished episode of cell ``k`` to its row, idle the cell, and list it in place ``n`` of those ended."""
    cells, results, v = kernel.cells, kernel.results, kernel.v
    cell = cells.cell[k]
    row = results.episode[cell.row]
    row.outcome, row.n_steps, row.cut_in_step = outcome, cell.step, cell.cut_step
    row.cut_in_r2_m, row.cut_in_r2dot_mps, row.min_ttc_s = cell.cut_r2, cell.cut_r2dot, cell.min_ttc
    row.lead_steps, row.onset_step = cell.lead, cell.onset_step
    row.onset_r2_m, row.onset_r2dot_mps = cell.onset_r2, cell.onset_r2dot
    row.crash_time_s = cell.step * STEP_S if outcome == CRASH else math.nan
    row.impact_speed_mps = v[k, AV] - v[k, BV] if outcome == CRASH else math.nan
    row.av_distance_m = kernel.x[k, AV] - cell.av_start
    row.n_control_steps, row.component = cell.n_control, cell.component
    row.log_weight = log_weight(kernel.importance, cells.log_ratio[k], cell.log_sampled)
    row.log_p_cut_in = cell.log_p_cut_in
    row.n_lv, row.n_bv = cell.n_lv, cell.n_path
    row.took_over_step, row.asked_to_speed_up = cell.took_over_step, cell.asked_to_speed_up
    copy_row(cells.log_ratio[k], results.log_q[cell.row])
    copy_row(cells.martingale[k], results.martingale[cell.row])
    copy_row(cells.lv_path[k], results.lv_path[cell.row])
    copy_row(cells.bv_path[k], results.bv_path[cell.row])
    if kernel.keep_traces:
        for vehicle in range(3):
            here = cells.trace[k, cell.step, vehicle]
            here[0], here[1], here[2] = kernel.x[k, vehicle], v[k, vehicle], math.nan
    cells.ended[n], cells.ended_row[n] = k, cell.row
    cells.cut_in[k] = 0
    cell.row = -1


@compiled_inline
def copy_row(source: FloatArray | Int8Array, target: FloatArray | Int8Array) -> None:
    """Copy element by element: an array assignment would allocate."""
    for i in range(source.size):
        target[i] = source[i]


# A running hash of the AV's motion: whether a test's vehicle has done what it did in its baseline run, to the last bit.
# Each word is mixed in by a multiplication, which carries low bits up, and a shift, which brings high bits down: the
# finalizer of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014, doi:10.1145/2660193.2660195), one round per word. Two
# motions that differ agree by chance with a probability of about 2^-64.
_MULTIPLIER = np.uint64(0xBF58476D1CE4E5B9)
_SHIFT = np.uint64(31)


@compiled_inline
def mixed(so_far: np.uint64, word: np.uint64) -> np.uint64:
    """The hash, continued by the bits of one number."""
    z = (so_far ^ word) * _MULTIPLIER
    return z ^ (z >> _SHIFT)


@compiled
def _hash_motion(x: UInt64Array, v: UInt64Array, hashes: UInt64Array) -> None:
    for i in range(x.shape[0]):
        so_far = np.uint64(0)
        for step in range(hashes.shape[1]):
            so_far = mixed(mixed(so_far, x[i, step + 1]), v[i, step + 1])
            hashes[i, step] = so_far


def motion_hashes(x_m: FloatArray, v_mps: FloatArray) -> UInt64Array:
    """Hash of positions and speeds (n, steps + 1) after each step, shape (n, steps); initial states are left out."""
    hashes = np.zeros((x_m.shape[0], x_m.shape[1] - 1), np.uint64)
    _hash_motion(np.ascontiguousarray(x_m).view(np.uint64), np.ascontiguousarray(v_mps).view(np.uint64), hashes)
    return hashes
