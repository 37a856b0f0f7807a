"""What LV and BV do: where a test begins, what is drawn for it, and their maneuvers in every step.

Accelerations are drawn at hold clocks, the cut-in in every step, by importance functions where a moment is critical;
where the traffic is prescribed they repeat it. What that is worth: `harness.families.cut_in.nade.likelihood_ratio`.
"""

from __future__ import annotations

import math

from harness.compiled import compiled, compiled_inline
from harness.families.cut_in import laws
from harness.families.cut_in.lateral import draw_lead, onset_of
from harness.families.cut_in.laws import acceleration, draw_acceleration
from harness.families.cut_in.nade.challenge import remaining_level
from harness.families.cut_in.nade.functions import challenges_nobody, look_ahead, propose_acceleration, propose_cut_in
from harness.families.cut_in.nade.likelihood_ratio import record_acceleration, record_lane
from harness.families.cut_in.path import place, state_of, walk, weigh_cut_ins
from harness.loop.cells import KernelState
from harness.loop.drive import command, drive_av
from harness.random_stream import BV_DRAWS, BV_FREE_DRAWS, LV_DRAWS, uniform
from harness.random_stream import CUT_IN as CUT_IN_STREAM
from harness.vocabulary import AV, BV, CUT_IN, LV, N_ACCELERATIONS, FloatArray, State


@compiled
def decide(kernel: KernelState, given: int) -> int:
    """Begin episodes in idle cells (`refill`); maneuvers of LV and BV, and of the AV if it is built in, in every cell.

    Returns how many episodes have begun.
    """
    cells, begun = kernel.cells, refill(kernel, given)
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        cells.cut_in[k] = 0
        if cell.row < 0:
            continue
        state = state_of(kernel.x[k], kernel.v[k])
        if kernel.traffic.cut_step.size > 0:
            repeat_traffic(k, state, kernel)
        else:
            draw_maneuvers(k, state, kernel)
        cells.acceleration[k, LV] = acceleration(cell.lv_maneuver)
        cells.acceleration[k, BV] = acceleration(cell.bv_maneuver)
    if not kernel.asks_controller:
        if kernel.driver.size > 0:
            drive_av(kernel)
        command(kernel)
    return begun


@compiled_inline
def draw_maneuvers(k: int, state: State, kernel: KernelState) -> None:
    """Redraw where a hold period begins; before the cut-in, stay or cut in."""
    hold_steps = kernel.environment.numbers.hold_steps
    cell = kernel.cells.cell[k]
    redraw = cell.step % hold_steps == 0
    if redraw:
        u = uniform(kernel.seed, cell.episode, LV_DRAWS, cell.n_lv)
        take_lv(k, laws.drive_freely(u, kernel.v[k, LV], kernel.environment), kernel)
    if cell.cut_step < 0:
        if redraw:
            redraw_following(k, state, kernel)
        if not may_show(kernel):
            choose_lane(k, state, kernel)
            return
        note_onset(k, state, kernel)
        if cell.step == cell.planned:  # it was decided before anybody could see it
            begin_cut_in(k, state, kernel)
    elif (cell.step - cell.cut_step - 1) % hold_steps == 0:
        redraw_free(k, state, kernel)


@compiled_inline
def redraw_following(k: int, state: State, kernel: KernelState) -> None:
    """BV's acceleration behind LV, and what cutting in or staying would be worth during the coming hold period."""
    cells = kernel.cells
    cell = cells.cell[k]
    u = uniform(kernel.seed, cell.episode, BV_DRAWS, cell.n_bv)
    take_bv(k, draw_acceleration(u, laws.car_following(state, kernel.environment), kernel.environment), kernel)
    cell.n_bv += 1
    if kernel.importance.n_surrogates > 0:
        a, cutting, staying = acceleration(cell.bv_maneuver), cells.cut_challenge[k], cells.stay_challenge[k]
        look_ahead(state, a, cell.step, kernel.environment, kernel.importance, cutting, staying)


@compiled_inline
def redraw_free(k: int, state: State, kernel: KernelState) -> None:
    """BV's acceleration for the coming hold period after its cut-in."""
    cell = kernel.cells.cell[k]
    u = uniform(kernel.seed, cell.episode, BV_FREE_DRAWS, cell.n_bv_free)
    cell.n_bv_free += 1
    if kernel.importance.n_surrogates > 0:
        take_bv(k, controlled_draw(k, u, state, kernel), kernel)
    else:
        take_bv(k, laws.drive_freely(u, state.v_bv_mps, kernel.environment), kernel)


@compiled_inline
def repeat_traffic(k: int, state: State, kernel: KernelState) -> None:
    """LV and BV repeat a path of the pool, cut-in included."""
    traffic, hold_steps = kernel.traffic, kernel.environment.numbers.hold_steps
    cell = kernel.cells.cell[k]
    redraw = cell.step % hold_steps == 0
    if redraw:
        take_lv(k, traffic.lv[cell.row, cell.n_lv], kernel)
    since = cell.step - cell.cut_step - 1
    if (cell.cut_step < 0 and redraw) or (cell.cut_step >= 0 and since % hold_steps == 0):
        take_bv(k, traffic.bv[cell.row, cell.n_path], kernel)
    note_onset(k, state, kernel)
    if cell.step == traffic.cut_step[cell.row]:
        begin_cut_in(k, state, kernel)
        cell.n_control += 1


