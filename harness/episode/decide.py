"""What LV and BV do in the coming step: accelerations drawn at their hold clocks, the cut-in in every step.

Where the traffic is prescribed they repeat it.
"""

from __future__ import annotations

from harness.compiled import compiled, compiled_inline
from harness.episode.cells import Bench, state_of
from harness.episode.critical_moment import begin_cut_in, choose_lane, controlled_draw
from harness.importance.functions import look_ahead
from harness.maneuvers import acceleration
from harness.random_stream import BV_DRAWS, BV_FREE_DRAWS, LV_DRAWS, uniform
from harness.traffic.laws import car_following, draw_acceleration, free_driving
from harness.vocabulary import BV, LV, State


@compiled
def decide(bench: Bench) -> int:
    """Maneuvers of LV and BV in every running cell; returns how many control steps the shard has recorded so far."""
    cells = bench.cells
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        cells.cut_in[k] = 0
        if cell.row < 0:
            continue
        if bench.traffic.cut_step.size > 0:
            repeat_traffic(k, state_of(k, bench), bench)
        else:
            draw_maneuvers(k, state_of(k, bench), bench)
        cells.acceleration[k, LV] = acceleration(cell.lv_maneuver)
        cells.acceleration[k, BV] = acceleration(cell.bv_maneuver)
    return int(bench.results.moment_count[0])


@compiled_inline
def draw_maneuvers(k: int, state: State, bench: Bench) -> None:
    """Redraw where a hold period begins; before the cut-in, stay or cut in."""
    hold_steps = bench.environment.numbers.hold_steps
    cell = bench.cells.cell[k]
    redraw = cell.step % hold_steps == 0
    if redraw:
        u = uniform(bench.seed, cell.episode, LV_DRAWS, cell.n_lv)
        take_lv(k, draw_acceleration(u, free_driving(bench.v[k, LV], bench.environment), bench.environment), bench)
    if cell.cut_step < 0:
        if redraw:
            redraw_following(k, state, bench)
        if bench.environment.lateral.cumulative.size > 0:
            note_onset(k, state, bench)
            if cell.step == cell.planned:  # it was decided before anybody could see it
                begin_cut_in(k, state, bench)
        else:
            choose_lane(k, state, bench)
    elif (cell.step - cell.cut_step - 1) % hold_steps == 0:
        redraw_free(k, state, bench)


@compiled_inline
def redraw_following(k: int, state: State, bench: Bench) -> None:
    """BV's acceleration behind LV, and what cutting in or staying would be worth during the coming hold period."""
    cells = bench.cells
    cell = cells.cell[k]
    u = uniform(bench.seed, cell.episode, BV_DRAWS, cell.n_bv)
    take_bv(k, draw_acceleration(u, car_following(state, bench.environment), bench.environment), bench)
    cell.n_bv += 1
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
def redraw_free(k: int, state: State, bench: Bench) -> None:
    """BV's acceleration for the coming hold period after its cut-in."""
    cell = bench.cells.cell[k]
    u = uniform(bench.seed, cell.episode, BV_FREE_DRAWS, cell.n_bv_free)
    cell.n_bv_free += 1
    if bench.importance.n_surrogates > 0:
        take_bv(k, controlled_draw(k, u, state, bench), bench)
    else:
        take_bv(k, draw_acceleration(u, free_driving(state.v_bv_mps, bench.environment), bench.environment), bench)


@compiled_inline
def repeat_traffic(k: int, state: State, bench: Bench) -> None:
    """LV and BV repeat a path of the pool, cut-in included."""
    traffic, hold_steps = bench.traffic, bench.environment.numbers.hold_steps
    cell = bench.cells.cell[k]
    redraw = cell.step % hold_steps == 0
    if redraw:
        take_lv(k, traffic.lv[cell.row, cell.n_lv], bench)
    since = cell.step - cell.cut_step - 1
    if (cell.cut_step < 0 and redraw) or (cell.cut_step >= 0 and since % hold_steps == 0):
        take_bv(k, traffic.bv[cell.row, cell.n_path], bench)
    if bench.traffic.lead.size > 0:
        note_onset(k, state, bench)
    if cell.step == traffic.cut_step[cell.row]:
        begin_cut_in(k, state, bench)
        cell.n_control += 1


@compiled_inline
def note_onset(k: int, state: State, bench: Bench) -> None:
    """Keep the state in which BV begins to move sideways."""
    cell = bench.cells.cell[k]
    if cell.step == cell.onset_step:
        cell.onset_r2, cell.onset_r2dot = state.r2_m, state.r2dot_mps


@compiled_inline
def take_lv(k: int, maneuver: int, bench: Bench) -> None:
    """LV holds a maneuver from now on."""
    cell = bench.cells.cell[k]
    cell.lv_maneuver = maneuver
    bench.cells.lv_path[k, cell.n_lv] = maneuver
    cell.n_lv += 1


@compiled_inline
def take_bv(k: int, maneuver: int, bench: Bench) -> None:
    """BV holds a maneuver from now on."""
    cell = bench.cells.cell[k]
    cell.bv_maneuver = maneuver
    bench.cells.bv_path[k, cell.n_path] = maneuver
    cell.n_path += 1
