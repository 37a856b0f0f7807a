"""How often the 90 % intervals of `nade` and of the published `scv` hold the truth, by replication on exact chains.

    python -m benchmarks.scv_coverage [REPLICATIONS]

Prints the table of docs/scv-defect.md. Both estimators see the same data; the truth is known by backward induction.
"""

from __future__ import annotations

import sys

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import Estimate
from harness.estimators.scv import Scv
from harness.estimators.weighted import Nade
from studies.chains.chain import DECISIVE
from studies.chains.sampler import draw

SETTINGS = [(chain, n) for chain in DECISIVE for n in (2_000, 20_000)]
SEED = 5
COLUMNS = ("crash_rate", "std_error", "ci_low", "ci_high")


def estimate(state: Nade | Scv, block: Block) -> Estimate:
    """What an estimator says of one sample."""
    state.add(block)
    return state.result(0.9)


def main(replications: int) -> None:
    print("| crash rate | tests | true relvar | nade: claimed | covers | scv: claimed | covers | largest difference |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for chain, n in SETTINGS:
        truth, relvar = chain.crash_rate, chain.step_mixture_variance / chain.crash_rate**2
        drawn = (draw(chain, "step_mixture", n, np.random.default_rng([SEED, k])) for k in range(replications))
        found = [[estimate(Nade(), block), estimate(Scv(), block)] for block in drawn]
        rate, error, low, high = (np.array([[getattr(e, name) for e in pair] for pair in found]) for name in COLUMNS)
        claimed = np.mean(error**2, axis=0) * n / truth**2
        covers = np.mean((low <= truth) & (truth <= high), axis=0)
        difference = float(np.max(np.abs(rate[:, 1] / rate[:, 0] - 1.0)))
        print(
            f"| {truth:.2e} | {n:,} | {relvar:.2f} | {claimed[0]:.2f} | {covers[0]:.3f} "
            f"| {claimed[1]:.2f} | {covers[1]:.3f} | {difference:.0e} |"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000)
