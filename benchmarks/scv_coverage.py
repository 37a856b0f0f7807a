"""How often the 90 % intervals of `nade` and of the published `scv` hold the truth, by replication on exact chains.

    python -m benchmarks.scv_coverage [REPLICATIONS]

Prints the table of docs/scv-defect.md. Both estimators see the same data; the truth is known by backward induction.
"""

from __future__ import annotations

import sys

import numpy as np

from harness.estimators.nade import Nade
from harness.estimators.scv import Scv
from harness.studies.chains.named import frequent_decisive, rare_decisive
from harness.studies.chains.sampler import draw
from tests.chains.coverage import replicate

SETTINGS = [(frequent_decisive, 2_000), (frequent_decisive, 20_000), (rare_decisive, 2_000), (rare_decisive, 20_000)]


def main(replications: int) -> None:
    print("| crash rate | tests | true relvar | nade: claimed | covers | scv: claimed | covers | largest difference |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for make_chain, n in SETTINGS:
        chain = make_chain()
        truth = chain.crash_rate
        found = replicate(
            lambda rng, chain=chain, n=n: draw(chain, "step_mixture", n, rng),
            replications,
            seed=5,
            make={"nade": Nade, "scv": Scv},
        )
        nade, scv = found["nade"], found["scv"]
        relvar = chain.step_mixture_variance / truth**2
        difference = float(np.max(np.abs(scv.rate / nade.rate - 1.0)))
        print(
            f"| {truth:.2e} | {n:,} | {relvar:.2f} | {nade.claimed_relvar(truth, n):.2f} "
            f"| {nade.covered(truth) / replications:.3f} | {scv.claimed_relvar(truth, n):.2f} "
            f"| {scv.covered(truth) / replications:.3f} | {difference:.0e} |"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000)
