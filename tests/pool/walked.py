"""P(cut-in | path) as the forced cut-in computes it: an independent walk of a path."""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled_threads
from harness.environment.driving import Environment
from harness.episode.begin import path_hazard, place


@compiled_threads
def _hazards(seed: int, states: np.ndarray, environment: Environment, out: np.ndarray) -> None:
    x, v = np.zeros(3), np.zeros(3)
    for i in range(states.shape[0]):
        place(states[i], x, v)
        out[i], _ = path_hazard(seed, i, x, v, environment)


def p_cut_in_of_paths(seed: int, states: np.ndarray, environment: Environment) -> np.ndarray:
    hazards = np.zeros(len(states))
    _hazards(seed, states, environment, hazards)
    return -np.expm1(-hazards)
