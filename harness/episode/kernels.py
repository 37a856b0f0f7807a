"""The compiled passes over all cells that make a step: judge, refill, decide, respond, command.

For a built-in AV they are one call (`turn`): with 64 cells, what a call costs before it does anything counts.
"""

from __future__ import annotations

import math

from harness.arrays import FloatArray, RecordArray
from harness.compiled import compiled, compiled_inline
from harness.controllers.protocol import BatchObservation
from harness.environment.driving import Environment, draw_free_driving
from harness.episode.after_cut_in import redraw_free
from harness.episode.before_cut_in import choose_lane, redraw_following
from harness.episode.begin import refill
from harness.episode.cells import DISAGREEING, ENDED, Cells, Exchange, Results, Scratch, Script
from harness.episode.observe import observe
from harness.episode.record import record_episode
from harness.episode.scripted import follow_script, hold
from harness.importance.functions import Importance
from harness.outcomes import AV, BV, BV_LV_CONTACT, CRASH, LV, PASSED, RUNNING, TIMEOUT
from harness.random_stream import LV_DRAWS, uniform
from harness.vehicles.kinematics import CONTACT_M, gap, next_speed
from harness.vehicles.reaction import reacting_acceleration, reaction_steps

PASSED_M, PASSED_UNDER_CONTROL_M = 0.0, -10.0
"""R2 at which the AV has passed BV: at once if it holds its speed, with a margin if its controller acts."""


@compiled_inline
def read_state(k: int, x: FloatArray, v: FloatArray, state: FloatArray) -> None:
    """(v_BV, R1, R1dot, R2, R2dot) of cell ``k`` from positions and speeds (K, 3)."""
    state[0] = v[k, BV]
    state[1], state[2] = gap(x[k, LV], x[k, BV]), v[k, LV] - v[k, BV]
    state[3], state[4] = gap(x[k, BV], x[k, AV]), v[k, BV] - v[k, AV]


@compiled
def decide(
    seed: int,
    x: FloatArray,
    v: FloatArray,
    cells: Cells,
    results: Results,
    scratch: Scratch,
    environment: Environment,
    importance: Importance,
    script: Script,
) -> None:
    """LV's and BV's maneuvers for the coming step, in every running cell.

    Parameters
    ----------
    seed : int
        Campaign seed.
    x, v : ndarray, shape (K, 3)
        Positions (m) and speeds (m/s) of LV, BV, AV as the world reports them.
    """
    hold_steps = environment.numbers[0].hold_steps
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        cells.cut_in[k] = 0
        if cell.row < 0:
            continue
        read_state(k, x, v, scratch.state)
        if script.cut_step.size > 0:
            follow_script(k, hold_steps, cells, scratch, script)
            continue
        redraw = cell.step % hold_steps == 0
        if redraw:
            u = uniform(seed, cell.episode, LV_DRAWS, cell.n_lv)
            cell.lv_maneuver = draw_free_driving(u, v[k, LV], environment)
            cells.lv_path[k, cell.n_lv] = cell.lv_maneuver
            cell.n_lv += 1
        if cell.cut_step < 0:
            if redraw:
                redraw_following(k, seed, cells, scratch, environment, importance)
            choose_lane(k, cells, results, scratch, environment, importance)
        elif (cell.step - cell.cut_step - 1) % hold_steps == 0:
            redraw_free(k, seed, cells, results, scratch, environment, importance)
        hold(k, cells)


@compiled
def respond(seed: int, x: FloatArray, v: FloatArray, cells: Cells, driver: RecordArray) -> None:
    """Acceleration of a built-in AV wherever it has been cut in on; it acts from the step after the cut-in at most."""
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        if cell.row < 0 or cell.cut_step < 0:
            continue
        if cell.step - cell.cut_step > reaction_steps(driver[0], seed, cell.episode):
            cells.acceleration[k, AV] = reacting_acceleration(
                driver[0], cells.acceleration[k, AV], v[k, AV], v[k, BV], gap(x[k, BV], x[k, AV])
            )


@compiled
def command(x: FloatArray, v: FloatArray, cells: Cells, keep_traces: bool) -> None:
    """Turn accelerations into the speeds at the end of the step; idle cells stand still."""
    for k in range(cells.cell.size):
        running = cells.cell[k].row >= 0
        for vehicle in range(3):
            a = cells.acceleration[k, vehicle]
            cells.speed[k, vehicle] = next_speed(v[k, vehicle], a) if running else 0.0
            if keep_traces and running:
                here = cells.trace[2 * k + cells.cell[k].buffer, cells.cell[k].step, vehicle]
                here[0], here[1], here[2] = x[k, vehicle], v[k, vehicle], a


