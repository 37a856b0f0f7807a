"""Who crashes together after a cut-in: the vehicle under test and its surrogates on the same maneuvers, exactly.

All begin in the same state of danger and meet the same maneuvers of the BV. Their noise is *shared* (the same uniform
in each step: where one escapes a more skilled one does too), *opposite* (the surrogates see one minus it) or their
*own*. Backward induction over the joint state gives the probability of every combination of crashes.
"""

from __future__ import annotations

import numpy as np

from harness.arrays import FloatArray, IntArray
from harness.studies.chains.chain import Chain


def joint_outcomes(chain: Chain) -> FloatArray:
    """Probability of each combination of crashes after a cut-in, shape (horizon, G, 2^J, 2).

    The cut-in is in step t from state g; the third axis has one bit per surrogate that crashes, the last says whether
    the vehicle does.

    Raises
    ------
    ValueError
        The BV's maneuvers after the cut-in depend on the vehicle, so that surrogates cannot meet the same ones.
    """
    if not np.allclose(chain.exposure, chain.exposure[0], rtol=0.0, atol=0.0):
        raise ValueError(f"chain {chain.name!r}: maneuvers depend on the danger that the vehicle is in")
    n_vehicles = chain.n_surrogates + 1
    width = chain.crashed + 1
    value = _at_the_end(n_vehicles, width)
    joint = np.zeros((chain.horizon, len(chain.start), 1 << chain.n_surrogates, 2))
    same = (np.arange(width),) * n_vehicles
    for t in range(chain.horizon - 1, -1, -1):
        joint[t] = np.einsum("gd,dmc->gmc", chain.entry, value[same])
        value = _step_back(chain, value)
    return joint


def _at_the_end(n_vehicles: int, width: int) -> FloatArray:
    """One combination is certain in each joint state; axes: vehicle under test, surrogates, mask, crash."""
    value = np.zeros((width,) * n_vehicles + (1 << (n_vehicles - 1), 2))
    for state in np.ndindex(*(width,) * n_vehicles):
        crash = [d == width - 1 for d in state]
        mask = sum(1 << k for k, crashed in enumerate(crash[1:]) if crashed)
        value[(*state, mask, int(crash[0]))] = 1.0
    return value


def _step_back(chain: Chain, value: FloatArray) -> FloatArray:
    responses = [chain.response, *chain.surrogate_responses]
    tables = [[_with_absorbing(response[:, a]) for response in responses] for a in range(chain.exposure.shape[1])]
    move = _own_noise if chain.noise == "own" else _common_noise
    opposite = chain.noise == "opposite"
    parts = [p * move(of_a, value, opposite) for p, of_a in zip(chain.exposure[0], tables, strict=True)]
    total: FloatArray = np.sum(parts, axis=0)
    return total


def _with_absorbing(table: FloatArray) -> FloatArray:
    """Transitions of all states (D + 2, D + 2): safe and crashed stay."""
    n, width = table.shape
    return np.vstack([table, np.eye(width)[n:]])


def _own_noise(tables: list[FloatArray], value: FloatArray, _opposite: bool) -> FloatArray:
    for axis, table in enumerate(tables):
        value = np.moveaxis(np.tensordot(table, value, axes=(1, axis)), 0, axis)
    return value


def _common_noise(tables: list[FloatArray], value: FloatArray, opposite: bool) -> FloatArray:
    """Cut the uniform where any vehicle's next state changes; within a piece all next states are certain."""
    cumulative = [np.cumsum(_careful_first(table), axis=1) for table in tables]
    mirrored = [opposite and k > 0 for k in range(len(tables))]
    edges = [1.0 - c if m else c for c, m in zip(cumulative, mirrored, strict=True)]
    cuts = np.unique(np.clip(np.concatenate([[0.0, 1.0], *(e.ravel() for e in edges)]), 0.0, 1.0))
    result = np.zeros_like(value)
    for low, high in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
        u = (low + high) / 2.0
        following = [_next(c, 1.0 - u if m else u) for c, m in zip(cumulative, mirrored, strict=True)]
        result += (high - low) * value[np.ix_(*following)]
    return result


def _careful_first(table: FloatArray) -> FloatArray:
    """Columns from the best next state to the worst: safe, then danger from low to high, then crashed."""
    n = len(table) - 2
    return table[:, [n, *range(n), n + 1]]


def _next(cumulative: FloatArray, u: float) -> IntArray:
    """Next state of each state for a uniform, in the chain's own numbering, shape (D + 2,)."""
    n = len(cumulative) - 2
    place = np.minimum((cumulative <= u).sum(axis=1), n + 1)
    numbering = np.array([n, *range(n), n + 1])
    found: IntArray = numbering[place]
    return found
