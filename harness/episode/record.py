"""Take down what happens: the likelihood ratio and the record of a control step, and the end of an episode."""

from __future__ import annotations

import math

from harness.arrays import FloatArray, Int8Array
from harness.compiled import compiled_inline
from harness.episode.cells import Bench, Cells
from harness.importance.functions import Importance
from harness.importance.likelihood import accumulate, log_mixture
from harness.outcomes import AV, BV, CRASH, EPISODE_MIXTURE, FORCED, STEP_MIXTURE
from harness.state import State
from harness.vehicles.kinematics import STEP_S


@compiled_inline
def take_in(k: int, bench: Bench) -> float:
    """Take ``scratch.ratio`` and ``scratch.challenge`` of a step into the likelihood ratios; returns its q_α/p."""
    cells, scratch, importance = bench.cells, bench.scratch, bench.importance
    cell = cells.cell[k]
    sampled = accumulate(
        importance.method,
        importance.first,
        importance.alpha,
        scratch.ratio,
        scratch.challenge,
        cell.log_sampled,
        cells.log_ratio[k],
        cells.martingale[k],
    )
    if importance.method == STEP_MIXTURE:
        cell.log_sampled += math.log(sampled)
    return sampled


@compiled_inline
def record_moment(k: int, state: State, maneuver: int, p: float, q_sampled: float, bench: Bench) -> None:
    """Keep a control step, if the campaign keeps that many of an episode."""
    results, scratch = bench.results, bench.scratch
    cell = bench.cells.cell[k]
    if cell.n_control > results.moment_limit:
        return
    i = results.moment_count[0]
    moment = results.moment[i]
    moment.row, moment.step, moment.maneuver = cell.row, cell.step, maneuver
    moment.v_bv_mps, moment.r1_m, moment.r1dot_mps = state.v_bv_mps, state.r1_m, state.r1dot_mps
    moment.r2_m, moment.r2dot_mps = state.r2_m, state.r2dot_mps
    moment.p, moment.q_sampled = p, q_sampled
    for j in range(scratch.q.size):
        results.moment_q[i, j] = scratch.q[j]
        results.moment_v[i, j] = scratch.challenge[j]
    results.moment_count[0] = i + 1


@compiled_inline
def log_weight(k: int, cells: Cells, importance: Importance) -> float:
    """Log p(x_c) − log q_sampled(x_c) of a finished episode; exactly 0 without control."""
    method = importance.method
    if method == FORCED:
        return float(cells.cell[k].log_p_cut_in)
    if method == EPISODE_MIXTURE:
        return -log_mixture(importance.alpha, cells.log_ratio[k])
    return float(-cells.cell[k].log_sampled)


@compiled_inline
def copy_row(source: FloatArray | Int8Array, target: FloatArray | Int8Array) -> None:
    """Copy element by element: an array assignment would allocate."""
    for i in range(source.size):
        target[i] = source[i]


@compiled_inline
def end_episode(k: int, outcome: int, n: int, bench: Bench) -> None:
    """Write the finished episode of cell ``k`` to its row, idle the cell, and list it in place ``n`` of those ended."""
    cells, results, v = bench.cells, bench.results, bench.v
    cell = cells.cell[k]
    row = results.episode[cell.row]
    row.outcome, row.n_steps, row.cut_in_step = outcome, cell.step, cell.cut_step
    row.cut_in_r2_m, row.cut_in_r2dot_mps, row.min_ttc_s = cell.cut_r2, cell.cut_r2dot, cell.min_ttc
    row.crash_time_s = cell.step * STEP_S if outcome == CRASH else math.nan
    row.impact_speed_mps = v[k, AV] - v[k, BV] if outcome == CRASH else math.nan
    row.av_distance_m = bench.x[k, AV] - cell.av_start
    row.n_control_steps, row.component = cell.n_control, cell.component
    row.log_weight, row.log_p_cut_in = log_weight(k, cells, bench.importance), cell.log_p_cut_in
    row.n_lv, row.n_bv = cell.n_lv, cell.n_path
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
