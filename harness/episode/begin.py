"""Begin episodes: place vehicles, draw what is drawn once per episode, and look at the path ahead where needed."""

from __future__ import annotations

import math

from harness.arrays import FloatArray
from harness.compiled import compiled, compiled_inline, compiled_threads
from harness.environment.cut_in import acceptance, cut_in_hazard, opportunity
from harness.environment.driving import Environment, draw_car_following, draw_free_driving
from harness.episode.cells import GIVEN, PLACED, Cells, Exchange, Script
from harness.importance.functions import Importance
from harness.maneuvers import acceleration
from harness.outcomes import AV, BV, EPISODE_MIXTURE, FORCED, LV, SHELLS
from harness.random_stream import BV_DRAWS, CUT_IN, LV_DRAWS, uniform
from harness.vehicles.kinematics import CONTACT_M, VEHICLE_LENGTH_M, gap, next_position, next_speed

AV_START_M = 100.0
COMPONENT_DRAW, CUT_IN_DRAW = 0, 1
"""Indices within the cut-in stream."""


@compiled_inline
def place(state: FloatArray, x: FloatArray, v: FloatArray) -> None:
    """Positions and speeds (3,) of LV, BV, AV from an initial state (5,): v_BV, R1, R1dot, R2, R2dot."""
    x[AV] = AV_START_M
    x[BV] = AV_START_M + VEHICLE_LENGTH_M + state[3]
    x[LV] = x[BV] + VEHICLE_LENGTH_M + state[1]
    v[BV] = state[0]
    v[LV] = max(state[0] + state[2], 0.0)
    v[AV] = state[0] - state[4]


@compiled_inline
def path_hazard(seed: int, episode: int, x0: FloatArray, v0: FloatArray, environment: Environment) -> tuple[float, int]:
    """Cumulative cut-in hazard of the path that LV and BV take when no cut-in happens, and its length in steps.

    The path does not depend on the AV (which keeps its speed), so it can be walked before the episode is run: with the
    same draws and the same arithmetic as the episode itself.
    """
    n = environment.numbers[0]
    x_lv, x_bv, x_av = x0[LV], x0[BV], x0[AV]
    v_lv, v_bv, v_av = v0[LV], v0[BV], v0[AV]
    total = 0.0
    draws = 0
    a_lv = a_bv = 0.0
    for step in range(n.max_steps):
        r1, r1dot = gap(x_lv, x_bv), v_lv - v_bv
        r2, r2dot = gap(x_bv, x_av), v_bv - v_av
        if step > 0 and (r1 < CONTACT_M or r2 <= 0.0):
            return total, step
        if step % n.hold_steps == 0:
            a_lv = acceleration(draw_free_driving(uniform(seed, episode, LV_DRAWS, draws), v_lv, environment))
            a_bv = acceleration(
                draw_car_following(uniform(seed, episode, BV_DRAWS, draws), v_bv, r1, r1dot, environment)
            )
            draws += 1
        total += cut_in_hazard(
            opportunity(v_bv, r1, r1dot, environment), acceptance(r2, r2dot, environment), environment
        )
        after_lv, after_bv = next_speed(v_lv, a_lv), next_speed(v_bv, a_bv)
        x_lv = next_position(x_lv, v_lv, after_lv)
        x_bv = next_position(x_bv, v_bv, after_bv)
        x_av = next_position(x_av, v_av, v_av)
        v_lv, v_bv = after_lv, after_bv
    return total, n.max_steps


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
def begin_cell(
    k: int,
    row: int,
    episode: int,
    seed: int,
    x: FloatArray,
    v: FloatArray,
    cells: Cells,
    environment: Environment,
    importance: Importance,
    script: Script,
) -> None:
    """Reset cell ``k`` for an episode whose vehicles stand at ``x[k]``, ``v[k]``."""
    method = importance.settings[0].method
    cell = cells.cell[k]
    cell.row, cell.episode, cell.step, cell.cut_step, cell.component = row, episode, 0, -1, -1
    cell.lv_maneuver = cell.bv_maneuver = cell.n_lv = cell.n_bv = cell.n_bv_free = cell.n_path = cell.n_control = 0
    cell.clock = cell.hazard = cell.log_sampled = 0.0
    cell.hazard_total = cell.log_p_cut_in = math.nan
    cell.min_ttc = math.inf
    cell.cut_r2 = cell.cut_r2dot = math.nan
    cell.av_start = x[k, AV]
    cells.acceleration[k, AV] = 0.0
    cells.log_ratio[k, :] = 0.0
    cells.martingale[k, :] = 0.0
    if method == SHELLS:
        cell.component, cell.log_sampled = script.component[row], -script.log_weight[row]
        return
    forced = method == FORCED
    if method == EPISODE_MIXTURE:
        cell.component = draw_component(uniform(seed, episode, CUT_IN, COMPONENT_DRAW), importance.alpha)
        forced = cell.component == 0
    u = uniform(seed, episode, CUT_IN, CUT_IN_DRAW)
    if method in (FORCED, EPISODE_MIXTURE):
        total, _ = path_hazard(seed, episode, x[k], v[k], environment)
        cell.hazard_total = total
        p_cut_in = -math.expm1(-total)
        cell.log_p_cut_in = math.log(p_cut_in)
        if forced:
            cell.target = min(-math.log1p(-u * p_cut_in), total)
            return
    cell.target = -math.log1p(-u)


@compiled
def refill(
    seed: int,
    first_episode: int,
    states: FloatArray,
    x: FloatArray,
    v: FloatArray,
    cells: Cells,
    exchange: Exchange,
    environment: Environment,
    importance: Importance,
    script: Script,
) -> None:
    """Give every idle cell the next episode of the shard.

    Parameters
    ----------
    seed, first_episode : int
        Campaign seed, and campaign index of row 0.
    states : ndarray, shape (rows, 5)
        Initial states of the shard.
    x, v : ndarray, shape (K, 3)
        Receive the placement of refilled cells.
    exchange : Exchange
        Counts the rows given out; receives the refilled cells.
    script : Script
        Traffic of the shard's rows, where it is prescribed.
    """
    exchange.counts[PLACED] = 0
    for k in range(cells.cell.size):
        row = exchange.counts[GIVEN]
        if row == states.shape[0]:
            return
        if cells.cell[k].row < 0:
            place(states[row], x[k], v[k])
            begin_cell(k, row, first_episode + row, seed, x, v, cells, environment, importance, script)
            exchange.placed[exchange.counts[PLACED]] = k
            exchange.counts[PLACED] += 1
            exchange.counts[GIVEN] += 1


@compiled_threads
def mean_test_distance(seed: int, states: FloatArray, environment: Environment) -> float:
    """Mean distance (m) that the AV drives in an overtaking without cut-in; ``states`` (n, 5)."""
    x, v = states[0, :3].copy(), states[0, :3].copy()
    total = 0.0
    for i in range(states.shape[0]):
        place(states[i], x, v)
        _, steps = path_hazard(seed, i, x, v, environment)
        total += v[AV] * (0.1 * steps)
    return float(total / states.shape[0])
