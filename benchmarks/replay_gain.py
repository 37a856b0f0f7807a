"""What martingale terms and replayed surrogates save, by replication in the twin.

    python -m benchmarks.replay_gain [REPLICATIONS]

Prints, per AV and method, n·Var/μ² of the estimates over replications of 2,000 tests, and how often the 90 % intervals
cover the estimate of all tests together: as reported, and from regression residuals alone.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.stats import norm

from harness.campaign.models import AutomatedVehicle, Campaign, FVDMParameters, Method, Reaction
from harness.estimators.accumulator import Accumulator
from harness.estimators.block import Block
from harness.estimators.from_records import block_from_tables
from harness.estimators.martingale import Martingale
from harness.estimators.nade import Nade
from harness.estimators.replay import Replay
from harness.importance.build import mixture_weights, needs_tables
from harness.pool.storage import campaign_pool
from harness.pool.surrogate_replay import SurrogateReplay
from harness.records.tables import episodes_table
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.twin import TwinWorld

TESTS = 2_000
REPLICATIONS = 150
CONFIDENCE = 0.9
SEED = 20240917
IDM = AutomatedVehicle()
ROWS: list[tuple[str, AutomatedVehicle, Method]] = [
    ("default IDM", IDM, "forced"),
    ("IDM 0.6 s late", AutomatedVehicle(reaction=Reaction(delay_s=0.6)), "forced"),
    ("SM-II", AutomatedVehicle(model="fvdm", parameters=FVDMParameters(min_acceleration_mps2=-1.0)), "forced"),
    ("default IDM", IDM, "episode_mixture"),
    ("default IDM", IDM, "step_mixture"),
]


def drive(av: AutomatedVehicle, method: Method, n: int) -> Block:
    """Tests of an AV, with surrogates asked about each."""
    plain = Campaign(name="gain", seed=SEED, av=av)
    campaign = plain.model_copy(update={"testing": plain.testing.model_copy(update={"method": method})})
    ready = prepare(resolve(campaign))
    table = episodes_table(ready.loop(TwinWorld(256)).run(0, ready.states(0, n)), SEED)
    return block_from_tables(
        table,
        None,
        method=method,
        alpha=mixture_weights(campaign),
        n_martingale=len(campaign.surrogates) if needs_tables(campaign) else 0,
        surrogates=SurrogateReplay(resolve(campaign), campaign_pool(resolve(campaign))),
    )


def replications(block: Block, make: type[Accumulator], truth: float) -> tuple[float, float, float]:
    """Relative variance per test, coverage as reported, and coverage of the residuals' standard error."""
    rates, covered, covered_by_residuals = [], 0, 0
    z = float(norm.isf((1.0 - CONFIDENCE) / 2.0))
    for first in range(0, len(block), TESTS):
        state = make()
        state.add(block.take(slice(first, first + TESTS)))
        found = state.result(CONFIDENCE)
        rates.append(found.crash_rate)
        covered += found.ci_low <= truth <= found.ci_high
        error = found.details.get("residual_std_error", found.std_error)
        covered_by_residuals += abs(found.crash_rate - truth) <= z * error
    n = len(rates)
    return TESTS * float(np.var(rates, ddof=1)) / truth**2, covered / n, covered_by_residuals / n


def main(n_replications: int) -> None:
    """Print the rows."""
    print(f"{n_replications} replications of {TESTS:,} tests")
    for name, av, method in ROWS:
        block = drive(av, method, TESTS * n_replications)
        whole = Replay()
        whole.add(block)
        truth = whole.result(CONFIDENCE).crash_rate
        estimators: list[type[Accumulator]] = [Nade, Replay, *([Martingale] if block.martingale is not None else [])]
        for make in estimators:
            variance, covered, residuals = replications(block, make, truth)
            print(f"{name:15} {method:16} {make.name:10} {variance:8.3g} {covered:6.2f} {residuals:6.2f}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else REPLICATIONS)
