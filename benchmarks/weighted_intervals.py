"""What intervals of weighted crashes are worth, at a fixed number of tests and where campaigns stop on them.

    python -m benchmarks.weighted_intervals [REPLICATIONS]

Drives large samples in the twin once, and draws campaigns from them: their own means are the truth. Prints the
numbers of docs/estimators.md, with the normal interval and the reported one; the stop rule with the known weight cap,
and with the largest weight seen in its place.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.sections import Stop
from harness.estimators.block import Block, SamplingPlan
from harness.estimators.estimate import Estimate
from harness.estimators.likelihood import Level
from harness.estimators.stopping import StopRule
from harness.estimators.weighted import Nade
from harness.vocabulary import CRASH, FloatArray, Method
from studies.replication.weighted import twin_episodes

CONFIDENCE = 0.9
SEED = 77
CHUNK = 20_000
STOP = Stop(episodes=400_000, rhw=0.3)
SHARD_ENDS = range(500, 400_500, 500)
SM_II: dict[str, object] = {"model": "fvdm", "parameters": {"min_acceleration_mps2": -1.0}}


@dataclass(frozen=True, eq=False)
class Population:
    """Weighted crashes of many tests: their share of the tests, mean of Y, and the largest weight by design."""

    name: str
    weights: FloatArray
    crash_share: float
    rate: float
    cap: float

    def campaign(self, rng: np.random.Generator, n: int, state: Nade) -> Estimate:
        """Estimate after n more tests."""
        weights = self.weights[rng.integers(0, len(self.weights), rng.binomial(n, self.crash_share))]
        before = state.n
        state.add(_crashes(weights, self.cap))
        state.n = before + n
        return state.result(CONFIDENCE)


def _crashes(weights: FloatArray, cap: float) -> Block:
    n = len(weights)
    columns = {"cut_in": np.ones(n, np.bool_)}
    return Block(0, np.full(n, CRASH, np.int8), np.log(weights), columns, SamplingPlan("forced", weight_cap=cap))


def drive(name: str, av: dict[str, object], method: Method, n: int) -> Population:
    """Weighted crashes of an AV in the twin."""
    content = {"environment": {"parameters": "ndd-overtaking-1"}, "av": av, "testing": {"method": method}}
    campaign = Campaign.model_validate({"name": "intervals", **content})
    source, parts, nade = twin_episodes(campaign, SEED, ()), [], Nade()
    for first in range(0, n, CHUNK):
        block = source(first, CHUNK)
        nade.add(block)
        parts.append(np.exp(block.log_weight[block.crash]))
    weights = np.concatenate(parts)
    return Population(f"{name}, `{method}`", weights, len(weights) / n, nade.y.mean(nade.n), nade.cap()[0])


def fixed(population: Population, n: int, replications: int) -> str:
    """Row of the first table."""
    covered, widths, effective = np.zeros(2), [], []
    for k in range(replications):
        found = population.campaign(np.random.default_rng([SEED, n, k]), n, Nade())
        half = Level.two_sided(CONFIDENCE).z * found.std_error
        by_normal = abs(found.crash_rate - population.rate) <= half
        covered += [by_normal, found.ci_low <= population.rate <= found.ci_high]
        widths.append((found.ci_high - found.ci_low) / 2.0 / half)
        effective.append(found.n_effective)
    cells = " | ".join(f"{share:.3f}" for share in covered / replications)
    return f"| {population.name} | {n:,} | {np.median(effective):.0f} | {cells} | {np.median(widths):.1f} |"


def stopping(population: Population, replications: int, *, known: bool) -> str:
    """Row of the second table."""
    tests, rates, covered = [], [], 0
    for k in range(replications):
        rule, state, n = StopRule(STOP, SHARD_ENDS), Nade(), 0
        rng = np.random.default_rng([SEED, k])
        for look in rule.looks:
            found = population.campaign(rng, look - n, state)
            n = look
            seen = found.largest_weight_share * found.crash_rate * n
            if rule.observe(n, found if known else replace(found, weight_cap=seen, cautions=())):
                break
        tests.append(n)
        rates.append(found.crash_rate)
        covered += found.ci_low <= population.rate <= found.ci_high
    bias = np.mean(rates) / population.rate - 1.0
    cap = "known" if known else "largest weight seen"
    return f"| {population.name} | {cap} | {np.median(tests):,.0f} | {bias:+.1%} | {covered / replications:.3f} |"


def main(replications: int) -> None:
    """Print both tables."""
    idm = drive("default IDM", {"model": "idm"}, "forced", 2_000_000)
    careless = drive("SM-II", SM_II, "forced", 300_000)
    mixture = drive("default IDM", {"model": "idm"}, "episode_mixture", 400_000)
    print("| AV, method | tests | effective crashes | normal | as reported | its half-width over the normal one |")
    print("| --- | --- | --- | --- | --- | --- |")
    rows = [(idm, (500, 2_000, 6_300, 25_000, 100_000)), (careless, (400, 6_000)), (mixture, (400, 2_000))]
    for population, sizes in rows:
        for n in sizes:
            print(fixed(population, n, replications))
    print(
        "\n| AV, method | weight cap | median tests | bias | covers (nominal 0.900) |\n| --- | --- | --- | --- | --- |"
    )
    for population in (idm, careless):
        for known in (False, True):
            print(stopping(population, replications // 3, known=known))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3_000)
