"""The compiled passes over all cells between two steps of the world: decide, respond, command, and then judge."""

from __future__ import annotations

from harness.arrays import BoolArray
from harness.compiled import compiled, compiled_inline
from harness.environment.driving import draw_acceleration, free_driving
from harness.episode.after_cut_in import redraw_free
from harness.episode.before_cut_in import choose_lane, redraw_following
from harness.episode.cells import Bench
from harness.episode.record import end_episode
from harness.episode.scripted import hold, repeat_traffic
from harness.outcomes import AV, BV, BV_LV_CONTACT, CRASH, LV, PASSED, RUNNING, TIMEOUT
from harness.random_stream import LV_DRAWS, uniform
from harness.state import State
from harness.vehicles.kinematics import CONTACT_M, gap, next_speed
from harness.vehicles.models import reacting_acceleration, reaction_steps

PASSED_M, PASSED_UNDER_CONTROL_M = 0.0, -10.0
"""R2 at which the AV has passed BV: at once if it holds its speed, with a margin if its controller acts."""


@compiled_inline
def state_of(k: int, bench: Bench) -> State:
    """State of cell ``k`` from the world's positions and speeds."""
    x, v = bench.x, bench.v
    return State(v[k, BV], gap(x[k, LV], x[k, BV]), v[k, LV] - v[k, BV], gap(x[k, BV], x[k, AV]), v[k, BV] - v[k, AV])


@compiled
def decide(bench: Bench) -> None:
    """LV's and BV's maneuvers for the coming step, in every running cell."""
    cells, hold_steps = bench.cells, bench.environment.numbers.hold_steps
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        cells.cut_in[k] = 0
        if cell.row < 0:
            continue
        state = state_of(k, bench)
        if bench.traffic.cut_step.size > 0:
            repeat_traffic(k, state, bench)
            continue
        redraw = cell.step % hold_steps == 0
        if redraw:
            u = uniform(bench.seed, cell.episode, LV_DRAWS, cell.n_lv)
            cell.lv_maneuver = draw_acceleration(u, free_driving(bench.v[k, LV], bench.environment), bench.environment)
            cells.lv_path[k, cell.n_lv] = cell.lv_maneuver
            cell.n_lv += 1
        if cell.cut_step < 0:
            if redraw:
                redraw_following(k, state, bench)
            choose_lane(k, state, bench)
        elif (cell.step - cell.cut_step - 1) % hold_steps == 0:
            redraw_free(k, state, bench)
        hold(k, cells)


@compiled
def respond(bench: Bench) -> None:
    """Acceleration of a built-in AV wherever it has been cut in on; it acts from the step after the cut-in at most."""
    x, v, cells, driver = bench.x, bench.v, bench.cells, bench.driver
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        if cell.row < 0 or cell.cut_step < 0:
            continue
        if cell.step - cell.cut_step > reaction_steps(driver[0], bench.seed, cell.episode):
            cells.acceleration[k, AV] = reacting_acceleration(
                driver[0], cells.acceleration[k, AV], v[k, AV], v[k, BV], gap(x[k, BV], x[k, AV])
            )


@compiled
def command(bench: Bench) -> None:
    """Turn accelerations into the speeds at the end of the step; idle cells stand still."""
    x, v, cells = bench.x, bench.v, bench.cells
    for k in range(cells.cell.size):
        running = cells.cell[k].row >= 0
        for vehicle in range(3):
            a = cells.acceleration[k, vehicle]
            cells.speed[k, vehicle] = next_speed(v[k, vehicle], a) if running else 0.0
            if bench.keep_traces and running:
                here = cells.trace[k, cells.cell[k].step, vehicle]
                here[0], here[1], here[2] = x[k, vehicle], v[k, vehicle], a


@compiled_inline
def outcome_of(k: int, state: State, bench: Bench) -> int:
    """How the episode ends in its present state, or `RUNNING`."""
    cell = bench.cells.cell[k]
    if cell.cut_step >= 0:
        if cell.step == cell.cut_step + 1 and state.r1_m < CONTACT_M:
            return BV_LV_CONTACT  # it touched LV before it had left the lane
        if state.r2_m < CONTACT_M:
            return CRASH
    elif state.r1_m < CONTACT_M:
        return BV_LV_CONTACT
    elif state.r2_m <= bench.passed_m:
        return PASSED
    if cell.step >= bench.environment.numbers.max_steps:
        return TIMEOUT
    return RUNNING


@compiled
def judge(bench: Bench, contact: BoolArray) -> int:
    """After a step: end the episodes that are over, write their rows and idle their cells.

    Parameters
    ----------
    bench : Bench
        ``x``, ``v`` are the state after the step; ``cells.ended`` receives what has ended.
    contact : ndarray of bool, shape (K,)
        The world's own collision flags.

    Returns
    -------
    int
        How many episodes have ended; -1 - k if flag and crash criterion differ in cell k.
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
        outcome = outcome_of(k, state, bench)
        if contact[k] != (outcome in (CRASH, BV_LV_CONTACT)):
            return -1 - k
        if outcome != RUNNING:
            end_episode(k, outcome, ended, bench)
            ended += 1
    return ended
