"""A step after the cut-in: BV drives freely on the right lane and redraws its acceleration at its own hold clock."""

from __future__ import annotations

import math

from harness.arrays import FloatArray
from harness.compiled import compiled_inline
from harness.environment.driving import Environment, draw_free_driving, free_driving_pmf
from harness.episode.cells import Cells, Results, Scratch
from harness.episode.record import record_moment
from harness.importance.functions import Importance, challenges_nobody, propose_acceleration
from harness.importance.likelihood import accumulate
from harness.maneuvers import N_ACCELERATIONS
from harness.outcomes import STEP_MIXTURE
from harness.random_stream import BV_FREE_DRAWS, uniform


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
def controlled_draw(
    k: int,
    u: float,
    cells: Cells,
    results: Results,
    scratch: Scratch,
    environment: Environment,
    importance: Importance,
) -> int:
    """Acceleration index at a redraw time that may be critical; accumulates the likelihood ratios."""
    s = importance.settings[0]
    cell = cells.cell[k]
    state, p, q = scratch.state, scratch.p, scratch.q_acceleration
    if challenges_nobody(state[0], state[3], state[4], importance):
        return draw_free_driving(u, state[0], environment)
    free_driving_pmf(state[0], environment, p)
    if not propose_acceleration(state[0], state[3], state[4], p, importance, q, scratch.challenge):
        return draw_free_driving(u, state[0], environment)
    if s.method == STEP_MIXTURE or cell.component > 0:
        maneuver = draw_from(u, s.method, cell.component, importance.alpha, q)
    else:
        maneuver = draw_free_driving(u, state[0], environment)
    if s.first == 1:
        scratch.ratio[0] = 1.0
    for j in range(s.n_surrogates):
        scratch.q[j] = q[j, maneuver]
        scratch.ratio[s.first + j] = q[j, maneuver] / p[maneuver]
    sampled = accumulate(
        s.method,
        s.first,
        importance.alpha,
        scratch.ratio,
        scratch.challenge,
        cell.log_sampled,
        cells.log_ratio[k],
        cells.martingale[k],
        scratch.weight,
    )
    if s.method == STEP_MIXTURE:
        cell.log_sampled += math.log(sampled)
    cell.n_control += 1
    record_moment(k, maneuver, p[maneuver], p[maneuver] * sampled, cells, results, scratch)
    return maneuver


@compiled_inline
def redraw_free(
    k: int,
    seed: int,
    cells: Cells,
    results: Results,
    scratch: Scratch,
    environment: Environment,
    importance: Importance,
) -> None:
    """BV's acceleration for the coming hold period after its cut-in."""
    cell = cells.cell[k]
    u = uniform(seed, cell.episode, BV_FREE_DRAWS, cell.n_bv_free)
    if importance.settings[0].n_surrogates > 0:
        cell.bv_maneuver = controlled_draw(k, u, cells, results, scratch, environment, importance)
    else:
        cell.bv_maneuver = draw_free_driving(u, scratch.state[0], environment)
    cells.bv_path[k, cell.n_path] = cell.bv_maneuver
    cell.n_bv_free += 1
    cell.n_path += 1
