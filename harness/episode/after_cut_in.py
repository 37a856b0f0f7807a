"""A step after the cut-in: BV drives freely on the right lane and redraws its acceleration at its own hold clock."""

from __future__ import annotations

from harness.arrays import FloatArray
from harness.compiled import compiled_inline
from harness.environment.driving import acceleration_pmf, draw_acceleration, free_driving
from harness.episode.cells import Bench
from harness.episode.record import record_moment, take_in
from harness.importance.functions import challenges_nobody, propose_acceleration
from harness.maneuvers import N_ACCELERATIONS
from harness.outcomes import STEP_MIXTURE
from harness.random_stream import BV_FREE_DRAWS, uniform
from harness.state import State


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
def controlled_draw(k: int, u: float, state: State, bench: Bench) -> int:
    """Acceleration index at a redraw time that may be critical; accumulates the likelihood ratios."""
    cells, scratch, environment, importance = bench.cells, bench.scratch, bench.environment, bench.importance
    cell, p, q = cells.cell[k], scratch.p, scratch.q_acceleration
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
    record_moment(k, state, maneuver, p[maneuver], p[maneuver] * sampled, bench)
    return maneuver


@compiled_inline
def redraw_free(k: int, state: State, bench: Bench) -> None:
    """BV's acceleration for the coming hold period after its cut-in."""
    cell = bench.cells.cell[k]
    u = uniform(bench.seed, cell.episode, BV_FREE_DRAWS, cell.n_bv_free)
    if bench.importance.n_surrogates > 0:
        cell.bv_maneuver = controlled_draw(k, u, state, bench)
    else:
        cell.bv_maneuver = draw_acceleration(u, free_driving(state.v_bv_mps, bench.environment), bench.environment)
    bench.cells.bv_path[k, cell.n_path] = cell.bv_maneuver
    cell.n_bv_free += 1
    cell.n_path += 1
