"""Maneuvers of LV and BV in every step of tests whose cut-in is drawn in the loop.

Accelerations are drawn at hold clocks, the cut-in in every step, by importance functions where a moment is critical.
Their likelihood ratios are in `likelihood_ratio`.
"""

from __future__ import annotations

import math

from harness.compiled import compiled, compiled_inline
from harness.families.cut_in import laws
from harness.families.cut_in.laws import acceleration, draw_acceleration
from harness.families.cut_in.nade.cells import NadeKernel
from harness.families.cut_in.nade.challenge import remaining_level
from harness.families.cut_in.nade.functions import challenges_nobody, look_ahead, propose_acceleration, propose_cut_in
from harness.families.cut_in.nade.likelihood_ratio import log_mixture, record_acceleration, record_lane
from harness.families.cut_in.path import state_of, walk, weigh_cut_ins
from harness.families.cut_in.script import RIGHT
from harness.families.cut_in.vocabulary import CUT_IN, N_ACCELERATIONS, State
from harness.loop.cells import KernelState
from harness.loop.repeat import note_event
from harness.random_stream import BV_DRAWS, BV_FREE_DRAWS, LV_DRAWS, uniform
from harness.random_stream import EVENT as CUT_IN_STREAM
from harness.vehicles.kinematics import next_speed
from harness.vocabulary import BV, LV, FloatArray

COMPONENT_DRAW, CUT_IN_DRAW = 0, 1
"""Indices within the cut-in stream."""


@compiled
def decide(kernel: KernelState, nade: NadeKernel, placed: int) -> None:
    """Draw what LV and BV do in the coming step, in every cell; in the first ``placed`` cells tests begin."""
    cells = kernel.cells
    for i in range(placed):
        begin(cells.placed[i], kernel, nade)
    for k in range(cells.cell.size):
        if cells.cell[k].row < 0:
            continue
        draw_maneuvers(k, state_of(kernel.x[k], kernel.v[k]), kernel, nade)
        draws = nade.cell[k]
        cells.speed[k, LV] = next_speed(kernel.v[k, LV], acceleration(draws.lv_maneuver))
        cells.speed[k, BV] = next_speed(kernel.v[k, BV], acceleration(draws.bv_maneuver))


@compiled
def finish(kernel: KernelState, nade: NadeKernel, n: int) -> None:
    """Write the weights of the ``n`` tests that have just ended to their rows."""
    for i in range(n):
        k, row = kernel.cells.ended[i], kernel.cells.ended_row[i]
        log_sampled = nade.cell[k].log_sampled
        if nade.importance.mixes_episodes:
            log_sampled = log_mixture(nade.importance.alpha, nade.drawn.log_q[row])
        kernel.episode[row].log_weight = -log_sampled  # exactly 0 without control


