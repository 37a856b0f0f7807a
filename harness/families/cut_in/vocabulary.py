"""The vocabulary of the cut-in: what BV may do in a control step, and the state's five numbers by which it decides."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from harness.vocabulary import FloatArray, RecordArray

N_ACCELERATIONS, CUT_IN, STAY = 31, 31, 32
"""Maneuvers of BV: accelerations 0 … 30, and then, before a cut-in, changing lanes or not."""
ACCELERATIONS_MPS2 = (np.arange(N_ACCELERATIONS) - 20) / 5.0
"""-4 … 2 m/s² in steps of 0.2 [ndd]; written as a quotient so that every value is the nearest double."""


class State(NamedTuple):
    """Ranges are bumper to bumper, rates the leader's minus the follower's speed; R1 is LV-BV, R2 is BV-AV.

    Compiled code passes it as it stands; many of them are a structured array of `STATE_DTYPE`, whose records have the
    same fields.
    """

    v_bv_mps: float
    r1_m: float
    r1dot_mps: float
    r2_m: float
    r2dot_mps: float


STATE_COLUMNS = State._fields
STATE_DTYPE = np.dtype([(name, np.float64) for name in STATE_COLUMNS])


def states_from(columns: Iterable[FloatArray]) -> RecordArray:
    """States (n,) from their five columns (n,) each."""
    states: RecordArray = np.column_stack(list(columns)).view(STATE_DTYPE)[:, 0]
    return states
