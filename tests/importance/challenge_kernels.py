"""Interpolation of challenge tables over arrays of states.

Import this module as ``tests.…`` everywhere: numba's cache remembers the name.
"""

import numpy as np

from harness.compiled import compiled_threads
from harness.importance.grid import AFTER, interpolate, locate


@compiled_threads
def _after(table, states, out):
    for i in range(states.shape[0]):
        out[i] = interpolate(table, locate(AFTER, states[i, 0], states[i, 1], states[i, 2]))


def after_cut_in(table, states):
    """Table (v, R2, R2dot) at states (n, 3)."""
    out = np.empty(len(states))
    _after(np.ascontiguousarray(table), np.asarray(states, float), out)
    return out