@compiled_inline
def note_onset(k: int, state: State, kernel: KernelState) -> None:
    """Keep the state in which BV begins to move sideways."""
    cell = kernel.cells.cell[k]
    if cell.step == cell.onset_step:
        cell.onset_r2, cell.onset_r2dot = state.r2_m, state.r2dot_mps


@compiled_inline
def take_lv(k: int, maneuver: int, kernel: KernelState) -> None:
    """LV holds a maneuver from now on."""
    cell = kernel.cells.cell[k]
    cell.lv_maneuver = maneuver
    kernel.cells.lv_path[k, cell.n_lv] = maneuver
    cell.n_lv += 1


@compiled_inline
def take_bv(k: int, maneuver: int, kernel: KernelState) -> None:
    """BV holds a maneuver from now on."""
    cell = kernel.cells.cell[k]
    cell.bv_maneuver = maneuver
    kernel.cells.bv_path[k, cell.n_path] = maneuver
    cell.n_path += 1


COMPONENT_DRAW, CUT_IN_DRAW = 0, 1
"""Indices within the cut-in stream."""


@compiled_inline
def may_show(kernel: KernelState) -> bool:
    """Whether cut-ins can be seen before they happen, so that they have to be drawn when the test begins."""
    return bool(kernel.environment.lateral.cumulative.size > 1)


@compiled_inline
def refill(kernel: KernelState, given: int) -> int:
    """Give every idle cell the next episode of the shard, of which ``given`` rows have been given before.

    The world's ``x`` and ``v`` receive their placement, ``cells.placed`` their cells; returns how many there are.
    """
    n = 0
    for k in range(kernel.cells.cell.size):
        if given + n == kernel.states.size:
            break
        if kernel.cells.cell[k].row < 0:
            place(kernel.states[given + n], kernel.x[k], kernel.v[k])
            begin_cell(k, given + n, kernel)
            kernel.cells.placed[n] = k
            n += 1
    return n


@compiled_inline
def begin_cell(k: int, row: int, kernel: KernelState) -> None:
    """Reset cell ``k`` for the episode of a row."""
    cells, episode = kernel.cells, kernel.first_episode + row
    cell = cells.cell[k]
    cell.row, cell.episode, cell.step, cell.cut_step, cell.component = row, episode, 0, -1, -1
    cell.planned, cell.lead, cell.onset_step = -1, 0, -1
    cell.cruises, cell.took_over_step, cell.asked_to_speed_up = kernel.av_cruises, -1, 0
    cell.set_speed = kernel.v[k, AV]
    cell.announced_index = kernel.traffic.announced_index[row] if kernel.traffic.announced_index.size > 0 else episode
    cell.motion_hash = 0
    cell.lv_maneuver = cell.bv_maneuver = cell.n_lv = cell.n_bv = cell.n_bv_free = cell.n_path = cell.n_control = 0
    cell.clock = cell.hazard = cell.log_sampled = 0.0
    cell.hazard_total = cell.log_p_cut_in = math.nan
    cell.min_ttc = cell.danger = math.inf
    cell.cut_r2 = cell.cut_r2dot = cell.onset_r2 = cell.onset_r2dot = math.nan
    cell.av_start = kernel.x[k, AV]
    cells.acceleration[k, AV] = 0.0
    cells.log_ratio[k, :] = 0.0
    cells.martingale[k, :] = 0.0
    if kernel.traffic.cut_step.size > 0:
        begin_prescribed(k, row, kernel)
    else:
        begin_drawn(k, row, kernel)


@compiled_inline
def begin_prescribed(k: int, row: int, kernel: KernelState) -> None:
    """What is known of a test whose traffic is prescribed."""
    cell, traffic = kernel.cells.cell[k], kernel.traffic
    cell.component, cell.log_sampled = traffic.stratum[row], -traffic.log_weight[row]
    if kernel.importance.n_forced == 1:  # a forced cut-in whose path has been walked by the AV itself
        cell.log_p_cut_in, kernel.cells.log_ratio[k, 0] = traffic.log_weight[row], -traffic.log_weight[row]
    if traffic.cut_step[row] >= 0:
        plan_cut_in(k, traffic.cut_step[row], traffic.lead[row], kernel)


