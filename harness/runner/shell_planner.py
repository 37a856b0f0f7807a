"""Which shells a campaign tests next, and when it is enough.

Shells decide from each round what the next one tests, so that a round is run to its end before the next begins,
whatever the number of workers; the result is looked at between rounds.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from harness.arrays import IntArray
from harness.campaign.models import Campaign
from harness.estimators import Shells
from harness.estimators.block import Block
from harness.estimators.both_ways import BothWays
from harness.estimators.estimate import Estimate
from harness.pool.shells import Draw
from harness.runner.allocation import Allocation
from harness.runner.worker import ShardSpec
from harness.strata import ShellDesign

MOST_SHARDS_PER_ROUND = 16
SMALLEST_SHARD = 64
POOL_SHARE = 0.5
"""Share of the squared width from the pool's own error above which more tests hardly narrow an interval."""


class RoundRule:
    """Looks after each round, and is content with one pass: looks are 1.25 apart, not 1.1.

    That limits within shells are exact at a fixed number of tests says nothing about the number at which a rule stops;
    that intervals cover there, and how far the rate is biased, is measured (docs/estimators.md).

    Parameters
    ----------
    campaign : Campaign
    held : int
        Tests that the run folder holds: before them nothing is given up, whatever precision is asked for now.

    Attributes
    ----------
    of_first_tests : bool
        Whether the round brings the tests that every shell gets before anything is decided about it.
    waited_for : tuple of str
        See `StopRule`.
    """

    def __init__(self, campaign: Campaign, held: int = 0) -> None:
        self._held = held
        self._target = campaign.stop.rhw
        self._min_crashes = campaign.min_crashes
        self._first_tests = campaign.testing.shells.first_tests
        self._conditional = campaign.testing.shells.statement == "conditional"
        self.reached = self.pool_error_above_target = False
        self.rhw = float("inf")
        self.heaviest = 0.0  # limits within shells allow for every crash that has not been seen
        self.of_first_tests = False
        self.waited_for: tuple[str, ...] = ()

    def observe(self, estimate: Estimate) -> bool:
        """Whether to stop at the end of a round, with this estimate from all tests so far."""
        watched = estimate.details["conditional"] if self._conditional else {"rhw": estimate.rhw, **estimate.details}
        self.rhw = watched["rhw"]
        if self._target is None:
            return False
        met = {
            f"stop.rhw ({self._target:g})": self.rhw <= self._target,
            f"stop.min_crashes ({self._min_crashes:,})": estimate.n_crashes >= self._min_crashes,
        }
        missing = tuple(condition for condition, is_met in met.items() if not is_met)
        if missing:
            self.waited_for = missing
        elif self.of_first_tests:
            self.waited_for = (f"testing.shells.first_tests ({self._first_tests:,} of each shell)",)
        if estimate.n_crashes < self._min_crashes:
            return False
        self.reached = not missing
        self.pool_error_above_target = watched["rhw_from_pool_at_least"] > self._target
        hopeless = self.pool_error_above_target and watched["rhw_from_pool"] ** 2 >= POOL_SHARE * self.rhw**2
        return self.reached or (hopeless and estimate.n_episodes >= self._held)


class ShellPlanner:
    """Fed with finished tests in order; says what is tested next, and when it is enough.

    Parameters
    ----------
    campaign : Campaign
    design : ShellDesign
    available : ndarray, shape (S,)
        Most tests of each stratum.
    held : int
        See `RoundRule`.

    Attributes
    ----------
    rule : RoundRule
    estimate : Estimate or None
        At the end of the last round.
    """

    def __init__(self, campaign: Campaign, design: ShellDesign, available: IntArray, held: int = 0) -> None:
        shells = campaign.testing.shells
        self.rule = RoundRule(campaign, held)
        self.estimate: Estimate | None = None
        self._campaign = campaign
        self._allocation = Allocation(design, shells.first_tests, available, shells.statement == "conditional")
        self._none = np.zeros(design.p.size, np.int64)
        self._seen = Shells()
        self._sums = BothWays(self._seen)
        self._n_episodes = self._look = 0

    @property
    def tests(self) -> IntArray:
        """Tests of each stratum so far, shape (S,)."""
        return self._seen.tests if self._n_episodes else self._none

    def next_round(self) -> IntArray:
        """Tests to add per stratum, shape (S,); all 0 when no stratum or no budget is left."""
        crashes, failed = (self._seen.crashes, self._seen.failed) if self._n_episodes else (self._none, self._none)
        budget = self._campaign.stop.episodes - self._n_episodes
        added = self._allocation.next_round(self.tests, crashes, budget, failed)
        self.rule.of_first_tests = bool(np.any(self.tests[added > 0] < self._campaign.testing.shells.first_tests))
        self._look = self._n_episodes + int(added.sum())
        return added

    def rounds(self) -> Iterator[Iterator[ShardSpec]]:
        """Shards of each round; the next round is asked for when all of the last one have been added."""
        n_shards = 0
        while (added := self.next_round()).any():
            specs = round_specs(self.tests, added, n_shards, self._n_episodes, self._campaign.run.shard_size)
            n_shards += len(specs)
            yield iter(specs)

    def add(self, block: Block) -> bool:
        """Add the tests of the next shard; True when the campaign is to stop."""
        self._sums.add(block)
        self._n_episodes += len(block)
        if self._n_episodes != self._look:
            return False
        self.estimate = self._sums.result(self._campaign.stop.confidence)
        return self.rule.observe(self.estimate)


def round_specs(tests: IntArray, added: IntArray, index: int, first_episode: int, shard_size: int) -> list[ShardSpec]:
    """Divide a round into shards, each a range of the round's tests in the order of strata.

    Parameters
    ----------
    tests, added : ndarray, shape (S,)
        Draws taken so far, and those of the round.
    index, first_episode : int
        Of the first shard.
    shard_size : int
        Most episodes of a shard.
    """
    total = int(added.sum())
    n_shards = max(-(-total // shard_size), min(MOST_SHARDS_PER_ROUND, total // SMALLEST_SHARD), 1)
    edges = np.linspace(0, total, n_shards + 1).round().astype(np.int64)
    begins = np.concatenate([[0], np.cumsum(added)])
    specs = []
    for k, (low, high) in enumerate(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)):
        draws = []
        for s in range(added.size):
            begin, end = max(low, int(begins[s])), min(high, int(begins[s + 1]))
            if begin < end:
                draws.append(Draw(s, int(tests[s]) + begin - int(begins[s]), end - begin))
        specs.append(ShardSpec(index + k, first_episode + low, high - low, tuple(draws)))
    return specs
