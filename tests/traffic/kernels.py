"""The environment's compiled functions over arrays of states, so that tests can call them in bulk.

States have columns v_BV, R1, R1dot; the compiled code is cached, unlike that of functions called one by one.
Import this module as ``tests.…`` everywhere: numba's cache remembers the name.
"""

import functools

import numpy as np

from harness.campaign.sections import EnvironmentSettings
from harness.compiled import compiled_threads
from harness.traffic import laws
from harness.traffic.loading import load_environment
from harness.vocabulary import State


@functools.cache
def environment(level=1.0, hold_s=1.0):
    return load_environment(EnvironmentSettings(lane_change_level=level, acceleration_hold_s=hold_s))


@compiled_threads
def _free(speeds, env, u, pmf, drawn):
    for i in range(speeds.size):
        law = laws.free_driving(speeds[i], env)
        laws.acceleration_pmf(law, env, pmf[i])
        for j in range(u.size):
            drawn[i, j] = laws.draw_acceleration(u[j], law, env)


@compiled_threads
def _following(states, env, u, pmf, cap, drawn):
    for i in range(states.shape[0]):
        state = State(states[i, 0], states[i, 1], states[i, 2], 0.0, 0.0)
        law = laws.car_following(state, env)
        laws.acceleration_pmf(law, env, pmf[i])
        cap[i] = law.cap
        for j in range(u.size):
            drawn[i, j] = laws.draw_acceleration(u[j], law, env)


@compiled_threads
def _cut_in(states, env, out):
    for i in range(states.shape[0]):
        v, r1, r1dot, r2, r2dot = states[i]
        out[i, 0] = laws.opportunity(State(v, r1, r1dot, r2, r2dot), env)
        out[i, 1] = laws.acceptance(r2, r2dot, env)
        out[i, 2] = laws.cut_in_hazard(out[i, 0], out[i, 1], env)


@compiled_threads
def _t_cdf(z, table, out):
    for i in range(z.size):
        out[i] = laws.t_cdf(z[i], table)


def free_driving(speeds, u=()):
    """Probabilities (n, 31) and the indices that uniforms are turned into (n, len(u))."""
    speeds, u = np.atleast_1d(np.asarray(speeds, float)), np.asarray(u, float)
    pmf, drawn = np.empty((speeds.size, 31)), np.empty((speeds.size, u.size), np.int64)
    _free(speeds, environment(), u, pmf, drawn)
    return pmf, drawn


def car_following(states, u=()):
    """Probabilities (n, 31), indices of the guard's cap (n,), and drawn indices (n, len(u))."""
    states, u = np.atleast_2d(np.asarray(states, float)), np.asarray(u, float)
    pmf, cap = np.empty((len(states), 31)), np.empty(len(states), np.int64)
    drawn = np.empty((len(states), u.size), np.int64)
    _following(states, environment(), u, pmf, cap, drawn)
    return pmf, cap, drawn


def cut_in_terms(states, level=1.0):
    """Opportunity, acceptance and hazard of one step; states have all five columns: (n, 3)."""
    states = np.atleast_2d(np.asarray(states, float))
    out = np.empty((len(states), 3))
    _cut_in(states, environment(level), out)
    return out


def t_distribution(z, table):
    out = np.empty(z.size)
    _t_cdf(z, table, out)
    return out
