"""After a step: which tests are over, how each ended (crash, impact speed, ...), and what is recorded of it."""

from __future__ import annotations

import math

import numpy as np

from harness.compiled import compiled, compiled_inline
from harness.loop.cells import BRAKED_MPS2, KernelState
from harness.loop.drive import leader_of
from harness.loop.repeat import gap_and_rate
from harness.vehicles.kinematics import CONTACT_M, STEP_S, gap, overlaps
from harness.vocabulary import (
    CONTACT,
    CRASH,
    FAILED,
    PASSED,
    RUNNING,
    TIMEOUT,
    BoolArray,
    FloatArray,
    IntArray,
    UInt64Array,
)

PASSED_M, PASSED_UNDER_CONTROL_M = 0.0, -10.0
"""Gaps to the principal vehicle at which the AV has passed it: for one that holds its speed, and, with a margin, for
one whose controller acts."""


@compiled
def judge(kernel: KernelState, contact: BoolArray) -> int:
    """End the tests that are over after a step; ``contact`` (K,) are the world's own collision flags.

    Returns how many have ended (``cells.ended`` receives which); -1 - k if flag and crash criterion differ in cell k.
    """
    cells, av = kernel.cells, kernel.x.shape[1] - 1
    ended = 0
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        if cell.row < 0:
            continue
        cell.step += 1
        test = kernel.episode[cell.row]
        speed_before, cell.av_speed = cell.av_speed, kernel.v[k, av]
        if 0 <= cell.onset_step < cell.step:
            braking = (speed_before - cell.av_speed) / STEP_S
            test.hardest_braking_mps2 = max(test.hardest_braking_mps2, braking)
            if braking >= BRAKED_MPS2 and test.braked_step < 0:
                test.braked_step = cell.step - 1
        if is_ahead(k, kernel):
            gap_m, rate = gap_and_rate(k, kernel)
            if rate < 0.0 and gap_m >= 0.0:
                test.min_ttc_s = min(test.min_ttc_s, gap_m / -rate)
        outcome = outcome_of(k, kernel)
        if contact[k] != (outcome in (CRASH, CONTACT)):
            return -1 - k
        if kernel.script.motion_hash[cell.row] != 0 and left_baseline(k, outcome, kernel):
            outcome = FAILED
        if outcome != RUNNING:
            end_test(k, outcome, ended, kernel)
            ended += 1
    return ended


@compiled_inline
def is_ahead(k: int, kernel: KernelState) -> bool:
    """Whether the principal vehicle is on the AV's lane."""
    lane = kernel.cells.lane
    return bool(lane[k, kernel.principal] == lane[k, lane.shape[1] - 1])


@compiled_inline
def touched_by(k: int, vehicle: int, kernel: KernelState) -> int:
    """Lowest place of another vehicle, below ``vehicle``, that touches it; -1 for none.

    Two touch that overlap on one lane, or on the one that they shared when the step began.
    """
    lane, before = kernel.cells.lane, kernel.cells.lane_before
    for other in range(vehicle):
        shared = lane[k, other] == lane[k, vehicle] or before[k, other] == before[k, vehicle]
        if shared and overlaps(kernel.x[k, other], kernel.x[k, vehicle]):
            return other
    return -1


@compiled_inline
def outcome_of(k: int, kernel: KernelState) -> int:
    """How the test ends in its present state, or `RUNNING`."""
    cell, av = kernel.cells.cell[k], kernel.x.shape[1] - 1
    for other in range(1, av):
        if touched_by(k, other, kernel) >= 0:
            return CONTACT
    if touched_by(k, av, kernel) >= 0:
        return CRASH
    gap_m = gap(kernel.x[k, kernel.principal], kernel.x[k, av])
    passed_m = PASSED_UNDER_CONTROL_M if kernel.acts_early else PASSED_M
    if is_ahead(k, kernel):
        if gap_m < CONTACT_M:
            return PASSED
    elif gap_m <= passed_m and not (0 <= cell.onset_step < cell.step):
        return PASSED
    if cell.step >= kernel.script.n_steps[cell.row] or both_stand(k, kernel):
        return TIMEOUT
    return RUNNING


