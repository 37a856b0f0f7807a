"""How far stopping on a loose precision biases the rate of shells: bias and coverage by the asked RHW.

    python -m benchmarks.shells_stopping [REPLICATIONS]

Exact chains of scenarios/validate/chains_shells.yaml, with pools of 16,384 paths, stopped by the real rule. Prints the
table of docs/estimators.md.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from benchmarks.contenders import SCENARIOS
from harness.campaign.campaign import Campaign
from harness.campaign.sections import Stop
from harness.progress import Progress
from studies.replication.experiment import Experiment, load_experiment
from studies.replication.run import validate
from studies.replication.shells import FREE

BUDGET = 1_000_000


def stopped_at(experiment: Experiment, rhw: float) -> Experiment:
    """The experiment with the online rule."""
    campaign: Campaign = experiment.campaign.model_copy(update={"stop": Stop(episodes=BUDGET, rhw=rhw)})
    population = experiment.super_population.model_copy(update={"pool_paths": 16_384})
    return experiment.model_copy(update={"campaign": campaign, "super_population": population})


def main(replications: int) -> None:
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