@compiled_inline
def outcome_of(k: int, state: FloatArray, cells: Cells, max_steps: int, passed_m: float) -> int:
    """How the episode ends in its present state, or `RUNNING`."""
    cell = cells.cell[k]
    if cell.cut_step >= 0:
        if cell.step == cell.cut_step + 1 and state[1] < CONTACT_M:
            return BV_LV_CONTACT  # it touched LV before it had left the lane
        if state[3] < CONTACT_M:
            return CRASH
    elif state[1] < CONTACT_M:
        return BV_LV_CONTACT
    elif state[3] <= passed_m:
        return PASSED
    if cell.step >= max_steps:
        return TIMEOUT
    return RUNNING


@compiled
def judge(
    x: FloatArray,
    v: FloatArray,
    cells: Cells,
    results: Results,
    scratch: Scratch,
    exchange: Exchange,
    importance: Importance,
    max_steps: int,
    passed_m: float,
    keep_traces: bool,
) -> None:
    """After a step: end the episodes that are over, write their rows and idle their cells.

    ``x``, ``v`` (K, 3) are the state after the step; ``passed_m`` is the R2 at which the AV has passed. ``exchange``
    receives what ended, and whether the world's own
    collision flags name the same cells.
    """
    exchange.counts[ENDED] = 0
    exchange.counts[DISAGREEING] = -1
    state = scratch.state
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        exchange.ended[k] = RUNNING
        if cell.row < 0:
            continue
        cell.step += 1
        read_state(k, x, v, state)
        if cell.cut_step >= 0 and state[4] < 0.0 and state[3] >= 0.0:
            cell.min_ttc = min(cell.min_ttc, state[3] / -state[4])
        outcome = outcome_of(k, state, cells, max_steps, passed_m)
        if exchange.contact[k] != (outcome in (CRASH, BV_LV_CONTACT)):
            exchange.counts[DISAGREEING] = k
        if outcome == RUNNING:
            continue
        if keep_traces:
            for vehicle in range(3):
                here = cells.trace[2 * k + cell.buffer, cell.step, vehicle]
                here[0], here[1], here[2] = x[k, vehicle], v[k, vehicle], math.nan
        exchange.counts[ENDED] += 1
        exchange.ended[k], exchange.ended_row[k] = outcome, cell.row
        record_episode(k, outcome, x, v, cells, results, importance)
        cell.row = -1
        cell.buffer = 1 - cell.buffer


@compiled
def turn(
    seed: int,
    first_episode: int,
    states: FloatArray,
    x: FloatArray,
    v: FloatArray,
    cells: Cells,
    results: Results,
    scratch: Scratch,
    exchange: Exchange,
    environment: Environment,
    importance: Importance,
    script: Script,
    driver: RecordArray,
    passed_m: float,
    keep_traces: bool,
) -> None:
    """All that lies between two steps of the world, with a built-in AV, or with one that SUMO drives (no ``driver``).

    Parameters
    ----------
    seed, first_episode : int
        Campaign seed, and campaign index of row 0.
    states : ndarray, shape (rows, 5)
        Initial states of the shard.
    x, v : ndarray, shape (K, 3)
        Positions (m) and speeds (m/s) after the last step; refilled cells are overwritten with their placement.
    passed_m : float
        R2 (m) at which the AV has passed.
    """
    max_steps = environment.numbers[0].max_steps
    judge(x, v, cells, results, scratch, exchange, importance, max_steps, passed_m, keep_traces)
    refill(seed, first_episode, states, x, v, cells, exchange, environment, importance, script)
    decide(seed, x, v, cells, results, scratch, environment, importance, script)
    if driver.size > 0:
        respond(seed, x, v, cells, driver)
    command(x, v, cells, keep_traces)


@compiled
def turn_to_controller(
    seed: int,
    first_episode: int,
    states: FloatArray,
    x: FloatArray,
    v: FloatArray,
    cells: Cells,
    results: Results,
    scratch: Scratch,
    exchange: Exchange,
    environment: Environment,
    importance: Importance,
    script: Script,
    passed_m: float,
    keep_traces: bool,
    acts_before_cut_in: bool,
    observation: BatchObservation,
) -> int:
    """The part of `turn` before a controller outside of the kernels acts; `command` is what comes after it.

    Returns
    -------
    int
        Number of AVs that are to act, described in ``observation``.
    """
    for k in range(cells.cell.size):
        exchange.previous[k] = cells.acceleration[k, AV]
    judge(x, v, cells, results, scratch, exchange, importance, environment.numbers[0].max_steps, passed_m, keep_traces)
    refill(seed, first_episode, states, x, v, cells, exchange, environment, importance, script)
    decide(seed, x, v, cells, results, scratch, environment, importance, script)
    return observe(x, v, cells, acts_before_cut_in, exchange.previous, observation)
