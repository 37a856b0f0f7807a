"""Driver models and kinematics over arrays, so that tests can call the compiled functions in bulk.
Import this module as ``tests.…`` everywhere: numba's cache remembers the name.
"""

import numpy as np

from harness.compiled import compiled_threads
from harness.vehicles import kinematics, models


@compiled_threads
def _accelerations(driver, situations, out):
    for i in range(situations.shape[0]):
        out[i] = models.driver_acceleration(driver[0], situations[i, 0], situations[i, 1], situations[i, 2])


@compiled_threads
def _motions(situations, out):
    for i in range(situations.shape[0]):
        x, v, a = situations[i]
        out[i, 1] = kinematics.next_speed(v, a)
        out[i, 0] = kinematics.next_position(x, v, out[i, 1])


def accelerations(parameters, situations):
    """Accelerations (n,) at speed, leader's speed and gap: (n, 3)."""
    situations = np.atleast_2d(np.asarray(situations, float))
    out = np.empty(len(situations))
    _accelerations(models.driver_records([parameters]), situations, out)
    return out


def motions(situations):
    """Positions and speeds (n, 2) a step after position, speed and acceleration: (n, 3)."""
    situations = np.atleast_2d(np.asarray(situations, float))
    out = np.empty((len(situations), 2))
    _motions(situations, out)
    return out
