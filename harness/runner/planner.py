"""What a campaign tests next, why, and when it is enough.

Most methods know all their tests beforehand. Shells decide from each round what the next one tests, so that a round is
run to its end before the next begins, whatever the number of workers; the result is looked at between rounds. Rounds
grow geometrically, to where they narrow the interval most. That depends on counts alone, not on the stop rule or on
time: a run can be continued to a smaller RHW. First the strata inside the narrowest boundary are tested until what is
stated about them is roughly known, some ten tests; then those inside the next one, and at last all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Protocol

import numpy as np

from harness.arrays import IntArray
from harness.campaign.models import Campaign
from harness.estimators import Shells, StopRule, accumulator
from harness.estimators.block import Block
from harness.estimators.estimate import BothWays, Estimate
from harness.estimators.stratified import Tally, empty_tally
from harness.pool.shells import Draw, PrescribedEpisodes
from harness.runner.allocation import Allocation, first_tests
from harness.runner.worker import ShardSpec
from harness.strata import ASSUMPTION_FREE, ShellDesign

MOST_SHARDS_PER_ROUND = 16
SMALLEST_SHARD = 64
WIDEST_RHW = 0.5
"""Precision from which on stopping at the first interval biases the rate noticeably."""
TOO_WIDE = (
    f"A relative half-width above {WIDEST_RHW:g} is reached by chance: stopping at the first such interval makes rates "
    "too high on the mean. Ask for a smaller stop.rhw, or for testing.shells.stopping: two_phase."
)
FIRST_PHASE = 1.7
"""Precision of the first of two phases over that of the second (measured: docs/estimators.md)."""
POOL_SHARE = 0.5
"""Share of the squared width from the pool's own error above which more tests hardly narrow an interval."""


class FixedPlanner:
    """All tests are known beforehand, in one round; a stop rule looks at some of their shards."""

    def __init__(self, campaign: Campaign) -> None:
        self._campaign = campaign
        stop, method, size = campaign.stop, campaign.testing.method, campaign.run.shard_size
        self.reported_from, self.remark = 0, ""
        self.rule = StopRule(stop, method, size, min_crashes=campaign.min_crashes)
        self._sums = accumulator(self.rule.estimator)
        self._n_episodes = 0

    def rounds(self) -> Iterator[Iterator[ShardSpec]]:
        """See `ShellPlanner`."""
        size, total = self._campaign.run.shard_size, self._campaign.stop.episodes
        firsts = enumerate(range(0, total, size))
        yield (ShardSpec(index, first, min(size, total - first)) for index, first in firsts)

    def add(self, block: Block) -> bool:
        """See `ShellPlanner`."""
        self._sums.add(block)
        self._n_episodes += len(block)
        if not self.rule.due(self._n_episodes):
            return False
        return self.rule.observe(self._n_episodes, self._sums.result(self._campaign.stop.confidence))