@compiled_inline
def draw_maneuvers(k: int, state: State, kernel: KernelState, nade: NadeKernel) -> None:
    """Redraw where a hold period begins; before the cut-in, stay or cut in."""
    hold_steps = nade.environment.numbers.hold_steps
    cell = kernel.cells.cell[k]
    period, redraw = cell.step // hold_steps, cell.step % hold_steps == 0
    if redraw:
        u = uniform(kernel.seed, cell.episode, LV_DRAWS, period)
        maneuver = laws.drive_freely(u, kernel.v[k, LV], nade.environment)
        nade.cell[k].lv_maneuver = nade.drawn.lv_path[cell.row, period] = maneuver
        nade.drawn.n_lv[cell.row] = period + 1
    if cell.event_step < 0:
        if redraw:
            redraw_following(k, period, state, kernel, nade)
        choose_lane(k, state, kernel, nade)
        return
    since = cell.step - cell.event_step - 1
    if since % hold_steps == 0:
        redraw_free(k, since // hold_steps, state, kernel, nade)


@compiled_inline
def redraw_following(k: int, period: int, state: State, kernel: KernelState, nade: NadeKernel) -> None:
    """BV's acceleration behind LV, and what cutting in or staying would be worth during the coming hold period."""
    cell, draws = kernel.cells.cell[k], nade.cell[k]
    u = uniform(kernel.seed, cell.episode, BV_DRAWS, period)
    draws.bv_maneuver = draw_acceleration(u, laws.car_following(state, nade.environment), nade.environment)
    add_to_path(cell.row, draws.bv_maneuver, nade)
    if nade.importance.n_surrogates > 0:
        a, cutting, staying = acceleration(draws.bv_maneuver), nade.cut_challenge[k], nade.stay_challenge[k]
        look_ahead(state, a, cell.step, nade.environment, nade.importance, cutting, staying)


@compiled_inline
def redraw_free(k: int, period: int, state: State, kernel: KernelState, nade: NadeKernel) -> None:
    """BV's acceleration for a hold period after its cut-in."""
    cell, draws = kernel.cells.cell[k], nade.cell[k]
    u = uniform(kernel.seed, cell.episode, BV_FREE_DRAWS, period)
    if nade.importance.n_surrogates > 0:
        draws.bv_maneuver = controlled_draw(k, u, state, kernel, nade)
    else:
        draws.bv_maneuver = laws.drive_freely(u, state.v_bv_mps, nade.environment)
    add_to_path(cell.row, draws.bv_maneuver, nade)


@compiled_inline
def add_to_path(row: int, maneuver: int, nade: NadeKernel) -> None:
    """Append a maneuver of BV to the path of a row's test."""
    nade.drawn.bv_path[row, nade.drawn.n_bv[row]] = maneuver
    nade.drawn.n_bv[row] += 1


@compiled_inline
def begin(k: int, kernel: KernelState, nade: NadeKernel) -> None:
    """Draw when BV will cut in, on the clock of hazards; a forced cut-in on its path."""
    cell, draws, environment, importance = kernel.cells.cell[k], nade.cell[k], nade.environment, nade.importance
    test = kernel.episode[cell.row]
    draws.lv_maneuver = draws.bv_maneuver = 0
    draws.clock = draws.hazard = draws.log_sampled = 0.0
    u = uniform(kernel.seed, cell.episode, CUT_IN_STREAM, CUT_IN_DRAW)
    draws.target = -math.log1p(-u)
    if importance.n_forced == 0:
        return
    path, max_steps = nade.scratch.path, environment.numbers.max_steps
    steps = walk(nade.states[cell.row], kernel.seed, cell.episode, max_steps, True, environment, path)
    draws.hazard_total = weigh_cut_ins(steps, environment, path)
    p_event = -math.expm1(-draws.hazard_total)
    test.log_p_event = math.log(p_event)
    test.component = draw_component(uniform(kernel.seed, cell.episode, CUT_IN_STREAM, COMPONENT_DRAW), importance.alpha)
    if test.component == 0:
        draws.target = min(-math.log1p(-u * p_event), draws.hazard_total)


@compiled_inline
def draw_component(u: float, alpha: FloatArray) -> int:
    """Index of the importance function that this episode follows."""
    total = 0.0
    for j in range(alpha.size - 1):
        total += alpha[j]
        if u < total:
            return j
    return alpha.size - 1


@compiled_inline
def choose_lane(k: int, state: State, kernel: KernelState, nade: NadeKernel) -> None:
    """Stay or cut in."""
    scratch, environment, importance = nade.scratch, nade.environment, nade.importance
    cell, draws = kernel.cells.cell[k], nade.cell[k]
    wish = laws.opportunity(state, environment)
    hazard = laws.cut_in_hazard(wish, laws.acceptance(state.r2_m, state.r2dot_mps, environment), environment)
    p = -math.expm1(-hazard) if importance.alpha.size > 0 else 0.0  # only the likelihood ratios ask for it
    critical = False
    if importance.n_surrogates > 0:
        i = cell.step % environment.numbers.hold_steps
        cut_challenge, stay_challenge = nade.cut_challenge[k, i], nade.stay_challenge[k, i]
        critical = propose_cut_in(p, wish, cut_challenge, stay_challenge, importance, scratch.q, scratch.challenge)
    component = kernel.episode[cell.row].component
    if critical and component != 0:
        q = sampled_probability(component, importance.alpha, scratch.q)
        draws.clock += -math.log1p(-min(q, 1.0))
    else:
        draws.clock += hazard
    cut = draws.clock >= draws.target
    record_lane(k, state, cut, p, hazard, critical, kernel, nade)
    if cut:
        note_event(k, kernel)
        kernel.cells.lane[k, BV] = RIGHT
        add_to_path(cell.row, CUT_IN, nade)


@compiled_inline
def sampled_probability(component: int, alpha: FloatArray, q: FloatArray) -> float:
    """Probability of a maneuver under the episode's importance function, or the step mixture of all, ``q`` (J,).

    Component 0 is the forced cut-in, which leaves maneuvers to traffic; in a step mixture it is -1.
    """
    if component > 0:
        return float(q[component - 1])
    mixed = 0.0
    for j in range(q.size):
        mixed += alpha[j] * q[j]
    return mixed


@compiled_inline
def controlled_draw(k: int, u: float, state: State, kernel: KernelState, nade: NadeKernel) -> int:
    """Acceleration index at a redraw time after the cut-in, which may be critical."""
    scratch, environment, importance = nade.scratch, nade.environment, nade.importance
    cell, p, q = kernel.cells.cell[k], scratch.p, scratch.q_acceleration
    law = laws.free_driving(state.v_bv_mps, environment)
    levels = importance.harmless.shape[1] - 1
    level = remaining_level(cell.step, environment.numbers.max_steps, importance.steps_per_level, levels)
    if challenges_nobody(state, level, importance):
        return draw_acceleration(u, law, environment)
    laws.acceleration_pmf(law, environment, p)
    if not propose_acceleration(state, level, p, importance, q, scratch.challenge):
        return draw_acceleration(u, law, environment)
    component = kernel.episode[cell.row].component
    if component != 0:
        maneuver = draw_from(u, component, importance.alpha, q)
    else:
        maneuver = draw_acceleration(u, law, environment)
    record_acceleration(k, state, maneuver, kernel, nade)
    return maneuver


@compiled_inline
def draw_from(u: float, component: int, alpha: FloatArray, q: FloatArray) -> int:
    """Acceleration index by inversion of `sampled_probability`; ``q`` (J, 31)."""
    total = 0.0
    last = 0
    for m in range(N_ACCELERATIONS):
        probability = sampled_probability(component, alpha, q[:, m])
        if probability > 0.0:
            last = m
            total += probability
            if u < total:
                return m
    return last
