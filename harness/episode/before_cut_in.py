"""A step before the cut-in: LV and BV redraw their accelerations, and BV stays or cuts in."""

from __future__ import annotations

import math

from harness.arrays import FloatArray
from harness.compiled import compiled_inline
from harness.environment.cut_in import acceptance, cut_in_hazard, opportunity
from harness.environment.driving import car_following, draw_acceleration
from harness.episode.cells import Bench, Cells
from harness.episode.record import record_moment, take_in
from harness.importance.functions import look_ahead, propose_cut_in
from harness.maneuvers import CUT_IN, STAY, acceleration
from harness.outcomes import EPISODE_MIXTURE, FORCED, NDE, STEP_MIXTURE
from harness.random_stream import BV_DRAWS, uniform
from harness.state import State


@compiled_inline
def redraw_following(k: int, state: State, bench: Bench) -> None:
    """BV's acceleration for the coming hold period, and what cutting in or staying would be worth during it."""
    cells = bench.cells
    cell = cells.cell[k]
    u = uniform(bench.seed, cell.episode, BV_DRAWS, cell.n_bv)
    cell.bv_maneuver = draw_acceleration(u, car_following(state, bench.environment), bench.environment)
    cells.bv_path[k, cell.n_path] = cell.bv_maneuver
    cell.n_bv += 1
    cell.n_path += 1
    if bench.importance.n_surrogates > 0:
        look_ahead(
            state,
            acceleration(cell.bv_maneuver),
            cell.step,
            bench.environment,
            bench.importance,
            cells.cut_challenge[k],
            cells.stay_challenge[k],
        )


@compiled_inline
def forced_ratio(before: float, after: float, total: float, cut: bool) -> float:
    """q/p of a step under the forced cut-in: P(the step | a cut-in will come)/P(the step).

    ``before`` and ``after`` are the hazards accumulated until and including the step, ``total`` that of the path.
    """
    coming = -math.expm1(before - total)
    if coming <= 0.0:  # nothing was left of the path's hazard: the ratio so far is 0 and stays it
        return 1.0
    if cut:
        return 1.0 / coming
    return -math.expm1(min(after - total, 0.0)) / coming


@compiled_inline
def sampling_hazard(
    hazard: float, critical: bool, method: int, component: int, alpha: FloatArray, q: FloatArray
) -> float:
    """Hazard that the sampler's clock advances by; ``q`` (J,) is q_j(cut_in)."""
    if not critical:
        return hazard
    if method == STEP_MIXTURE:
        mixed = 0.0
        for j in range(q.size):
            mixed += alpha[j] * q[j]
        return -math.log1p(-min(mixed, 1.0))
    if method == EPISODE_MIXTURE and component > 0:
        return -math.log1p(-min(q[component - 1], 1.0))
    return hazard


@compiled_inline
def update_ratios(k: int, cut: bool, p: float, hazard: float, critical: bool, bench: Bench) -> float:
    """Accumulate the likelihood ratios of the maneuver taken; returns q_α/p of the step."""
    scratch, importance = bench.scratch, bench.importance
    cell = bench.cells.cell[k]
    if importance.first == 1:
        scratch.ratio[0] = forced_ratio(cell.hazard, cell.hazard + hazard, cell.hazard_total, cut)
    for j in range(importance.n_surrogates):
        q = scratch.q[j]
        scratch.ratio[importance.first + j] = (q / p if cut else (1.0 - q) / (1.0 - p)) if critical else 1.0
        scratch.challenge[j] = scratch.challenge[j] if critical else 0.0
    return take_in(k, bench)


@compiled_inline
def choose_lane(k: int, state: State, bench: Bench) -> None:
    """Stay or cut in."""
    cells, scratch, environment, importance = bench.cells, bench.scratch, bench.environment, bench.importance
    cell, method = cells.cell[k], importance.method
    wish = opportunity(state, environment)
    hazard = cut_in_hazard(wish, acceptance(state.r2_m, state.r2dot_mps, environment), environment)
    p = -math.expm1(-hazard) if method != NDE else 0.0  # only the likelihood ratios ask for it
    critical = False
    if importance.n_surrogates > 0:
        i = cell.step % environment.numbers.hold_steps
        critical = propose_cut_in(
            p,
            wish,
            cells.cut_challenge[k, i],
            cells.stay_challenge[k, i],
            importance,
            scratch.q,
            scratch.challenge,
        )
    cell.clock += sampling_hazard(hazard, critical, method, cell.component, importance.alpha, scratch.q)
    cut = cell.clock >= cell.target
    sampled = 1.0
    if critical or importance.first == 1:
        sampled = update_ratios(k, cut, p, hazard, critical, bench)
    cell.hazard += hazard
    if cut:
        begin_cut_in(k, cells, state)
    if critical or (method == FORCED and cut):
        cell.n_control += 1
        exposure = p if cut else 1.0 - p
        for j in range(importance.n_surrogates):
            scratch.q[j] = scratch.q[j] if cut else 1.0 - scratch.q[j]
        record_moment(k, state, CUT_IN if cut else STAY, exposure, exposure * sampled, bench)


@compiled_inline
def begin_cut_in(k: int, cells: Cells, state: State) -> None:
    """BV moves to the right lane in this step."""
    cell = cells.cell[k]
    cell.cut_step = cell.step
    cell.cut_r2, cell.cut_r2dot = state.r2_m, state.r2dot_mps
    cells.cut_in[k] = 1
    cells.bv_path[k, cell.n_path] = CUT_IN
    cell.n_path += 1
