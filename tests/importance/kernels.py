"""Challenge tables, importance functions and likelihood ratios over arrays: compiled functions, called in bulk.

Import this module as ``tests.…`` everywhere: numba's cache remembers the name.
"""

from typing import NamedTuple

import numpy as np

from harness.campaign.campaign import Campaign
from harness.compiled import compiled_threads
from harness.episode import likelihood_ratio
from harness.episode.decide import draw_from
from harness.importance import functions
from harness.importance.challenge import remaining_level
from harness.importance.grid import AFTER, interpolate, locate
from harness.traffic.laws import acceleration, acceleration_pmf, acceptance, cut_in_hazard, free_driving, opportunity
from harness.vocabulary import State


class Proposals(NamedTuple):
    """p (n, A), q (n, J, A) and V (n, J) of states, and whether they are critical (n,).

    A is 31 after the cut-in; before it 2: cut_in, stay.
    """

    p: np.ndarray
    q: np.ndarray
    v: np.ndarray
    critical: np.ndarray


@compiled_threads
def _after(states, steps, environment, importance, p, q, v, critical):
    levels = importance.harmless.shape[1] - 1
    for i in range(states.shape[0]):
        speed, r1, r1dot, r2, r2dot = states[i]
        acceleration_pmf(free_driving(speed, environment), environment, p[i])
        state = State(speed, r1, r1dot, r2, r2dot)
        level = remaining_level(steps[i], environment.numbers.max_steps, importance.steps_per_level, levels)
        critical[i] = functions.propose_acceleration(state, level, p[i], importance, q[i], v[i])


@compiled_threads
def _before(states, maneuvers, steps, environment, importance, cut, stay, p, q, v, critical):
    for i in range(states.shape[0]):
        speed, r1, r1dot, r2, r2dot = states[i]
        state, a = State(speed, r1, r1dot, r2, r2dot), acceleration(maneuvers[i])
        functions.look_ahead(state, a, steps[i], environment, importance, cut[i], stay[i])
        wish = opportunity(state, environment)
        hazard = cut_in_hazard(wish, acceptance(r2, r2dot, environment), environment)
        p[i] = -np.expm1(-hazard)
        critical[i] = functions.propose_cut_in(p[i], wish, cut[i, 0], stay[i, 0], importance, q[i], v[i])


@compiled_threads
def _draws(u, component, alpha, q, out):
    for i in range(u.size):
        out[i] = draw_from(u[i], component, alpha, q)


@compiled_threads
def _accumulate(importance, ratios, v, log_ratio, martingale, sampled):
    log_sampled = 0.0
    for t in range(ratios.shape[0]):
        sampled[t] = likelihood_ratio.accumulate(importance, ratios[t], v[t], log_sampled, log_ratio, martingale)
        log_sampled += np.log(sampled[t])


def after_cut_in(states, environment, importance, steps=None) -> Proposals:
    """Proposals at redraw times after the cut-in; states (n, 5), in ``steps`` (n,), or at the beginning of a test."""
    n, j = len(states), importance.maneuvers.shape[0]
    out = Proposals(np.empty((n, 31)), np.empty((n, j, 31)), np.empty((n, j)), np.empty(n, np.bool_))
    steps = np.zeros(n, np.int64) if steps is None else np.asarray(steps, np.int64)
    _after(np.ascontiguousarray(states, float), steps, environment, importance, *out)
    return out


def before_cut_in(states, maneuvers, steps, environment, importance) -> Proposals:
    """Proposals at redraw times before the cut-in, BV having drawn ``maneuvers`` (n,) in ``steps`` (n,)."""
    n, j, hold = len(states), importance.value.shape[0], int(environment.numbers["hold_steps"])
    p, q, v, critical = np.empty(n), np.empty((n, j)), np.empty((n, j)), np.empty(n, np.bool_)
    cut, stay = np.empty((n, hold, j)), np.empty((n, hold, j))
    indices, times = np.asarray(maneuvers, np.int64), np.asarray(steps, np.int64)
    _before(np.ascontiguousarray(states, float), indices, times, environment, importance, cut, stay, p, q, v, critical)
    return Proposals(np.stack([p, 1.0 - p], axis=-1), np.stack([q, 1.0 - q], axis=-1), v, critical)


def drawn(u, component, alpha, q):
    """Indices (n,) that uniforms are turned into, under importance functions q (J, 31)."""
    out = np.empty(u.size, np.int64)
    _draws(u, component, alpha, np.ascontiguousarray(q), out)
    return out


def accumulated(of_episodes, alpha, ratios, v):
    """Take in ratios q_j/p (steps, M) with V (steps, J): log ratios (M,), martingale sums (J,), q_α/p (steps,).

    The first is that of a forced cut-in; the mixture is one of whole episodes or of steps.
    """
    importance = functions.build_importance(Campaign(name="none", testing={"method": "nde"}), None)
    importance = importance._replace(mixes_episodes=int(of_episodes), n_forced=1, alpha=alpha)
    log_ratio, martingale, sampled = np.zeros(alpha.size), np.zeros(v.shape[1]), np.empty(len(ratios))
    _accumulate(importance, ratios, v, log_ratio, martingale, sampled)
    return log_ratio, martingale, sampled


@compiled_threads
def _interpolate(table, states, out):
    for i in range(states.shape[0]):
        out[i] = interpolate(table, locate(AFTER, states[i, 0], states[i, 1], states[i, 2]))


def tabulated(table, states):
    """Table (v, R2, R2dot) at states (n, 3) after the cut-in."""
    out = np.empty(len(states))
    _interpolate(np.ascontiguousarray(table), np.asarray(states, float), out)
    return out
