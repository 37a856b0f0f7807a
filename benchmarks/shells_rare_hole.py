"""What stopping costs shells when the vehicle has a rare hole: bias and coverage of campaigns on the default pool.

    python -m benchmarks.shells_rare_hole [REPLICATIONS] [testing.shells.first_tests=6 ...]

The vehicle crashes as the default IDM does inside the boundary, and in a small share of the cut-ins outside. Shell
probabilities are those of the pool and taken as exact; allocation, rounds, stop rule and estimator are those of a
campaign; the tests of a shell are replaced by a binomial number. Prints the numbers of docs/estimators.md.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.contenders import SCENARIOS
from harness.campaign.files import load_campaign
from harness.pool.build import campaign_pool
from harness.pool.shells import design_shells
from harness.resolved import resolve
from studies.replication.shells import FREE, DrawnPool, ShellCampaign

IDM = {"brakes-8": 1.0, "brakes-5": 1.0, "brakes-3": 0.362}
"""Crash shares of the default IDM inside: in the run of docs/limits.md 1,086 of 3,000 tests crashed in brakes-3."""
HOLES = (0.0, 0.001, 0.003, 0.01)
ASKED = ((0.3, 0.9), (0.3, 0.95), (0.3, 0.99), (2.0, 0.9))
"""RHW and confidence."""
SEED = 20_240


def _same(drawn: list[DrawnPool], _: np.random.Generator) -> list[DrawnPool]:
    return drawn


def main(replications: int, overrides: list[str]) -> None:
    """Print the table."""
    settings = ["stop.min_crashes=null", "testing.shells.first_tests=null", "stop.episodes=1e6", *overrides]
    pool = campaign_pool(resolve(load_campaign(SCENARIOS / "overtaking_shells.yaml", settings)))
    design = replace(design_shells(pool, 2.0), n_paths=10**12).without_references()
    print("| crashes outside | asked RHW | confidence | median tests | bias | covers |")
    print("| --- | --- | --- | --- | --- | --- |")
    for rhw, confidence in ASKED:
        campaign = load_campaign(
            SCENARIOS / "overtaking_shells.yaml", [*settings, f"stop.rhw={rhw}", f"stop.confidence={confidence}"]
        )
        for hole in HOLES:
            share = np.array([IDM.get(name, 0.0) for name in design.strata])
            share[-1] = hole
            truth, one_path = float(design.p @ share), design.p[None]
            drawn = [DrawnPool(design, one_path, one_path * share)]  # the same each time, without error of its own
            repeated = ShellCampaign(campaign, partial(_same, drawn), SEED)
            rows = [row for row in repeated.run(range(replications)) if row.result == FREE]
            rate = np.array([row.crash_rate for row in rows])
            error = rate.std(ddof=1) / truth / np.sqrt(replications)
            covers = np.mean([row.ci_low <= truth <= row.ci_high for row in rows])
            tests = np.median([row.n_tests for row in rows])
            bias = f"{100 * (rate.mean() / truth - 1):+.1f} % ± {100 * error:.1f} %"
            print(f"| {hole:.1%} | {rhw:g} | {confidence:g} | {tests:,.0f} | {bias} | {covers:.3f} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2_000, sys.argv[2:])
