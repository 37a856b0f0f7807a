"""Compiled functions over arrays, so that tests can call them in bulk, and parts of kernels by themselves.

What is called in bulk is cached, by the name of this module: import it as ``tests.kernels`` everywhere.
"""

import functools
from typing import NamedTuple

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.drivers import IDMParameters
from harness.campaign.sections import EnvironmentSettings
from harness.compiled import compiled_threads
from harness.families.cut_in import laws
from harness.families.cut_in.loading import load_environment
from harness.families.cut_in.nade import functions, likelihood_ratio
from harness.families.cut_in.nade.challenge import remaining_level
from harness.families.cut_in.nade.decide import draw_from
from harness.families.cut_in.nade.grid import AFTER, interpolate, locate
from harness.families.cut_in.vocabulary import State
from harness.vehicles import drivers, kinematics, references

# -- traffic --


@functools.cache
def environment(level=1.0, hold_s=1.0):
    return load_environment(
        EnvironmentSettings(parameters="ndd-overtaking-1", lane_change_level=level, acceleration_hold_s=hold_s)
    )


@compiled_threads
def _bv(states, follows, env, u):
    n = states.shape[0]
    pmf, cap, drawn = np.empty((n, 31)), np.empty(n, np.int64), np.empty((n, u.size), np.int64)
    for i in range(n):
        if follows:
            law = laws.car_following(State(states[i, 0], states[i, 1], states[i, 2], 0.0, 0.0), env)
        else:
            law = laws.free_driving(states[i, 0], env)
        laws.acceleration_pmf(law, env, pmf[i])
        cap[i] = law.cap
        for j in range(u.size):
            drawn[i, j] = laws.draw_acceleration(u[j], law, env)
    return pmf, cap, drawn


@compiled_threads
def _cut_in(states, env):
    out = np.empty((states.shape[0], 3))
    for i in range(states.shape[0]):
        v, r1, r1dot, r2, r2dot = states[i]
        out[i, 0] = laws.opportunity(State(v, r1, r1dot, r2, r2dot), env)
        out[i, 1] = laws.acceptance(r2, r2dot, env)
        out[i, 2] = laws.cut_in_hazard(out[i, 0], out[i, 1], env)
    return out


@compiled_threads
def t_distribution(z, table):
    out = np.empty(z.size)
    for i in range(z.size):
        out[i] = laws.t_cdf(z[i], table)
    return out


def bv_accelerations(states, u=(), *, follows):
    """Probabilities (n, 31), indices of the guard's cap (n,), and the indices that uniforms are turned into (n, u).

    Of BV behind LV, or of one that drives freely; states have columns v_BV, R1, R1dot.
    """
    return _bv(np.atleast_2d(np.asarray(states, float)), follows, environment(), np.asarray(u, float))


def cut_in_terms(states, level=1.0, env=None):
    """Opportunity, acceptance and hazard of one step; states have all five columns: (n, 3)."""
    return _cut_in(np.atleast_2d(np.asarray(states, float)), env or environment(level))


# -- vehicles --


@compiled_threads
def _accelerations(driver, situations):
    out = np.empty(situations.shape[0])
    for i in range(out.size):
        out[i] = drivers.driver_acceleration(driver[0], situations[i, 0], situations[i, 1], situations[i, 2])
    return out


@compiled_threads
def _follow(driver, seed, episode, situations):
    out = np.empty(situations.shape[0])
    late = references.reaction_steps(driver[0], seed, episode)
    memory = references.Memory(0.0, np.inf, driver[0].used_up_steps)
    for i in range(situations.shape[0]):
        if i > late:
            v, v_lead, gap = situations[i]
            memory = references.react(driver[0], memory, i - late - 1, v, v_lead, gap)
        out[i] = memory.acceleration
    return out


@compiled_threads
def _late(driver, seed, first, n):
    out = np.empty(n, np.int64)
    for i in range(n):
        out[i] = references.reaction_steps(driver[0], seed, first + i)
    return out


def accelerations(parameters, situations):
    """Accelerations (n,) at speed, leader's speed and gap: (n, 3)."""
    return _accelerations(drivers.driver_records([parameters]), np.atleast_2d(np.asarray(situations, float)))


def follow(parameters, reflexes, situations, *, seed=0, episode=0):
    """Accelerations (n,) from the cut-in on, at speed, leader's speed and gap in each step: (n, 3)."""
    return _follow(drivers.driver_records([parameters], [reflexes]), seed, episode, np.asarray(situations, float))


