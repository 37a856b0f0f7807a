"""Driver models and kinematics over arrays, so that tests can call the compiled functions in bulk.
Import this module as ``tests.…`` everywhere: numba's cache remembers the name.
"""

import numpy as np

from harness.campaign.drivers import IDMParameters
from harness.compiled import compiled_threads
from harness.vehicles import drivers, kinematics, references


@compiled_threads
def _accelerations(driver, situations, out):
    for i in range(situations.shape[0]):
        out[i] = drivers.driver_acceleration(driver[0], situations[i, 0], situations[i, 1], situations[i, 2])


@compiled_threads
def _follow(driver, seed, episode, situations, out):
    late = references.reaction_steps(driver[0], seed, episode)
    memory = references.Memory(0.0, np.inf, driver[0].used_up_steps)
    for i in range(situations.shape[0]):
        if i > late:
            v, v_lead, gap = situations[i]
            memory = references.react(driver[0], memory, i - late - 1, v, v_lead, gap)
        out[i] = memory.acceleration


@compiled_threads
def _late(driver, seed, first, out):
    for i in range(out.size):
        out[i] = references.reaction_steps(driver[0], seed, first + i)


def accelerations(parameters, situations):
    """Accelerations (n,) at speed, leader's speed and gap: (n, 3)."""
    situations = np.atleast_2d(np.asarray(situations, float))
    out = np.empty(len(situations))
    _accelerations(drivers.driver_records([parameters]), situations, out)
    return out


def follow(parameters, reflexes, situations, *, seed=0, episode=0):
    """Accelerations (n,) from the cut-in on, at speed, leader's speed and gap in each step: (n, 3)."""
    situations = np.asarray(situations, float)
    out = np.empty(len(situations))
    _follow(drivers.driver_records([parameters], [reflexes]), seed, episode, situations, out)
    return out


def steps_late(reflexes, n, *, seed=0, first=0):
    """Steps between cut-in and reaction in consecutive episodes (n,)."""
    out = np.empty(n, np.int64)
    _late(drivers.driver_records([IDMParameters()], [reflexes]), seed, first, out)
    return out


@compiled_threads
def _approach(driver, v, v_lead, gaps, steps, out):
    for k in range(gaps.size):
        gap, speed, out[k] = gaps[k], v, gaps[k]
        memory = references.Memory(0.0, np.inf, driver[0].used_up_steps)
        for step in range(steps):
            memory = references.react(driver[0], memory, step, speed, v_lead, gap)
            after = kinematics.next_speed(speed, memory.acceleration)
            gap += (v_lead - 0.5 * (speed + after)) * kinematics.STEP_S
            speed = after
            out[k] = min(out[k], gap)


def smallest_gaps(parameters, v, v_lead, gaps, *, steps=150):
    """Smallest gap (n,) within some steps behind a vehicle that keeps its speed, from the gaps (n,) after a cut-in."""
    gaps = np.asarray(gaps, float)
    out = np.empty(gaps.size)
    _approach(drivers.driver_records([parameters]), v, v_lead, gaps, steps, out)
    return out


@compiled_threads
def _fuzzy_metrics(driver, situations, out):
    for i in range(situations.shape[0]):
        v, v_lead, gap, a = situations[i]
        out[i, 0] = references.proactive_metric(driver[0], v, v_lead, gap)
        out[i, 1] = references.critical_metric(driver[0], v, v_lead, gap, a)


def fuzzy_metrics(parameters, situations):
    """PFS and CFS (n, 2) at speed, leader's speed, gap and acceleration: (n, 4)."""
    situations = np.atleast_2d(np.asarray(situations, float))
    out = np.empty((len(situations), 2))
    _fuzzy_metrics(drivers.driver_records([parameters]), situations, out)
    return out
