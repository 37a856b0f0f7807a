"""Pools and shells of an exact chain: paths before the cut-in are drawn, all that can follow is known exactly.

After a cut-in the vehicle under test and its surrogates begin in the same state of danger and meet the same maneuvers
of the BV. Their noise is *shared* (the same uniform in each step: where one escapes a more skilled one does too),
*opposite* (the surrogates see one minus it) or their *own*. Backward induction over the joint state gives the
probability of every combination of crashes.
"""

from __future__ import annotations

import numpy as np

from harness.pool.shells import shells_of
from harness.strata import LIBRARY_STATEMENT, OUTSIDE, ShellDesign, Statement
from harness.vocabulary import FloatArray, IntArray
from studies.chains.chain import Chain
from studies.chains.sampler import approach_paths
from studies.replication.shells import DrawnPool


class ChainShells:
    """A chain's pools; all surrogates are inside.

    Exact are ``shell_p`` and ``crash_p`` (S,), the probability of each shell, and of a crash in it, and the share of
    the crash rate that lies beyond the boundary, ``crashes_outside``.
    """

    def __init__(self, chain: Chain, pool_paths: int) -> None:
        self._chain, self._pool_paths = chain, pool_paths
        order = np.argsort(chain.surrogate_rates, kind="stable")  # from careful to careless
        self._names = (*(f"surrogate {j}" for j in order), OUTSIDE)
        joint = joint_outcomes(chain)
        shell = shells_of(np.arange(1 << chain.n_surrogates), order)
        by_shell = np.stack([joint[:, :, shell == s].sum(axis=2) for s in range(len(self._names))], axis=2)
        self._shell = by_shell.sum(axis=3)  # (horizon, G, S)
        self._crash = by_shell[..., 1]
        self.shell_p, self.crash_p = self._exact(self._shell), self._exact(self._crash)
        self.crashes_outside = float(self.crash_p[-1]) / chain.crash_rate

    def _exact(self, table: FloatArray) -> FloatArray:
        """Probability per test of what a table (horizon, G, S) says given a cut-in, shape (S,)."""
        chain, state = self._chain, self._chain.start
        total = np.zeros(table.shape[2])
        for t in range(chain.horizon):
            total += (state * chain.hazard) @ table[t]
            state = (state * (1.0 - chain.hazard)) @ chain.approach
        return total

    def draw(self, rng: np.random.Generator) -> list[DrawnPool]:
        """A new pool; see `studies.replication.shells.Draw`."""
        chain, names = self._chain, self._names
        path = approach_paths(chain, self._pool_paths, rng)
        hazard = chain.hazard[path]
        cut = hazard * np.cumprod(np.column_stack([np.ones(len(path)), 1.0 - hazard[:, :-1]]), axis=1)
        t = np.arange(chain.horizon)
        mass = np.einsum("nt,nts->ns", cut, self._shell[t, path])
        crash_mass = np.einsum("nt,nts->ns", cut, self._crash[t, path])
        p = mass.mean(0)
        design = ShellDesign(
            pool="drawn",
            strata=names,
            cell_stratum=tuple(range(p.size)),
            cell_p=p,
            n_paths=len(path),
            statements=(Statement(LIBRARY_STATEMENT, names[-2], "crashes only inside", chain.n_surrogates),),
            p_cut_in=float(p.sum()),
            p_unreachable=0.0,
        )
        return [DrawnPool(design, mass, crash_mass)]


def joint_outcomes(chain: Chain) -> FloatArray:
    """Probability of each combination of crashes after a cut-in, shape (horizon, G, 2^J, 2).

    The cut-in is in step t from state g; the third axis has one bit per surrogate that crashes, the last says whether
    the vehicle does.

    Raises `ValueError`: the BV's maneuvers after the cut-in depend on the vehicle, so that surrogates cannot meet the
    same ones.
    """
    if not np.allclose(chain.exposure, chain.exposure[0], rtol=0.0, atol=0.0):
        raise ValueError(f"chain {chain.name!r}: maneuvers depend on the danger that the vehicle is in")
    value = _at_the_end(chain.n_surrogates, chain.crashed + 1)
    joint = np.zeros((chain.horizon, len(chain.start), 1 << chain.n_surrogates, 2))
    same = (np.arange(chain.crashed + 1),) * (chain.n_surrogates + 1)
    for t in range(chain.horizon - 1, -1, -1):
        joint[t] = np.einsum("gd,dmc->gmc", chain.entry, value[same])
        value = _step_back(chain, value)
    return joint


def _at_the_end(n_surrogates: int, width: int) -> FloatArray:
    """One combination is certain in each joint state; axes: vehicle under test, surrogates, mask, crash."""
    value = np.zeros((width,) * (n_surrogates + 1) + (1 << n_surrogates, 2))
    for state in np.ndindex(value.shape[:-2]):
        crashed, *others = (d == width - 1 for d in state)
        mask = sum(1 << k for k, other in enumerate(others) if other)
        value[(*state, mask, int(crashed))] = 1.0
    return value


def _step_back(chain: Chain, value: FloatArray) -> FloatArray:
    move = _own_noise if chain.noise == "own" else _common_noise
    absorbing = np.eye(chain.crashed + 1)[-2:]  # safe and crashed stay
    responses = [chain.response, *chain.surrogate_responses]
    parts = []
    for a, p in enumerate(chain.exposure[0]):
        tables = [np.vstack([response[:, a], absorbing]) for response in responses]
        parts.append(p * move(tables, value, chain.noise == "opposite"))
    return np.asarray(np.sum(parts, axis=0))


def _own_noise(tables: list[FloatArray], value: FloatArray, _opposite: bool) -> FloatArray:
    for axis, table in enumerate(tables):
        value = np.moveaxis(np.tensordot(table, value, axes=(1, axis)), 0, axis)
    return value


def _common_noise(tables: list[FloatArray], value: FloatArray, opposite: bool) -> FloatArray:
    """Cut the uniform where any vehicle's next state changes; within a piece all next states are certain."""
    n = len(tables[0]) - 2
    best_first = np.array([n, *range(n), n + 1])  # safe, then danger from low to high, then crashed
    cumulative = [np.cumsum(table[:, best_first], axis=1) for table in tables]
    mirrored = [opposite and k > 0 for k in range(len(tables))]
    edges = [1.0 - c if m else c for c, m in zip(cumulative, mirrored, strict=True)]
    cuts = np.unique(np.clip(np.concatenate([[0.0, 1.0], *(e.ravel() for e in edges)]), 0.0, 1.0))
    result = np.zeros_like(value)
    for low, high in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
        u = (low + high) / 2.0
        places = [_place(c, 1.0 - u if m else u) for c, m in zip(cumulative, mirrored, strict=True)]
        result += (high - low) * value[np.ix_(*(best_first[place] for place in places))]
    return result


def _place(cumulative: FloatArray, u: float) -> IntArray:
    """Which of its next states, from the best on, a uniform leads each state to, shape (D + 2,)."""
    return np.asarray(np.minimum((cumulative <= u).sum(axis=1), len(cumulative) - 1))
