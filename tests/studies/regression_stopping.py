"""A wrong method, to be caught: stop as soon as the residuals of a regression on replayed surrogates are small.

Forced cut-ins; each surrogate k is replayed on the same maneuvers, so that W·f_k − μ_k has mean 0 exactly. Regressing
Y on these columns leaves small residuals while the rare disagreements have not been met: the interval is narrow too
early.
"""

from __future__ import annotations

import numpy as np

from harness.studies.chains.chain import Chain
from harness.studies.chains.sampler import approach_paths
from harness.studies.chains.shells import joint_outcomes
from harness.studies.judgement import Row

Z = 1.6449
FIRST_LOOK, GROWTH, LAST_LOOK = 40, 1.25, 20_000
WANTED = 0.3


class RegressionStopping:
    """A campaign to repeat."""

    def __init__(self, chain: Chain, seed: int) -> None:
        self._chain, self._seed = chain, seed
        joint = joint_outcomes(chain)
        self._cumulative = np.cumsum(joint.reshape(chain.horizon, len(chain.start), -1), axis=2)

    def draw(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Y (n,) and W·f_k − μ_k (n, J)."""
        chain = self._chain
        path = approach_paths(chain, n, rng)
        hazard = chain.hazard[path]
        alive = np.cumprod(np.column_stack([np.ones(n), 1.0 - hazard[:, :-1]]), axis=1)
        cut = np.cumsum(hazard * alive, axis=1)
        weight = cut[:, -1]
        t = (cut <= (rng.random(n) * weight)[:, None]).sum(axis=1)
        which = (self._cumulative[t, path[np.arange(n), t]] <= rng.random(n)[:, None]).sum(axis=1)
        which = np.minimum(which, self._cumulative.shape[2] - 1)
        bits = (which[:, None] // 2 >> np.arange(chain.n_surrogates)) & 1
        return weight * (which % 2), weight[:, None] * bits - chain.surrogate_rates

    def run(self, replications: range) -> list[Row]:
        return [self._one(r) for r in replications]

    def _one(self, replication: int) -> Row:
        rng = np.random.default_rng([self._seed, replication])
        y, h = self.draw(FIRST_LOOK, rng)
        while True:
            x = np.column_stack([np.ones(len(y)), h])
            beta, *_ = np.linalg.lstsq(x, y, rcond=None)
            rate, residual = float(beta[0]), y - x @ beta
            error = float(residual.std(ddof=x.shape[1])) / np.sqrt(len(y))
            reached = rate > 0.0 and Z * error <= WANTED * rate and np.count_nonzero(y) >= 10
            if reached or len(y) >= LAST_LOOK:
                half = Z * error
                crashes = int(np.count_nonzero(y))
                return Row("regression", replication, len(y), crashes, rate, error, rate - half, rate + half, reached)
            more_y, more_h = self.draw(int(len(y) * (GROWTH - 1.0)) + 1, rng)
            y, h = np.concatenate([y, more_y]), np.concatenate([h, more_h])
