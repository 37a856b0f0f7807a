"""In which rounds and shards a campaign is tested (`allocation`: with which shells), and when it is enough.

Most methods know all their tests beforehand. Shells decide from each round what the next one tests, so that a round is
run to its end before the next begins, whatever the number of workers; the result is looked at between rounds. Rounds
grow geometrically, to where they narrow the interval most. That depends on counts alone, not on the stop rule or on
time: a run can be continued to a smaller RHW. First the strata inside the narrowest boundary are tested until what is
stated about them is roughly known; then those inside the next one, and at last all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from itertools import chain, pairwise

import numpy as np

from harness.campaign.campaign import Campaign
from harness.estimators import Shells, StopRule, accumulator
from harness.estimators.block import Block
from harness.estimators.likelihood import Level
from harness.estimators.pairs import PairCounts
from harness.estimators.stopping import PairRule, RoundRule, Rule
from harness.estimators.tally import Tally, empty_tally
from harness.pool.shells import Draw, PrescribedEpisodes
from harness.runner.allocation import CONFIDENCE, Allocation
from harness.runner.worker import ShardSpec
from harness.strata import ShellDesign
from harness.vocabulary import IntArray

MOST_SHARDS_PER_ROUND = 16
SMALLEST_SHARD = 64
BIASED_RHW = 0.5
"""Precision from which on stopping at the first interval biases the rate noticeably."""
TOO_WIDE = (
    f"A relative half-width above {BIASED_RHW:g} is reached by chance: stopping at the first such interval makes rates "
    "too high on the mean. Ask for a smaller stop.rhw, or for testing.shells.stopping: two_phase."
)
FIRST_PHASE = 1.7
"""Precision of the first of two phases over that of the second (measured: docs/estimators.md)."""


class Planner:
    """Says what is tested next, in rounds; by itself nothing, for tests that are planned elsewhere.

    ``rule`` says why it stops, ``reported_from`` is the first test of those that the answer is from (0 where all are),
    ``remark`` what the ending is to say besides; mostly nothing.
    """

    rule: Rule

    def __init__(self, rule: Rule) -> None:
        self.rule, self.reported_from, self.remark = rule, 0, ""

    def rounds(self) -> Iterator[Iterator[ShardSpec]]:
        """Shards of each round; the next round is asked for when all of the last one have been added."""
        return iter(())

    def add(self, block: Block) -> bool:  # noqa: ARG002 - nothing is decided
        """Add the tests of the next shard; True when the campaign is to stop."""
        return False


class FixedPlanner(Planner):
    """All tests are known beforehand, in one round; a stop rule looks at some of their shards."""

    rule: StopRule

    def __init__(self, campaign: Campaign) -> None:
        self._campaign = campaign
        stop, ends = campaign.stop, campaign.run.shard_ends(campaign.stop.episodes)
        super().__init__(StopRule(stop, campaign.testing.method, ends, min_crashes=campaign.min_crashes))
        self._sums = accumulator(self.rule.estimator)
        self._n_episodes = 0

    def rounds(self) -> Iterator[Iterator[ShardSpec]]:
        """See `Planner`."""
        yield known_specs(self._campaign)

    def add(self, block: Block) -> bool:
        """See `Planner`."""
        self._sums.add(block)
        self._n_episodes += len(block)
        if not self.rule.due(self._n_episodes):
            return False
        return self.rule.observe(self._n_episodes, self._sums.result(self._campaign.stop.confidence))


def known_specs(campaign: Campaign) -> Iterator[ShardSpec]:
    """Shards of a campaign all of whose tests are known beforehand."""
    total = campaign.stop.episodes
    edges = enumerate(pairwise(chain((0,), campaign.run.shard_ends(total))))
    return (ShardSpec(index, first, min(end, total) - first) for index, (first, end) in edges)


class ShellPlanner(Planner):
    """Fed with finished tests of shells in order; says what is tested next, and when it is enough.

    In two phases the tests up to a wider precision only plan the number of the others, which alone are reported: that
    number does not depend on their results.

    ``available``, shape (S,), are the most tests of each stratum, ``held`` see `RoundRule`; ``seen`` are the tests of
    this phase, ``drawn`` those of both, (S,); ``reported_from`` is the first test of the second phase, ``planned`` its
    tests, (S,), once they are.
    """

    rule: RoundRule

    def __init__(self, campaign: Campaign, design: ShellDesign, available: IntArray, held: int = 0) -> None:
        shells = campaign.testing.shells
        self._plans = shells.stopping == "two_phase" and campaign.stop.rhw is not None
        super().__init__(RoundRule(campaign, held, FIRST_PHASE if self._plans else 1.0))
        wide = campaign.stop.rhw is not None and campaign.stop.rhw > BIASED_RHW and not self._plans
        self.remark = TOO_WIDE if wide else ""
        self._campaign = campaign
        self._allocation = Allocation.of(shells, design, available)
        self.drawn = np.zeros(design.p.size, np.int64)
        self.planned: IntArray | None = None
        self._begin_phase()

    def _begin_phase(self) -> None:
        self.seen = Shells()
        self._n_episodes = self._look = 0

    @property
    def tally(self) -> Tally:
        """What the tests of each stratum have come to so far."""
        return self.seen.tally if self._n_episodes else empty_tally(self.drawn.size)

    def rounds(self) -> Iterator[Iterator[ShardSpec]]:
        """See `Planner`."""
        n_shards = 0
        while (added := self.next_round()).any():
            first = self.reported_from + self._n_episodes
            specs = round_specs(self.drawn, added, n_shards, first, self._campaign.run.smallest_shard)
            self.drawn = self.drawn + added
            n_shards += len(specs)
            yield iter(specs)

    def next_round(self) -> IntArray:
        """Tests to add per stratum, shape (S,); all 0 when no stratum or no budget is left."""
        tally, budget = self.tally, self._campaign.stop.episodes - self.reported_from - self._n_episodes
        added = self._allocation.next_round(tally, budget) if self.planned is None else self.planned - tally.tests
        self.rule.of_first_tests = self._allocation.is_first(tally.tests, added)
        self._look = self._n_episodes + int(added.sum())
        return added

    def add(self, block: Block) -> bool:
        """See `Planner`."""
        self.seen.add(block)
        self._n_episodes += len(block)
        if self._n_episodes != self._look:
            return False
        enough = self.rule.observe(self.seen)
        if not (enough and self._plans and self.rule.look.stopped and self.planned is None):
            return enough or self.planned is not None
        budget = self._campaign.stop.episodes - self._n_episodes
        stop, left = self._campaign.stop, self._allocation.available - self.drawn
        rhw = stop.rhw or math.inf
        self.planned = self._allocation.second_phase(self.tally, left, budget, rhw, stop.confidence)
        self.rule, self.reported_from = RoundRule(self._campaign), self._n_episodes
        self._begin_phase()
        return False


class PairPlanner:
    """Says which pairs of tests of two vehicles are driven next, from counts alone.

    Rounds are those of one vehicle, with pairs in place of tests; within a round pairs go to where the likelihood ratio
    says that one more narrows the interval of the difference most. The campaigns are equal but for the vehicle;
    ``available``, shape (S,), are the most pairs of each stratum, for ``margin`` see `PairRule`.
    """

    def __init__(self, campaign: Campaign, design: ShellDesign, available: IntArray, margin: float | None) -> None:
        self.rule, self._budget = PairRule(campaign, margin), campaign.stop.episodes
        self._allocation = Allocation.of(campaign.testing.shells, design, available)
        self._level = Level.two_sided(CONFIDENCE)

    def next_round(self, pairs: PairCounts) -> IntArray:
        """Pairs to add per stratum, shape (S,); all 0 when no stratum or no budget is left."""
        added = self._allocation.next_round(
            _differing(pairs),
            self._budget - int(pairs.tests.sum()),
            inner_rhw=lambda n: pairs.inside(n).rhw(self._level),
            given_by=partial(pairs.spread, self._level),
        )
        self.rule.of_first_tests = self._allocation.is_first(pairs.tests, added)
        return added


def _differing(pairs: PairCounts) -> Tally:
    """Pairs of which one vehicle has crashed and the other has not, in the crashes' place."""
    differing = pairs.outcomes()[:, 1:3].sum(1)
    may_differ = np.maximum(pairs.tally(0).failed, pairs.tally(1).failed)
    no_mass = np.zeros((differing.size, differing.size))
    return Tally(pairs.tests, differing, np.minimum(may_differ, pairs.tests - differing), no_mass, no_mass)


