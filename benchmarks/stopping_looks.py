"""What looking costs: coverage, bias and overshoot of campaigns that stop on RHW, by ratio of the grid of looks.

    python -m benchmarks.stopping_looks [REPLICATIONS]

Naturalistic tests with a crash probability of 0.01 stop at RHW 0.1 (90 %), through the real rule and estimator.
Prints the numbers of docs/estimators.md.
"""

from __future__ import annotations

import sys

import numpy as np

from harness.campaign.sections import Stop
from harness.estimators.stopping import StopRule
from harness.estimators.weighted import Nde

RATE = 0.01
STOP = Stop(episodes=200_000, rhw=0.1, min_crashes=100)
SHARD_ENDS = range(200, 200_200, 200)


def stopped(rng: np.random.Generator, ratio: float) -> tuple[int, float, bool]:
    """Tests used, crash rate found, and whether the interval holds the truth."""
    rule, state = StopRule(STOP, SHARD_ENDS, ratio), Nde()
    for n in rule.looks:
        state.n_crashes += int(rng.binomial(n - state.n, RATE))
        state.n = n
        estimate = state.result(STOP.confidence)
        if rule.observe(n, estimate):
            break
    return n, estimate.crash_rate, estimate.ci_low <= RATE <= estimate.ci_high


def main(replications: int) -> None:
    print("| ratio | looks | mean tests | mean rate / truth | covers (nominal 0.900) |")
    print("| --- | --- | --- | --- | --- |")
    for ratio in (1.02, 1.1, 1.25):
        results = [stopped(np.random.default_rng([7, k]), ratio) for k in range(replications)]
        tests, rates, covered = map(np.array, zip(*results, strict=True))
        n_looks = len(StopRule(STOP, SHARD_ENDS, ratio).looks)
        print(f"| {ratio} | {n_looks} | {tests.mean():,.0f} | {rates.mean() / RATE:.3f} | {covered.mean():.3f} |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000)
