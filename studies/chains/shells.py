"""Pools and shells of an exact chain: paths before the cut-in are drawn, all that can follow is known exactly.

After a cut-in the vehicle under test and its surrogates begin in the same state of danger and meet the same maneuvers
of the BV. Their noise is *shared* (the same uniform in each step: where one escapes a more skilled one does too),
*opposite* (the surrogates see one minus it) or their *own*. Backward induction over the joint state gives the
probability of every combination of crashes.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from harness.pool.shells import shells_of
from harness.strata import OUTSIDE, ShellDesign
from harness.vocabulary import FloatArray
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
            boundary=names[-2],
            assumes="crashes only inside",
            n_inside=chain.n_surrogates,
            p_event=float(p.sum()),
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
    n, width = chain.n_surrogates + 1, chain.crashed + 1
    crashed = np.indices((width,) * n) == chain.crashed  # (n, …): the vehicle, then its surrogates, in each joint state
    value = np.eye(1 << n)[np.tensordot(1 << np.arange(n), crashed, axes=1)].reshape(*(width,) * n, -1, 2)
    joint = np.zeros((chain.horizon, len(chain.start), 1 << chain.n_surrogates, 2))
    for t in range(chain.horizon - 1, -1, -1):
        joint[t] = np.einsum("gd,dmc->gmc", chain.entry, value[(np.arange(width),) * n])
        value = np.asarray(sum(p * _step_back(chain, a, value) for a, p in enumerate(chain.exposure[0])))
    return joint


def _step_back(chain: Chain, maneuver: int, value: FloatArray) -> FloatArray:
    """Values one step earlier, if the BV takes a maneuver; safe and crashed stay."""
    absorbing = np.eye(chain.crashed + 1)[-2:]
    tables = [np.vstack([each[:, maneuver], absorbing]) for each in (chain.response, *chain.surrogate_responses)]
    if chain.noise == "own":
        for axis, table in enumerate(tables):
            value = np.moveaxis(np.tensordot(table, value, axes=(1, axis)), 0, axis)
        return value
    # The uniform is cut where any vehicle's next state changes; within a piece all next states are certain.
    best_first = np.array([chain.crashed - 1, *range(chain.crashed - 1), chain.crashed])  # danger from low to high
    cumulative = np.cumsum(np.stack(tables)[:, :, best_first], axis=2)
    mirrored = ((np.arange(len(tables)) > 0) & (chain.noise == "opposite")).reshape(-1, 1, 1)
    edges = np.where(mirrored, 1.0 - cumulative, cumulative)
    result = np.zeros_like(value)
    for low, high in pairwise(np.unique(np.clip([0.0, 1.0, *edges.ravel()], 0.0, 1.0)).tolist()):
        u = (low + high) / 2.0
        place = (cumulative <= np.where(mirrored, 1.0 - u, u)).sum(axis=2)
        result += (high - low) * value[np.ix_(*best_first[np.minimum(place, chain.crashed)])]
    return result
