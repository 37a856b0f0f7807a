"""Critical moments: BV's maneuver is drawn from an importance function, and its likelihood ratios are taken down."""

from __future__ import annotations

import math

from harness.compiled import compiled_inline
from harness.episode.cells import Bench
from harness.importance.functions import (
    accumulate,
    challenges_nobody,
    forced_ratio,
    propose_acceleration,
    propose_cut_in,
)
from harness.maneuvers import CUT_IN, N_ACCELERATIONS, STAY
from harness.traffic.laws import (
    acceleration_pmf,
    acceptance,
    cut_in_hazard,
    draw_acceleration,
    free_driving,
    opportunity,
)
from harness.vocabulary import EPISODE_MIXTURE, FORCED, NDE, STEP_MIXTURE, FloatArray, State


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
        cut_challenge, stay_challenge = cells.cut_challenge[k, i], cells.stay_challenge[k, i]
        critical = propose_cut_in(p, wish, cut_challenge, stay_challenge, importance, scratch.q, scratch.challenge)
    cell.clock += sampling_hazard(hazard, critical, method, cell.component, importance.alpha, scratch.q)
    cut = cell.clock >= cell.target
    take_down(k, cell.step, state, cut, p, hazard, critical, bench)
    if cut:
        begin_cut_in(k, state, bench)


@compiled_inline
def take_down(
    k: int, step: int, state: State, cut: bool, p: float, hazard: float, critical: bool, bench: Bench
) -> None:
    """Likelihood ratios of having stayed or cut in, and the moment if it was one of control."""
    cell, scratch, importance = bench.cells.cell[k], bench.scratch, bench.importance
    sampled = 1.0
    if critical or importance.first == 1:
        sampled = update_ratios(k, cut, p, hazard, critical, bench)
    cell.hazard += hazard
    if critical or (importance.method == FORCED and cut):
        cell.n_control += 1
        exposure = p if cut else 1.0 - p
        for j in range(importance.n_surrogates):
            scratch.q[j] = scratch.q[j] if cut else 1.0 - scratch.q[j]
        record_moment(k, step, state, CUT_IN if cut else STAY, exposure, exposure * sampled, bench)


@compiled_inline
def begin_cut_in(k: int, state: State, bench: Bench) -> None:
    """BV moves to the right lane in this step."""
    cell = bench.cells.cell[k]
    cell.cut_step = cell.step
    if cell.onset_step < 0:
        cell.planned, cell.onset_step = cell.step, cell.step
    cell.cut_r2, cell.cut_r2dot = state.r2_m, state.r2dot_mps
    bench.cells.cut_in[k] = 1
    bench.cells.bv_path[k, cell.n_path] = CUT_IN
    cell.n_path += 1


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
    """Accumulate the likelihood ratios of staying or cutting in; returns q_α/p of the step."""
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
def controlled_draw(k: int, u: float, state: State, bench: Bench) -> int:
    """Acceleration index at a redraw time after the cut-in, which may be critical."""
    scratch, environment, importance = bench.scratch, bench.environment, bench.importance
    cell, p, q = bench.cells.cell[k], scratch.p, scratch.q_acceleration
    law = free_driving(state.v_bv_mps, environment)
    if challenges_nobody(state, importance):
        return draw_acceleration(u, law, environment)
    acceleration_pmf(law, environment, p)
    if not propose_acceleration(state, p, importance, q, scratch.challenge):
        return draw_acceleration(u, law, environment)
    if importance.method == STEP_MIXTURE or cell.component > 0:
        maneuver = draw_from(u, importance.method, cell.component, importance.alpha, q)
    else:
        maneuver = draw_acceleration(u, law, environment)
    if importance.first == 1:
        scratch.ratio[0] = 1.0
    for j in range(importance.n_surrogates):
        scratch.q[j] = q[j, maneuver]
        scratch.ratio[importance.first + j] = q[j, maneuver] / p[maneuver]
    sampled = take_in(k, bench)
    cell.n_control += 1
    record_moment(k, cell.step, state, maneuver, p[maneuver], p[maneuver] * sampled, bench)
    return maneuver


@compiled_inline
def draw_from(u: float, method: int, component: int, alpha: FloatArray, q: FloatArray) -> int:
    """Acceleration index from the step mixture, or from the episode's component, by inversion; ``q`` (J, 31)."""
    total = 0.0
    last = 0
    for m in range(N_ACCELERATIONS):
        if method == STEP_MIXTURE:
            probability = 0.0
            for j in range(q.shape[0]):
                probability += alpha[j] * q[j, m]
        else:
            probability = q[component - 1, m]
        if probability > 0.0:
            last = m
            total += probability
            if u < total:
                return m
    return last


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
def record_moment(k: int, step: int, state: State, maneuver: int, p: float, q_sampled: float, bench: Bench) -> None:
    """Keep a control step, if the campaign keeps that many of an episode."""
    results, scratch = bench.results, bench.scratch
    cell = bench.cells.cell[k]
    if cell.n_control > results.moment_limit:
        return
    i = results.moment_count[0]
    moment = results.moment[i]
    moment.row, moment.step, moment.maneuver = cell.row, step, maneuver
    moment.v_bv_mps, moment.r1_m, moment.r1dot_mps = state.v_bv_mps, state.r1_m, state.r1dot_mps
    moment.r2_m, moment.r2dot_mps = state.r2_m, state.r2dot_mps
    moment.p, moment.q_sampled = p, q_sampled
    for j in range(scratch.q.size):
        results.moment_q[i, j] = scratch.q[j]
        results.moment_v[i, j] = scratch.challenge[j]
    results.moment_count[0] = i + 1