class ShellPlanner:
    """Fed with finished tests in order; says what is tested next, and when it is enough.

    In two phases the tests up to a wider precision only plan the number of the others, which alone are reported: that
    number does not depend on their results.

    ``available``, shape (S,), are the most tests of each stratum, ``held`` see `RoundRule`; ``estimate`` is that at the
    end of the last round, ``reported_from`` the first test of the second phase, ``remark`` what to say of stopping.
    """

    def __init__(self, campaign: Campaign, design: ShellDesign, available: IntArray, held: int = 0) -> None:
        shells = campaign.testing.shells
        self._plans = shells.stopping == "two_phase" and campaign.stop.rhw is not None
        self.rule = RoundRule(campaign, held, FIRST_PHASE if self._plans else 1.0)
        wide = campaign.stop.rhw is not None and campaign.stop.rhw > WIDEST_RHW and not self._plans
        self.remark = TOO_WIDE if wide else ""
        self.estimate: Estimate | None = None
        self.reported_from = 0
        self._campaign = campaign
        self._available = available
        self._first_tests = first_tests(design, shells.first_tests)
        self._allocation = Allocation(design, self._first_tests, available, shells.statement)
        self._drawn = np.zeros(design.p.size, np.int64)
        self._planned: IntArray | None = None
        self._begin_phase()

    def _begin_phase(self) -> None:
        self._seen = Shells()
        self._sums = BothWays(self._seen)
        self._n_episodes = self._look = 0

    @property
    def tally(self) -> Tally:
        """What the tests of each stratum have come to so far."""
        return self._seen.tally if self._n_episodes else empty_tally(self._drawn.size)

    def rounds(self) -> Iterator[Iterator[ShardSpec]]:
        """Shards of each round; the next round is asked for when all of the last one have been added."""
        n_shards = 0
        while (added := self.next_round()).any():
            first = self.reported_from + self._n_episodes
            specs = round_specs(self._drawn, added, n_shards, first, self._campaign.run.shard_size)
            self._drawn = self._drawn + added
            n_shards += len(specs)
            yield iter(specs)

    def next_round(self) -> IntArray:
        """Tests to add per stratum, shape (S,); all 0 when no stratum or no budget is left."""
        tally, budget = self.tally, self._campaign.stop.episodes - self.reported_from - self._n_episodes
        added = self._allocation.next_round(tally, budget) if self._planned is None else self._planned - tally.tests
        self.rule.of_first_tests = bool(np.any((tally.tests < self._first_tests)[added > 0]))
        self._look = self._n_episodes + int(added.sum())
        return added

    def add(self, block: Block) -> bool:
        """Add the tests of the next shard; True when the campaign is to stop."""
        self._sums.add(block)
        self._n_episodes += len(block)
        if self._n_episodes != self._look:
            return False
        self.estimate = self._sums.result(self._campaign.stop.confidence)
        enough = self.rule.observe(self.estimate)
        if not (enough and self._plans and self.rule.reached and self._planned is None):
            return enough or self._planned is not None
        budget = self._campaign.stop.episodes - self._n_episodes
        left = self._available - self._drawn
        self._planned = self._allocation.second_phase(self.tally, left, budget, self._campaign.stop.rhw or math.inf)
        self.rule, self.reported_from = RoundRule(self._campaign), self._n_episodes
        self._begin_phase()
        return False


class Rule(Protocol):
    """What a run says about why it ended; see `StopRule` and `RoundRule`."""

    reached: bool
    pool_error_above_target: bool
    rhw: float
    heaviest: float
    waited_for: tuple[str, ...]


class Planner(Protocol):
    """Says what is tested next, in rounds."""

    @property
    def rule(self) -> Rule:
        """Why it stops."""
        ...

    @property
    def reported_from(self) -> int:
        """First test of those that the answer is from; 0 where all are."""
        ...

    @property
    def remark(self) -> str:
        """What the ending is to say besides; mostly nothing."""
        ...

    def rounds(self) -> Iterator[Iterator[ShardSpec]]:
        """Shards of each round; the next round is asked for when all of the last one have been added."""
        ...

    def add(self, block: Block) -> bool:
        """Add the tests of the next shard; True when the campaign is to stop."""
        ...


def planner_of(campaign: Campaign, prescribed: PrescribedEpisodes | None, held: int) -> Planner:
    """The planner of a campaign whose folder holds ``held`` tests already."""
    if prescribed is None:
        return FixedPlanner(campaign)
    return ShellPlanner(campaign, prescribed.design, prescribed.available, held)


def first_tests(design: ShellDesign, asked: int | None = None) -> IntArray:
    """Tests that each stratum gets before anything is decided about it, shape (S,); ``asked`` is a number for all.

    A stratum without a crash leaves about p_s/n_s open, and of several the largest counts. So tests go in proportion
    to the probability, which leaves the same open in each; further ones come where crashes are seen.
    """
    if asked is not None:
        return np.full(design.p.size, asked, np.int64)
    within = design.p[: design.statements[0].n_inside].sum()
    share = np.ceil(FIRST_TESTS * design.p / within) if within > 0.0 else np.full(design.p.size, np.inf)
    found: IntArray = np.clip(share, LEAST_FIRST_TESTS, MOST_FIRST_TESTS).astype(np.int64)
    return found


