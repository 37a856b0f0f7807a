"""Begin episodes: place vehicles, draw what is drawn once per episode, and look at the path ahead where needed."""

from __future__ import annotations

import math

from harness.compiled import compiled, compiled_inline
from harness.episode.cells import Bench
from harness.episode.critical_moment import take_down
from harness.episode.trajectory import place, state_in, walk, weigh_cut_ins
from harness.random_stream import CUT_IN, uniform
from harness.traffic.lateral import draw_lead, onset_of
from harness.vocabulary import AV, EPISODE_MIXTURE, FORCED, PRESCRIBED, FloatArray

COMPONENT_DRAW, CUT_IN_DRAW = 0, 1
"""Indices within the cut-in stream."""


@compiled
def refill(bench: Bench, given: int) -> int:
    """Give every idle cell the next episode of the shard, of which ``given`` rows have been given before.

    The world's ``x`` and ``v`` receive their placement, ``cells.placed`` their cells; returns how many there are.
    """
    n = 0
    for k in range(bench.cells.cell.size):
        if given + n == bench.states.size:
            break
        if bench.cells.cell[k].row < 0:
            place(bench.states[given + n], bench.x[k], bench.v[k])
            begin_cell(k, given + n, bench)
            bench.cells.placed[n] = k
            n += 1
    return n


@compiled_inline
def begin_cell(k: int, row: int, bench: Bench) -> None:
    """Reset cell ``k`` for the episode of a row."""
    cells, method = bench.cells, bench.importance.method
    seed, episode = bench.seed, bench.first_episode + row
    cell = cells.cell[k]
    cell.row, cell.episode, cell.step, cell.cut_step, cell.component = row, episode, 0, -1, -1
    cell.planned, cell.lead, cell.onset_step = -1, 0, -1
    cell.told = bench.traffic.told[row] if bench.traffic.told.size > 0 else episode
    cell.motion = 0
    cell.lv_maneuver = cell.bv_maneuver = cell.n_lv = cell.n_bv = cell.n_bv_free = cell.n_path = cell.n_control = 0
    cell.clock = cell.hazard = cell.log_sampled = 0.0
    cell.hazard_total = cell.log_p_cut_in = math.nan
    cell.min_ttc = cell.danger = math.inf
    cell.cut_r2 = cell.cut_r2dot = cell.onset_r2 = cell.onset_r2dot = math.nan
    cell.av_start = bench.x[k, AV]
    cell.ahead_step = -1
    cells.acceleration[k, AV] = 0.0
    cells.log_ratio[k, :] = 0.0
    cells.martingale[k, :] = 0.0
    if method == PRESCRIBED:
        log_weight = bench.traffic.log_weight[row]
        cell.component, cell.log_sampled = bench.traffic.stratum[row], -log_weight
        if bench.importance.first == 1:  # a forced cut-in whose path has been walked by the AV itself
            cell.log_p_cut_in, cells.log_ratio[k, 0] = log_weight, -log_weight
        if bench.traffic.lead.size > 0 and bench.traffic.cut_step[row] >= 0:
            plan_cut_in(k, bench.traffic.cut_step[row], bench.traffic.lead[row], bench)
        return
    forced = method == FORCED
    if method == EPISODE_MIXTURE:
        cell.component = draw_component(uniform(seed, episode, CUT_IN, COMPONENT_DRAW), bench.importance.alpha)
        forced = cell.component == 0
    u = uniform(seed, episode, CUT_IN, CUT_IN_DRAW)
    cell.target = -math.log1p(-u)
    environment, path, takes_time = bench.environment, bench.scratch.path, bench.environment.lateral.cumulative.size > 0
    if method in (FORCED, EPISODE_MIXTURE) or takes_time:
        max_steps = environment.numbers.max_steps
        steps = walk(bench.states[row], seed, episode, 0, max_steps, True, environment, path)
        hazard_total = weigh_cut_ins(steps, environment, path)
        if method in (FORCED, EPISODE_MIXTURE):
            cell.hazard_total = hazard_total
            p_cut_in = -math.expm1(-cell.hazard_total)
            cell.log_p_cut_in = math.log(p_cut_in)
            if forced:
                cell.target = min(-math.log1p(-u * p_cut_in), cell.hazard_total)
        if takes_time:
            look_for_cut_in(k, steps, bench)


@compiled_inline
def look_for_cut_in(k: int, steps: int, bench: Bench) -> None:
    """Plan the cut-in that the cell's clock leads to on a path that has been walked, if there is one."""
    cell, hazard = bench.cells.cell[k], bench.scratch.path.hazard
    for step in range(steps):
        cell.clock += hazard[step]
        cut = cell.clock >= cell.target
        if bench.importance.method == FORCED:
            state = state_in(step, bench.scratch.path)
            take_down(k, step, state, cut, -math.expm1(-hazard[step]), hazard[step], False, bench)
        if cut:
            lead = draw_lead(step, bench.seed, cell.episode, bench.environment.lateral)
            plan_cut_in(k, step, lead, bench)
            return


@compiled_inline
def plan_cut_in(k: int, cut: int, lead: int, bench: Bench) -> None:
    """BV will cut in in a step, and show it some steps earlier."""
    cell = bench.cells.cell[k]
    cell.planned, cell.lead, cell.onset_step = cut, lead, onset_of(cut, lead)


@compiled_inline
def draw_component(u: float, alpha: FloatArray) -> int:
    """Index of the importance function that this episode follows."""
    total = 0.0
    for j in range(alpha.size - 1):
        total += alpha[j]
        if u < total:
            return j
    return alpha.size - 1
