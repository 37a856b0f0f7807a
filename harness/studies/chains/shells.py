"""Pools and shells of an exact chain: paths before the cut-in are drawn, all that can follow is known exactly."""

from __future__ import annotations

import numpy as np

from harness.arrays import FloatArray
from harness.pool.cut_ins import shells_of
from harness.strata import OUTSIDE, ShellDesign
from harness.studies.chains.chain import Chain
from harness.studies.chains.outcomes import joint_outcomes
from harness.studies.chains.sampler import approach_paths


class ChainShells:
    """Source of a chain's pools; all surrogates are inside.

    Parameters
    ----------
    chain : Chain
    pool_paths : int
        Paths of a pool.

    Attributes
    ----------
    order : ndarray, shape (J,)
        Surrogates from careful to careless.
    """

    def __init__(self, chain: Chain, pool_paths: int) -> None:
        self._chain, self._pool_paths = chain, pool_paths
        joint = joint_outcomes(chain)
        self.order = np.argsort([chain.surrogate_rate(j) for j in range(chain.n_surrogates)], kind="stable")
        shell = shells_of(np.arange(1 << chain.n_surrogates), self.order)
        n_shells = chain.n_surrogates + 1
        by_shell = np.stack([joint[:, :, shell == s].sum(axis=2) for s in range(n_shells)], axis=2)
        self._shell = by_shell.sum(axis=3)  # (horizon, G, S)
        self._crash = by_shell[..., 1]

    def _exact(self, table: FloatArray) -> FloatArray:
        """Probability per test of what a table (horizon, G, S) says given a cut-in, shape (S,)."""
        chain, state = self._chain, self._chain.start
        total = np.zeros(table.shape[2])
        for t in range(chain.horizon):
            total += (state * chain.hazard) @ table[t]
            state = (state * (1.0 - chain.hazard)) @ chain.approach
        return total

    @property
    def crashes_outside(self) -> float:
        """See `harness.studies.shell_source.ShellSource`."""
        return float(self.crash_p[-1]) / self._chain.crash_rate

    @property
    def shell_p(self) -> FloatArray:
        """Exact probability of each shell, shape (S,)."""
        return self._exact(self._shell)

    @property
    def crash_p(self) -> FloatArray:
        """Exact probability of a crash in each shell, shape (S,)."""
        return self._exact(self._crash)

    def draw(self, rng: np.random.Generator) -> tuple[ShellDesign, FloatArray]:
        """See `harness.studies.shell_source.ShellSource`."""
        chain = self._chain
        path = approach_paths(chain, self._pool_paths, rng)
        hazard = chain.hazard[path]
        cut = hazard * np.cumprod(np.column_stack([np.ones(len(path)), 1.0 - hazard[:, :-1]]), axis=1)
        t = np.arange(chain.horizon)
        mass = np.einsum("nt,nts->ns", cut, self._shell[t, path])
        crash = np.einsum("nt,nts->s", cut, self._crash[t, path]) / len(path)
        names = (*(f"surrogate {j}" for j in self.order), OUTSIDE)
        p = mass.mean(0)
        design = ShellDesign(
            pool="drawn",
            strata=names,
            p=p,
            moments=mass.T @ mass / len(path),
            n_paths=len(path),
            n_inside=chain.n_surrogates,
            boundary=names[-2],
            p_cut_in=float(p.sum()),
            p_impossible=0.0,
        )
        share = np.divide(crash, p, out=np.zeros_like(p), where=p > 0.0)
        return design, np.clip(share, 0.0, 1.0)  # rounding may leave the unit interval
