"""Interpolation of challenge tables over arrays of states.

Import this module as ``tests.…`` everywhere: numba's cache remembers the name.
"""

import numpy as np

from harness.compiled import compiled_threads
from harness.criticality.grid import interpolate, locate_after, locate_before


@compiled_threads
def _after(table, states, out):
    for i in range(states.shape[0]):
        out[i] = interpolate(table, locate_after(states[i, 0], states[i, 1], states[i, 2]))


@compiled_threads
def _before(table, states, out):
    for i in range(states.shape[0]):
        out[i] = interpolate(table, locate_before(states[i, 0], states[i, 1], states[i, 2]))


def after_cut_in(table, states):
    """Table (v, R2, R2dot) at states (n, 3)."""
    out = np.empty(len(states))
    _after(np.ascontiguousarray(table), np.asarray(states, float), out)
    return out


def before_cut_in(table, states):
    """Table (v, R2, R2dot) of G at states (n, 3)."""
    out = np.empty(len(states))
    _before(np.ascontiguousarray(table), np.asarray(states, float), out)
    return out