@dataclass(frozen=True)
class Allocation:
    """How many tests each shell gets next.

    A stratum gets ``first_tests`` before anything is decided about it, and at most those ``available``, shape (S,).
    With a ``statement`` of the design what lies outside its boundary is never tested.
    """

    design: ShellDesign
    first_tests: IntArray
    available: IntArray
    statement: str = ASSUMPTION_FREE

    @property
    def n_asked(self) -> int:
        """Strata that may be tested, which come first."""
        inside = {each.name: each.n_inside for each in self.design.statements}
        return inside.get(self.statement, self.design.p.size)

    def next_round(
        self,
        tally: Tally,
        budget: int,
        *,
        inner_rhw: Callable[[int], float] | None = None,
        spread: Callable[[int, IntArray], IntArray] | None = None,
    ) -> IntArray:
        """Tests to add per stratum, at most ``budget``; all 0 when no stratum or no budget is left.

        Failed tests widen the limits that are to be narrowed: they may have been crashes.

        Parameters
        ----------
        tally : Tally
        budget : int
        inner_rhw : callable, optional
            Gives the relative half-width within the first so many strata; by default that of a crash rate.
        spread : callable, optional
            Gives so many tests to strata with so much room (S,) each; by default to where a crash rate is narrowed.
        """
        tests = tally.tests
        if self._used_up(tally):
            return np.zeros_like(tests)
        begun = self._begun(tests, inner_rhw or partial(self._inner_rhw, tally))
        active = begun & (tests < self.available)
        wanted = np.where(active, np.maximum(self.first_tests - tests, 0), 0)
        if not wanted.any() and active.any():
            size = max(SMALLEST_ROUND, int(np.ceil(tests[begun].sum() * (GROWTH - 1.0))))
            room = np.where(active, self.available - tests, 0)
            wanted = self._spread(min(size, budget), tally, room) if spread is None else spread(min(size, budget), room)
        return _cut(np.minimum(wanted, self.available - tests), budget)

    def second_phase(self, first: Tally, available: IntArray, budget: int, rhw: float) -> IntArray:
        """Tests per stratum, in proportion to a first phase's, of which an interval as narrow as ``rhw`` is expected.

        No more than ``available``, shape (S,), and together at most ``budget``.
        """
        p, n_paths = self.design.p, self.design.n_paths
        watched = slice(0, self.n_asked)

        def tests(factor: float) -> IntArray:
            return np.asarray(np.minimum(np.ceil(factor * first.tests).astype(np.int64), available))

        def too_wide(factor: float) -> bool:
            expected = first.scaled(tests(factor)).part(watched)
            return combined(p[watched], expected, n_paths, _LEVEL).rhw > rhw

        low, high = 0.0, 1.0
        while too_wide(high) and tests(high).sum() < budget and np.any(tests(2.0 * high) > tests(high)):
            low, high = high, 2.0 * high
        while tests(high).sum() - tests(low).sum() > first.tests.size:
            middle = (low + high) / 2.0
            low, high = (middle, high) if too_wide(middle) and tests(middle).sum() < budget else (low, middle)
        return _cut(tests(high), budget)

    def _used_up(self, tally: Tally) -> bool:
        """Whether nearly all that is left to know lies in strata without further cut-ins."""
        tests, (low, high) = tally.tests, clopper_pearson(tally.crashes, tally.tests, _TAIL, tally.failed)
        relevant = np.arange(tests.size) < self.n_asked
        squares = np.where(relevant, (self.design.p * (high - low)) ** 2, 0.0)
        return bool(squares[tests >= self.available].sum() >= USED_UP_SHARE * squares.sum())

    def _begun(self, tests: IntArray, inner_rhw: Callable[[int], float]) -> BoolArray:
        """Strata that it is time to test: those inside the narrowest boundary that leaves much open."""
        boundaries = (each.n_inside for each in self.design.statements if each.n_inside < self.n_asked)
        n = next((n for n in boundaries if not self._enough_inside(n, tests, inner_rhw)), self.n_asked)
        begun: BoolArray = np.arange(tests.size) < n
        return begun

    def _enough_inside(self, n: int, tests: IntArray, inner_rhw: Callable[[int], float]) -> bool:
        """Whether it is time to test more than the first ``n`` strata."""
        exhausted = bool(np.all(tests[:n] >= self.available[:n]))
        started = bool(np.any(tests[n:] > 0))
        # Without this end a vehicle that crashes rarely inside, and often outside, would not be tested outside at all.
        spent = bool(tests[:n].sum() >= MOST_INNER_TESTS * self.first_tests[:n].sum())
        return exhausted or started or spent or inner_rhw(n) <= INNER_RHW

    def _inner_rhw(self, tally: Tally, n: int) -> float:
        d, s = self.design, slice(0, n)
        return combined(d.p[s], tally.part(s), d.n_paths, _LEVEL).rhw

    def _spread(self, size: int, tally: Tally, most: IntArray) -> IntArray:
        """Give portions, one after the other, to where each narrows the sum of squared half-widths most.

        A squared half-width shrinks as 1/n, or as 1/n² where shares are all 0 or 1.
        """
        tests, crashes, failed = tally.tests, tally.crashes, tally.failed
        low, high = clopper_pearson(crashes, tests, _TAIL, failed)
        squares = ((self.design.p * (high - low) / 2.0) ** 2).tolist()
        powers = np.where((crashes + failed == 0) | (crashes == tests), 2, 1).tolist()
        so_far, room = tests.tolist(), most.tolist()
        given = [0] * tests.size

        def gain(s: int) -> float:
            """Fall of the squared half-width per further test of a stratum."""
            if given[s] >= room[s]:
                return -1.0
            n = max(so_far[s] + given[s], 1)
            return float(squares[s] * (max(so_far[s], 1) / n) ** powers[s] * powers[s] / n)

        gains, left, portion = [gain(s) for s in range(tests.size)], size, max(1, size // SHARES_PER_ROUND)
        while left > 0 and max(gains) >= 0.0:
            best = gains.index(max(gains))
            more = min(portion, left, room[best] - given[best])
            given[best] += more
            left -= more
            gains[best] = gain(best)
        return np.array(given, np.int64)


class RoundRule:
    """Looks after each round, and is content with one pass.

    That limits within shells hold at a fixed number of tests says nothing about the number at which a rule stops;
    that intervals cover there, and how far the rate is biased, is measured (docs/estimators.md).

    Parameters
    ----------
    campaign : Campaign
    held : int
        Tests that the run folder holds: before them nothing is given up, whatever precision is asked for now.
    factor : float
        By which the precision is wider than the one that the campaign asks for.

    Attributes
    ----------
    of_first_tests : bool
        Whether the round brings the tests that every shell gets before anything is decided about it.
    reached, rhw, heaviest, waited_for, pool_error_above_target
        See `StopRule`.
    """

    def __init__(self, campaign: Campaign, held: int = 0, factor: float = 1.0) -> None:
        self._held = held
        self._target = None if campaign.stop.rhw is None else factor * campaign.stop.rhw
        self._min_crashes = campaign.min_crashes
        self._statement = campaign.testing.shells.statement
        self.reached = self.pool_error_above_target = False
        self.rhw = float("inf")
        self.heaviest = 0.0  # limits within shells allow for every crash that has not been seen
        self.of_first_tests = False
        self.waited_for: tuple[str, ...] = ()

    def observe(self, estimate: Estimate) -> bool:
        """Whether to stop at the end of a round, with this estimate from all tests so far."""
        watched = {"rhw": estimate.rhw, **estimate.details}
        if self._statement != ASSUMPTION_FREE:
            watched = next(each for each in estimate.details["statements"] if each["name"] == self._statement)
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
            self.waited_for = ("the first tests of each shell (testing.shells.first_tests)",)
        if estimate.n_crashes < self._min_crashes:
            return False
        self.reached = not missing
        self.pool_error_above_target = watched["rhw_from_pool_at_least"] > self._target
        hopeless = self.pool_error_above_target and watched["rhw_from_pool"] ** 2 >= POOL_SHARE * self.rhw**2
        return self.reached or (hopeless and estimate.n_episodes >= self._held)


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
