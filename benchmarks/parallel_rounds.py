"""How many workers a campaign of shells can feed, where a test takes long: by simulation of its rounds.

    python -m benchmarks.parallel_rounds [REPLICATIONS]

The default IDM, assumption-free, RHW 0.3, on the shipped pool; allocation, rounds and stop rule are those of a campaign
and the tests of a shell are a binomial number. A round's shards go to workers as they become idle, and the next round
begins when all have ended. Times of tests vary by a half around their mean (assumed); one process hands shards out and
takes them back. Prints the table of docs/internals/performance.md.
"""

from __future__ import annotations

import heapq
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from benchmarks.contenders import SCENARIOS
from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import RoundRule
from harness.pool.build import campaign_pool
from harness.pool.shells import design_shells
from harness.resolved import resolve
from harness.sampling.shells import ShellRounds, round_requests
from harness.vocabulary import FloatArray
from studies.replication.shells import DrawnPool

IDM = {"brakes-8": 1.0, "brakes-5": 1.0, "brakes-3": 0.362}
"""Crash shares of the default IDM inside: in the run of docs/limits.md 1,086 of 3,000 tests crashed in brakes-3."""
WORKERS = (8, 64, 512)
TEST_S = (0.01, 1.0, 20.0)
ROUNDS = ((5_000, 1), (1, 1), (1, 64), (1, 128), (1, 512))
"""run.shard_size and testing.shells.smallest_round."""
HANDLING_S = 0.0005
"""CPU time of a shard in the process that writes: measured in the twin, 1,218 shards of one test against 33 of many."""
SETTINGS = ("stop.min_crashes=null", "testing.shells.first_tests=null", "stop.rhw=0.3", "stop.episodes=1e5")


def drawn_pool(campaign: Campaign) -> DrawnPool:
    """The shipped pool, taken as exact, with the default IDM's shares of crashes."""
    design = replace(design_shells(campaign_pool(resolve(campaign)), 2.0), n_paths=10**12)
    design = design.without_references()
    share = np.array([IDM.get(name, 0.0) for name in design.strata])
    return DrawnPool(design, design.p[None], (design.p * share)[None])


def rounds_of(campaign: Campaign, pool: DrawnPool, rng: np.random.Generator) -> list[list[int]]:
    """Tests of each shard of each round until the stop rule is content."""
    available = np.full(pool.design.p.size, campaign.pool.events_per_shell, np.int64)
    planner, seen = ShellRounds(campaign, pool.design, available, RoundRule(campaign)), SeenShells(pool.design)
    rounds, enough = [], False
    while not enough and (added := planner.next_round(seen)[0]).any():
        tests = seen.tally.tests
        specs = round_requests(tests, added, 0, int(tests.sum()), campaign.run.smallest_shard)
        rounds.append([spec.n_episodes for spec in specs])
        pool.count(added, seen, rng)
        enough = planner.rule.observe(seen)
    return rounds


def round_seconds(shards: Sequence[int], workers: int, test_s: float, rng: np.random.Generator) -> float:
    """Time (s) of a round: each shard to the worker that is idle first, handed out and taken back one by one."""
    idle_s = [0.0] * workers
    handled_s = 0.0
    for n_tests in shards:
        times_s: FloatArray = test_s * rng.uniform(0.5, 1.5, n_tests)
        handled_s += HANDLING_S
        heapq.heapreplace(idle_s, max(idle_s[0], handled_s) + float(times_s.sum()))
    return max(idle_s)


def main(replications: int) -> None:
    """Print the table."""
    campaigns = [
        load_campaign(
            SCENARIOS / "overtaking_shells.yaml",
            [*SETTINGS, f"run.shard_size={size}", f"testing.shells.smallest_round={smallest}"],
        )
        for size, smallest in ROUNDS
    ]
    pool, rng = drawn_pool(campaigns[0]), np.random.default_rng(2026)
    drawn = [[rounds_of(campaign, pool, rng) for _ in range(replications)] for campaign in campaigns]
    tests = [float(np.median([sum(map(sum, rounds)) for rounds in found])) for found in drawn]
    heads = (f"{size:,}, {smallest}" for size, smallest in ROUNDS)
    print(f"| workers, test | {' | '.join(heads)} |\n|{' --- |' * (1 + len(ROUNDS))}")
    sizes = (f"{n:,.0f}, {_rounds(found):.0f}" for n, found in zip(tests, drawn, strict=True))
    print(f"| tests, rounds | {' | '.join(sizes)} |")
    for test_s, workers in product(TEST_S, WORKERS):
        cells = []
        for found in drawn:
            walls_s = [sum(round_seconds(shards, workers, test_s, rng) for shards in rounds) for rounds in found]
            wall_s = float(np.median(walls_s))
            cells.append(f"{wall_s:,.0f} s, {tests[0] * test_s / (workers * wall_s):.0%}")
        print(f"| {workers}, {test_s:g} s | {' | '.join(cells)} |")


def _rounds(found: Sequence[list[list[int]]]) -> float:
    return float(np.median([len(rounds) for rounds in found]))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
