"""In which rounds a campaign's shards are run, and when its stop rule looks.

Most methods know all their episodes beforehand: one round. Shells decide from each round what the next one tests, so
that a round is run to its end before the next begins, whatever the number of workers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from harness.arrays import IntArray
from harness.campaign.models import Campaign, EstimatorName
from harness.estimators import Shells, StopRule
from harness.estimators.both_ways import BothWays
from harness.estimators.estimate import Estimate
from harness.pool.prescribed import Draw, PrescribedEpisodes
from harness.runner.allocation import Allocation
from harness.runner.shards import shard_specs
from harness.runner.worker import ShardSpec

MOST_SHARDS_PER_ROUND = 16
SMALLEST_SHARD = 64


class Rule(Protocol):
    """When to look, and when to stop."""

    estimator: EstimatorName
    reached: bool
    rhw: float
    heaviest: float
    pool_too_rough: bool
    waited_for: tuple[str, ...]

    def due(self, n: int) -> bool:
        """Whether to look after ``n`` episodes."""
        ...

    def observe(self, n: int, estimate: Estimate) -> bool:
        """Whether to stop after this look."""
        ...


class Counts(Protocol):
    """What rounds need of the finished prefix."""

    sums: BothWays
    n_episodes: int


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
    look : int
        Number of tests at the end of the round, when to look.
    of_first_tests : bool
        Whether the round brings the tests that every shell gets before anything is decided about it.
    waited_for : tuple of str
        See `StopRule`.
    """

    estimator: EstimatorName = "shells"

    def __init__(self, campaign: Campaign, held: int = 0) -> None:
        self._held = held
        self._target = campaign.stop.rhw
        self._min_crashes = campaign.min_crashes
        self._first_tests = campaign.testing.shells.first_tests
        self._conditional = campaign.testing.shells.statement == "conditional"
        self.reached = self.pool_too_rough = False
        self.rhw = float("inf")
        self.heaviest = 0.0  # limits within shells allow for every crash that has not been seen
        self.look = 0
        self.of_first_tests = False
        self.waited_for: tuple[str, ...] = ()

    def due(self, n: int) -> bool:
        """See `Rule`."""
        return n == self.look

    def observe(self, n: int, estimate: Estimate) -> bool:
        """See `Rule`."""
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
        self.pool_too_rough = watched["rhw_from_pool_at_least"] > self._target
        hopeless = self.pool_too_rough and watched["rhw_from_pool"] ** 2 >= POOL_SHARE * self.rhw**2
        return self.reached or (hopeless and n >= self._held)


def stop_rule(campaign: Campaign, held: int = 0) -> StopRule | RoundRule:
    """The rule that watches a campaign, whose folder holds ``held`` tests already."""
    if campaign.testing.method == "shells":
        return RoundRule(campaign, held)
    return StopRule(campaign.stop, campaign.testing.method, campaign.run.shard_size, min_crashes=campaign.min_crashes)


def rounds(
    campaign: Campaign, prescribed: PrescribedEpisodes | None, prefix: Counts, rule: StopRule | RoundRule
) -> Iterator[Iterator[ShardSpec]]:
    """Shards of each round; the next round is asked for when ``prefix`` holds the last one."""
    if prescribed is None or not isinstance(rule, RoundRule):
        yield shard_specs(campaign)
        return
    shells = campaign.testing.shells
    allocation = Allocation(
        prescribed.design, shells.first_tests, prescribed.draws.available, shells.statement == "conditional"
    )
    tests = crashes = failed = np.zeros(prescribed.design.p.size, np.int64)
    n_shards = 0
    while True:
        if isinstance(prefix.sums.seen, Shells) and prefix.n_episodes:
            tests, crashes, failed = prefix.sums.seen.tests, prefix.sums.seen.crashes, prefix.sums.seen.failed
        added = allocation.next_round(tests, crashes, campaign.stop.episodes - prefix.n_episodes, failed)
        if not added.any():
            return
        rule.of_first_tests = bool(np.any(tests[added > 0] < shells.first_tests))
        rule.look = prefix.n_episodes + int(added.sum())
        specs = round_specs(tests, added, n_shards, prefix.n_episodes, campaign.run.shard_size)
        n_shards += len(specs)
        yield iter(specs)


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