def planner_of(campaign: Campaign, prescribed: PrescribedEpisodes | None, held: int) -> Planner:
    """The planner of a campaign whose folder holds ``held`` tests already."""
    if prescribed is None:
        return FixedPlanner(campaign)
    return ShellPlanner(campaign, prescribed.design, prescribed.available, held)


def round_specs(tests: IntArray, added: IntArray, index: int, first_episode: int, shard_size: int) -> list[ShardSpec]:
    """Divide a round into shards, each a range of the round's tests in the order of strata.

    ``tests`` and ``added``, shape (S,), are draws taken so far and those of the round; ``index`` and ``first_episode``
    are the first shard's, ``shard_size`` the most episodes of one.
    """
    total = int(added.sum())
    n_shards = max(-(-total // shard_size), min(MOST_SHARDS_PER_ROUND, total // SMALLEST_SHARD), 1)
    edges = np.linspace(0, total, n_shards + 1).round().astype(np.int64).tolist()
    ends = np.cumsum(added).tolist()
    specs = []
    for k, (low, high) in enumerate(pairwise(edges)):
        draws = []
        for s, (taken, begin, end) in enumerate(zip(tests.tolist(), [0, *ends], ends, strict=False)):
            first, last = max(low, begin), min(high, end)
            if first < last:
                draws.append(Draw(s, taken + first - begin, last - first))
        specs.append(ShardSpec(index + k, first_episode + low, high - low, tuple(draws)))
    return specs
