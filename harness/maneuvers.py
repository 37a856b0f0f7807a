"""The maneuvers of the background vehicle: 31 accelerations, ``cut_in``, and (before a cut-in) staying in lane."""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled_inline

N_ACCELERATIONS = 31
CUT_IN = 31
STAY = 32
ACCELERATIONS_MPS2 = (np.arange(N_ACCELERATIONS) - 20) / 5.0
"""-4 … 2 m/s² in steps of 0.2 [paper]; written as a quotient so that every value is the nearest double."""


@compiled_inline
def acceleration(maneuver: int) -> float:
    """Acceleration (m/s²) of maneuver index 0 … 30."""
    return (maneuver - 20) / 5.0


@compiled_inline
def upper_edge(maneuver: int) -> float:
    """Upper edge (m/s²) of the 0.2-wide bin that maneuver index 0 … 29 stands for; the last bin has none."""
    return (maneuver - 20) / 5.0 + 0.1