@compiled_inline
def begin_drawn(k: int, row: int, kernel: KernelState) -> None:
    """Draw when BV will cut in, on the clock of hazards; a forced cut-in, or one that shows itself, on its path."""
    cell, environment, importance = kernel.cells.cell[k], kernel.environment, kernel.importance
    forced = importance.n_forced == 1
    if importance.mixes_episodes:
        u = uniform(kernel.seed, cell.episode, CUT_IN_STREAM, COMPONENT_DRAW)
        cell.component = draw_component(u, importance.alpha)
        forced = cell.component == 0
    u = uniform(kernel.seed, cell.episode, CUT_IN_STREAM, CUT_IN_DRAW)
    cell.target = -math.log1p(-u)
    if importance.n_forced == 0 and not may_show(kernel):
        return
    path, max_steps = kernel.scratch.path, environment.numbers.max_steps
    steps = walk(kernel.states[row], kernel.seed, cell.episode, 0, max_steps, True, environment, path)
    hazard_total = weigh_cut_ins(steps, environment, path)
    if importance.n_forced == 1:
        p_cut_in = -math.expm1(-hazard_total)
        cell.hazard_total, cell.log_p_cut_in = hazard_total, math.log(p_cut_in)
        if forced:
            cell.log_sampled = -cell.log_p_cut_in
            cell.target = min(-math.log1p(-u * p_cut_in), hazard_total)
    if may_show(kernel):
        look_for_cut_in(k, steps, kernel)


@compiled_inline
def look_for_cut_in(k: int, steps: int, kernel: KernelState) -> None:
    """Plan the cut-in that the cell's clock leads to on a path that has been walked, if there is one."""
    cell, hazard = kernel.cells.cell[k], kernel.scratch.path.hazard
    for step in range(steps):
        cell.clock += hazard[step]
        cut = cell.clock >= cell.target
        if kernel.importance.n_forced == 1:
            state = state_of(kernel.scratch.path.x[step], kernel.scratch.path.v[step])
            record_lane(k, step, state, cut, -math.expm1(-hazard[step]), hazard[step], False, kernel)
        if cut:
            lead = draw_lead(step, kernel.seed, cell.episode, kernel.environment.lateral)
            plan_cut_in(k, step, lead, kernel)
            return


@compiled_inline
def plan_cut_in(k: int, cut: int, lead: int, kernel: KernelState) -> None:
    """BV will cut in in a step, and show it some steps earlier."""
    cell = kernel.cells.cell[k]
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


@compiled_inline
def choose_lane(k: int, state: State, kernel: KernelState) -> None:
    """Stay or cut in."""
    cells, scratch, environment, importance = kernel.cells, kernel.scratch, kernel.environment, kernel.importance
    cell = cells.cell[k]
    wish = laws.opportunity(state, environment)
    hazard = laws.cut_in_hazard(wish, laws.acceptance(state.r2_m, state.r2dot_mps, environment), environment)
    p = -math.expm1(-hazard) if importance.alpha.size > 0 else 0.0  # only the likelihood ratios ask for it
    critical = False
    if importance.n_surrogates > 0:
        i = cell.step % environment.numbers.hold_steps
        cut_challenge, stay_challenge = cells.cut_challenge[k, i], cells.stay_challenge[k, i]
        critical = propose_cut_in(p, wish, cut_challenge, stay_challenge, importance, scratch.q, scratch.challenge)
    if critical and (importance.mixes_steps or cell.component > 0):
        q = sampled_probability(cell.component, importance.alpha, scratch.q)
        cell.clock += -math.log1p(-min(q, 1.0))
    else:
        cell.clock += hazard
    cut = cell.clock >= cell.target
    record_lane(k, cell.step, state, cut, p, hazard, critical, kernel)
    if cut:
        begin_cut_in(k, state, kernel)


@compiled_inline
def begin_cut_in(k: int, state: State, kernel: KernelState) -> None:
    """BV moves to the right lane in this step."""
    cell = kernel.cells.cell[k]
    cell.cut_step = cell.step
    if cell.onset_step < 0:
        cell.planned, cell.onset_step = cell.step, cell.step
    cell.cut_r2, cell.cut_r2dot = state.r2_m, state.r2dot_mps
    kernel.cells.cut_in[k] = 1
    kernel.cells.bv_path[k, cell.n_path] = CUT_IN
    cell.n_path += 1


@compiled_inline
def sampled_probability(component: int, alpha: FloatArray, q: FloatArray) -> float:
    """Probability of a maneuver under the episode's importance function, or the step mixture of all, ``q`` (J,)."""
    if component > 0:
        return float(q[component - 1])
    mixed = 0.0
    for j in range(q.size):
        mixed += alpha[j] * q[j]
    return mixed


@compiled_inline
def controlled_draw(k: int, u: float, state: State, kernel: KernelState) -> int:
    """Acceleration index at a redraw time after the cut-in, which may be critical."""
    scratch, environment, importance = kernel.scratch, kernel.environment, kernel.importance
    cell, p, q = kernel.cells.cell[k], scratch.p, scratch.q_acceleration
    law = laws.free_driving(state.v_bv_mps, environment)
    levels = importance.harmless.shape[1] - 1
    level = remaining_level(cell.step, environment.numbers.max_steps, importance.steps_per_level, levels)
    if challenges_nobody(state, level, importance):
        return draw_acceleration(u, law, environment)
    laws.acceleration_pmf(law, environment, p)
    if not propose_acceleration(state, level, p, importance, q, scratch.challenge):
        return draw_acceleration(u, law, environment)
    if importance.mixes_steps or cell.component > 0:
        maneuver = draw_from(u, cell.component, importance.alpha, q)
    else:
        maneuver = draw_acceleration(u, law, environment)
    record_acceleration(k, state, maneuver, kernel)
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