@compiled_inline
def both_stand(k: int, kernel: KernelState) -> bool:
    """Whether the AV and the vehicle ahead of it stand, after the onset: nothing more happens."""
    v, onset = kernel.v, kernel.cells.cell[k].onset_step
    if v[k, v.shape[1] - 1] != 0.0 or not 0 <= onset < kernel.cells.cell[k].step:
        return False
    leader = leader_of(k, kernel.cells.lane, True, kernel)
    return leader >= 0 and v[k, leader] == 0.0


@compiled_inline
def time_to_collision(k: int, kernel: KernelState) -> float:
    """Time (s) until an AV that closes in hits the vehicle ahead, each at its present acceleration and speed; else inf.

    It is the smaller root t of d = w t + a t²/2, d being the gap, w the closing speed and a the AV's acceleration.
    """
    v, av = kernel.v, kernel.x.shape[1] - 1
    leader = leader_of(k, kernel.cells.lane, True, kernel)
    if leader < 0 or v[k, av] <= v[k, leader]:
        return math.inf
    closing, gap_m = v[k, av] - v[k, leader], gap(kernel.x[k, leader], kernel.x[k, av])
    square = closing * closing + 2.0 * kernel.cells.acceleration[k] * gap_m
    return 2.0 * gap_m / (closing + math.sqrt(square)) if square >= 0.0 else math.inf


@compiled_inline
def left_baseline(k: int, outcome: int, kernel: KernelState) -> bool:
    """Whether the AV has not moved as in its baseline run, which its test's weight is made for."""
    cell, av = kernel.cells.cell[k], kernel.x.shape[1] - 1
    if 0 <= cell.onset_step < cell.step - 1:
        return False
    x, v = kernel.x.view(np.uint64), kernel.v.view(np.uint64)
    cell.motion_hash = mixed(mixed(cell.motion_hash, x[k, av]), v[k, av])
    if 0 <= cell.onset_step < cell.step:
        return bool(cell.motion_hash != kernel.script.motion_hash[cell.row])
    return outcome != RUNNING  # it ends before the onset, which its baseline run has reached


@compiled
def fail(kernel: KernelState, failed: IntArray) -> None:
    """End the tests of the given cells as failed, with the weight they have so far."""
    for n in range(failed.size):
        end_test(failed[n], FAILED, n, kernel)


@compiled_inline
def end_test(k: int, outcome: int, n: int, kernel: KernelState) -> None:
    """Finish the row of the test in cell ``k``, idle the cell, and list it in place ``n`` of those ended."""
    cells, v, av = kernel.cells, kernel.v, kernel.x.shape[1] - 1
    cell = cells.cell[k]
    row = kernel.episode[cell.row]
    row.outcome, row.n_steps = outcome, cell.step
    row.event_step, row.lead_steps, row.onset_step = cell.event_step, cell.lead, cell.onset_step
    if outcome == CRASH:
        row.crash_time_s = cell.step * STEP_S
        row.impact_speed_mps = v[k, av] - v[k, touched_by(k, av, kernel)]
    if outcome == TIMEOUT:
        row.end_ttc_s = time_to_collision(k, kernel)
    row.av_distance_m = kernel.x[k, av] - kernel.script.x[cell.row, av]
    if kernel.keep_traces:
        for vehicle in range(av + 1):
            here = cells.trace[k, cell.step, vehicle]
            here[0], here[1], here[2] = kernel.x[k, vehicle], v[k, vehicle], math.nan
            here[3] = cells.lane[k, vehicle]
    cells.ended[n], cells.ended_row[n] = k, cell.row
    cell.row = -1


# A running hash of the AV's motion, by which a test's is compared with that of its baseline run, to the last bit.
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
