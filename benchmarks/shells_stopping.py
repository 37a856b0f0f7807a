"""How far stopping on a loose precision, or at the end of a budget, biases the rate of shells: bias and coverage.

    python -m benchmarks.shells_stopping [REPLICATIONS]

By the asked RHW: exact chains of scenarios/validate/chains_shells.yaml, with pools of 16,384 paths, stopped by the real
rule. By the budget: strata to each of which a vehicle's crash rate owes as much, and most of which show few crashes or
none. Prints the tables of docs/estimators.md.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.contenders import SCENARIOS
from harness.campaign.campaign import Campaign
from harness.campaign.sections import Stop
from harness.estimators.tally import Tally, combined
from harness.progress import Progress
from harness.sampling.shells import FIRST_TESTS, LEVEL, Allocation
from studies.replication.experiment import Experiment, load_experiment
from studies.replication.run import validate
from studies.replication.shells import FREE

BUDGET = 1_000_000
P = np.append(10.0 ** np.arange(-6.0, -2.0, 0.5), 0.1)
"""Probabilities of strata, the last one outside the boundary."""
OF_EACH = 1e-6
"""Crash rate that each adds: tests of the first one always crash, of the last one once in 100,000."""
FIRST = np.full(P.size, FIRST_TESTS // P.size)


def stopped_at(experiment: Experiment, rhw: float) -> Experiment:
    """The experiment with the online rule."""
    campaign: Campaign = experiment.campaign.model_copy(update={"stop": Stop(episodes=BUDGET, rhw=rhw)})
    population = experiment.super_population.model_copy(update={"pool_paths": 16_384})
    return experiment.model_copy(update={"campaign": campaign, "super_population": population})


def at_budget(budget: int, rng: np.random.Generator) -> tuple[float, bool]:
    """Rate over the truth after so many tests, and whether the interval covers it."""
    counts = np.zeros((3, P.size), np.int64)
    allocation = Allocation(P, P.size - 1, FIRST, np.full(P.size, BUDGET))
    while (added := allocation.next_round(Tally.counted(*counts), budget - int(counts[0].sum()))).any():
        counts[:2] += added, rng.binomial(added, OF_EACH / P)
    found, truth = combined(P, Tally.counted(*counts), np.inf, LEVEL), OF_EACH * P.size
    return found.rate / truth, found.low <= truth <= found.high


def main(replications: int) -> None:
    print("| tests | bias | covers (nominal 0.900) |")
    print("| --- | --- | --- |")
    for budget in (1_000, 10_000, 100_000, 1_000_000):
        rng = np.random.default_rng(budget)
        rates, covers = np.transpose([at_budget(budget, rng) for _ in range(min(replications, 400))])
        print(f"| {budget:,} | {rates.mean() - 1.0:+.1%} ± {rates.std() / rates.size**0.5:.1%} | {covers.mean():.3f} |")
    experiment = load_experiment(SCENARIOS / "validate" / "chains_shells.yaml")
    experiment = experiment.model_copy(update={"replications": replications})
    print("| asked RHW | chain | median tests | bias | covers (nominal 0.900) |")
    print("| --- | --- | --- | --- | --- |")
    for rhw in (0.1, 0.3, 0.5, 1.0, 2.0):
        with tempfile.TemporaryDirectory() as folder:
            judgements = validate(stopped_at(experiment, rhw), Path(folder), None, Progress())
        for found in judgements:
            if found["result"] == FREE:
                row = "{subject} | {tests_median:,.0f} | {bias:+.1%} ± {bias_std_error:.1%} | {coverage:.3f}"
                print(f"| {rhw} | {row.format_map(found)} |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2_000)