def steps_late(reflexes, n, *, seed=0, first=0):
    """Steps between cut-in and reaction in consecutive episodes (n,)."""
    return _late(drivers.driver_records([IDMParameters()], [reflexes]), seed, first, n)


@compiled_threads
def _approach(driver, v, v_lead, gaps, steps):
    out = np.empty(gaps.size)
    for k in range(gaps.size):
        gap, speed, out[k] = gaps[k], v, gaps[k]
        memory = references.Memory(0.0, np.inf, driver[0].used_up_steps)
        for step in range(steps):
            memory = references.react(driver[0], memory, step, speed, v_lead, gap)
            after = kinematics.next_speed(speed, memory.acceleration)
            gap += (v_lead - 0.5 * (speed + after)) * kinematics.STEP_S
            speed = after
            out[k] = min(out[k], gap)
    return out


def smallest_gaps(parameters, v, v_lead, gaps, *, steps=150):
    """Smallest gap (n,) within some steps behind a vehicle that keeps its speed, from the gaps (n,) after a cut-in."""
    return _approach(drivers.driver_records([parameters]), v, v_lead, np.asarray(gaps, float), steps)


@compiled_threads
def _fuzzy_metrics(driver, situations):
    out = np.empty((situations.shape[0], 2))
    for i in range(situations.shape[0]):
        v, v_lead, gap, a = situations[i]
        out[i, 0] = references.proactive_metric(driver[0], v, v_lead, gap)
        out[i, 1] = references.critical_metric(driver[0], v, v_lead, gap, a)
    return out


def fuzzy_metrics(parameters, situations):
    """PFS and CFS (n, 2) at speed, leader's speed, gap and acceleration: (n, 4)."""
    return _fuzzy_metrics(drivers.driver_records([parameters]), np.atleast_2d(np.asarray(situations, float)))


# -- importance functions --


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
        laws.acceleration_pmf(laws.free_driving(speed, environment), environment, p[i])
        state = State(speed, r1, r1dot, r2, r2dot)
        level = remaining_level(steps[i], environment.numbers.max_steps, importance.steps_per_level, levels)
        critical[i] = functions.propose_acceleration(state, level, p[i], importance, q[i], v[i])


@compiled_threads
def _before(states, maneuvers, steps, environment, importance, cut, stay, p, q, v, critical):
    for i in range(states.shape[0]):
        speed, r1, r1dot, r2, r2dot = states[i]
        state, a = State(speed, r1, r1dot, r2, r2dot), laws.acceleration(maneuvers[i])
        functions.look_ahead(state, a, steps[i], environment, importance, cut[i], stay[i])
        wish = laws.opportunity(state, environment)
        hazard = laws.cut_in_hazard(wish, laws.acceptance(r2, r2dot, environment), environment)
        p[i] = -np.expm1(-hazard)
        critical[i] = functions.propose_cut_in(p[i], wish, cut[i, 0], stay[i, 0], importance, q[i], v[i])


@compiled_threads
def drawn(u, component, alpha, q):
    """Indices (n,) that uniforms are turned into, under importance functions q (J, 31)."""
    out = np.empty(u.size, np.int64)
    for i in range(u.size):
        out[i] = draw_from(u[i], component, alpha, q)
    return out


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


def before_event(states, maneuvers, steps, environment, importance) -> Proposals:
    """Proposals at redraw times before the cut-in, BV having drawn ``maneuvers`` (n,) in ``steps`` (n,)."""
    n, j, hold = len(states), importance.value.shape[0], int(environment.numbers["hold_steps"])
    p, q, v, critical = np.empty(n), np.empty((n, j)), np.empty((n, j)), np.empty(n, np.bool_)
    cut, stay = np.empty((n, hold, j)), np.empty((n, hold, j))
    indices, times = np.asarray(maneuvers, np.int64), np.asarray(steps, np.int64)
    _before(np.ascontiguousarray(states, float), indices, times, environment, importance, cut, stay, p, q, v, critical)
    return Proposals(np.stack([p, 1.0 - p], axis=-1), np.stack([q, 1.0 - q], axis=-1), v, critical)


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
def tabulated(table, states):
    """Table (v, R2, R2dot) at states (n, 3) after the cut-in."""
    out = np.empty(states.shape[0])
    for i in range(out.size):
        out[i] = interpolate(table, locate(AFTER, states[i, 0], states[i, 1], states[i, 2]))
    return out
