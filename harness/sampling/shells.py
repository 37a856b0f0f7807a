"""Tests of the pool's events, drawn within shells, in rounds: the counts of each decide what the next one tests.

A round is run to its end before the stop rule looks and the next begins, whatever the number of workers. Rounds grow
geometrically, and go to where they narrow the interval most (`Allocation`): at first to strata inside the boundary,
until their rate is roughly known; then to all. That depends on counts alone, not on the stop rule or on time: a run can
be continued to a smaller RHW.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.campaign.sections import ShellSettings
from harness.estimators.block import EPISODE_COLUMNS, SHELL_COLUMNS
from harness.estimators.likelihood import Level, spread
from harness.estimators.limits import clopper_pearson
from harness.estimators.pairs import FAILED, Pairs
from harness.estimators.per_hour import PerHour
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import PairRule, RoundRule
from harness.estimators.tally import Tally, combined
from harness.families.protocol import Recorded
from harness.loop.loop import EpisodeLoop, Shard
from harness.numbers import plain
from harness.pool.build import campaign_pool, campaign_pool_key, pool_name
from harness.pool.shells import Draw, Pool, PrescribedEpisodes
from harness.pool.vehicle_pool import baseline_paths_name, campaign_baseline_paths, vehicle_pool
from harness.progress import Progress
from harness.records.folder import SHELLS, read_as
from harness.resolved import Resolved
from harness.sampling.protocol import ShardRequest, Source
from harness.strata import ASSUMPTION_FREE, LIBRARY_STATEMENT, ShellDesign, StoredDesign
from harness.vocabulary import FloatArray, IntArray

GROWTH = 1.1
"""Tests after a round over tests before it; also the distance of the looks at the result."""
INNER_RHW = 0.3
"""Relative half-width inside the boundary at which testing turns to what lies outside."""
CONFIDENCE = 0.9
"""Level at which widths are compared, whatever the campaign reports."""
LEVEL = Level.two_sided(CONFIDENCE)
FIRST_TESTS = 36
"""First tests of all strata within the boundary together, each its share of the probability there."""
LEAST_FIRST_TESTS, MOST_FIRST_TESTS = 3, 12
"""Limits of the first tests of one stratum."""
MOST_INNER_TESTS = 8
"""Testing turns to what lies outside after this many times the first tests, even if the inner rate is not yet known."""
SMALLEST_ROUND = 8
ADDED = 0.25
"""Crashes, and tests without one, that each tested stratum is credited with: without them the strata in which the first
tests crash get all further ones, and the rate is 4 % too low for some vehicles (measured)."""
USED_UP_SHARE = 0.95
"""Share of the squared widths that must lie in exhausted strata for the allocation to end."""
MOST_SHARDS_PER_ROUND = 16
SMALLEST_SHARD = 64

_IN_USE: WeakValueDictionary[str, Pool] = WeakValueDictionary()


def pool_of(resolved: Resolved, progress: Progress) -> Pool:
    """The pool of a campaign, shared with other runs of this process, as of B beside A."""
    key = campaign_pool_key(resolved)
    if (pool := _IN_USE.get(key)) is None or pool.library != resolved.library:
        pool = _IN_USE[key] = campaign_pool(resolved, progress)
    return pool


def stored_design(folder: Path) -> ShellDesign:
    """Strata of a stored run; a `RunFolderError` where they are missing, damaged, or of a too early version."""
    mend = "Run `harness run` with --resume, which makes what is missing."
    return read_as(StoredDesign, folder / SHELLS, mend=mend)


class Shells(Source):
    """Tests of strata of the pool's events; a vehicle that acts before the event makes the pool itself."""

    columns = (*EPISODE_COLUMNS, *SHELL_COLUMNS)

    def __init__(self, resolved: Resolved, progress: Progress) -> None:
        super().__init__(resolved, progress)
        if self.campaign.has_baseline_runs:
            self.baseline_paths = campaign_baseline_paths(resolved, progress)
        else:
            if above := self.campaign.crash.counts_above_mps:
                progress.remark = f" (one of its own, once: only impacts above {plain(above)} m/s are crashes)"
            self._draw_from(pool_of(resolved, progress))
            progress.remark = ""

    def _draw_from(self, pool: Pool) -> None:
        self.pool, self.prescribed = pool, PrescribedEpisodes(self.resolved, pool)
        self.design = self.prescribed.design

    @classmethod
    def cached_files(cls, resolved: Resolved) -> list[str]:
        acts = resolved.campaign.has_baseline_runs
        return [baseline_paths_name(resolved) if acts else pool_name(campaign_pool_key(resolved))]

    def begin_after(self, runs: Recorded) -> None:
        if self.baseline_paths is None:
            raise ValueError("this campaign has no baseline runs")
        self._draw_from(vehicle_pool(self.resolved, self.baseline_paths, runs))

    def run(self, loop: EpisodeLoop, request: ShardRequest) -> Shard:
        return self._run(loop, request.first_episode, *self.prescribed.rows(request.draws))

    def run_again(self, loop: EpisodeLoop, episode: int, stored: pa.Table) -> Shard:
        row, stratum = (np.asarray(stored[name]).astype(np.int64) for name in ("pool_row", "component"))
        return self._run(loop, episode, row, stratum)

    def _run(self, loop: EpisodeLoop, first: int, rows: IntArray, stratum: IntArray) -> Shard:
        shard = loop.run(first, self.prescribed.of_rows(rows, stratum))
        shard.events = self.prescribed.events(rows)
        return shard

    def is_shard(self, request: ShardRequest, episodes: pa.Table) -> bool:
        """See `Source`; and whether they have the requested events: the last round of a smaller budget has others."""
        stored, wanted = episodes.column("pool_row"), self.prescribed.rows(request.draws)[0]
        return super().is_shard(request, episodes) and not stored.null_count and np.array_equal(stored, wanted)


def first_tests(design: ShellDesign, n_each: int | None = None) -> IntArray:
    """Tests that each stratum gets before anything is decided about it, shape (S,): ``n_each``, if that is set.

    A stratum without a crash leaves about p_s/n_s open, and of several the largest counts. So tests go in proportion
    to the probability, which leaves the same open in each; further ones come where crashes are seen.
    """
    if n_each is not None:
        return np.full(design.p.size, n_each, np.int64)
    within = design.p[: design.n_inside].sum()
    share = np.ceil(FIRST_TESTS * design.p / within) if within > 0.0 else np.full(design.p.size, np.inf)
    return np.asarray(np.clip(share, LEAST_FIRST_TESTS, MOST_FIRST_TESTS).astype(np.int64))


@dataclass(frozen=True)
class Allocation:
    """How many tests each shell gets next.

    Strata have the probabilities ``p`` (S,), known from ``n_paths``; the first ``n_inside`` are inside the boundary.
    Each gets ``first_tests`` (S,) before anything is decided about it, and at most the ``available`` (S,). With the
    ``statement`` `library` what lies outside the boundary is never tested. A round has at least ``smallest_round``
    tests, where that many are left.
    """

    p: FloatArray
    n_inside: int
    first_tests: IntArray
    available: IntArray
    statement: str = ASSUMPTION_FREE
    smallest_round: int = 1
    n_paths: float = math.inf

    @classmethod
    def of(cls, shells: ShellSettings, design: ShellDesign, available: IntArray) -> Allocation:
        """The allocation that a campaign's ``testing.shells`` asks for."""
        first, smallest = first_tests(design, shells.first_tests), shells.smallest_round
        return cls(design.p, design.n_inside, first, available, shells.statement, smallest, design.n_independent)

    def is_first(self, tests: IntArray, added: IntArray) -> bool:
        """Whether a round of ``added`` tests after ``tests``, (S,) each, has first tests of a stratum."""
        return bool(np.any((tests < self.first_tests)[added > 0]))

    @property
    def n_asked(self) -> int:
        """Strata that may be tested, which come first."""
        return self.p.size if self.statement == ASSUMPTION_FREE else self.n_inside

    def next_round(
        self,
        tally: Tally,
        budget: int,
        *,
        inner_rhw: Callable[[int], float] | None = None,
        given_by: Callable[[int, IntArray], IntArray] | None = None,
    ) -> IntArray:
        """Tests to add per stratum, at most ``budget``; all 0 when no stratum or no budget is left.

        Failed tests widen the limits that are to be narrowed: they may have been crashes. ``inner_rhw`` gives the
        relative half-width from the first n strata, by default that of a crash rate. ``given_by`` divides n tests among
        strata that have room for so many, (S,), by default to where they narrow a crash rate most.
        """
        tests = tally.tests
        if self._used_up(tally):
            return np.zeros_like(tests)
        begun = np.arange(tests.size) < self._n_begun(tally, inner_rhw)
        active = begun & (tests < self.available)
        wanted = np.where(active, np.maximum(self.first_tests - tests, 0), 0)
        if wanted.any():
            # Further first tests by the probability of strata, while that is all that is known of them.
            missing, p = max(self.smallest_round - int(wanted.sum()), 0), np.where(active, self.p, 0.0)
            if p.any():
                wanted = wanted + np.ceil(missing * p / p.sum()).astype(np.int64)
        elif active.any():
            size = max(SMALLEST_ROUND, self.smallest_round, int(np.ceil(tests[begun].sum() * (GROWTH - 1.0))))
            room = np.where(active, self.available - tests, 0)
            wanted = (given_by or partial(self._spread, tally))(min(size, budget), room)
        wanted = np.minimum(wanted, self.available - tests)
        return np.asarray(np.diff(np.minimum(np.cumsum(wanted), max(budget, 0)), prepend=0))  # cut from the last one on

    def _used_up(self, tally: Tally) -> bool:
        """Whether nearly all of the remaining width lies in strata without further events."""
        tests, tail = tally.tests, (1.0 - CONFIDENCE) / 2.0
        low, high = clopper_pearson(tally.crashes, tests, tail, tally.failed)
        relevant = np.arange(tests.size) < self.n_asked
        squares = np.where(relevant, (self.p * (high - low)) ** 2, 0.0)
        return bool(squares[tests >= self.available].sum() >= USED_UP_SHARE * squares.sum())

    def _n_begun(self, tally: Tally, inner_rhw: Callable[[int], float] | None) -> int:
        """Number of strata that are tested now: those inside the boundary alone, while they leave much open."""
        n, tests = min(self.n_inside, self.n_asked), tally.tests
        enough = n == self.n_asked or np.any(tests[n:] > 0) or np.all(tests[:n] >= self.available[:n])
        # Without this end a vehicle that crashes rarely inside, and often outside, would not be tested outside at all.
        enough = enough or tests[:n].sum() >= MOST_INNER_TESTS * self.first_tests[:n].sum()
        if enough:
            return self.n_asked
        rhw = inner_rhw(n) if inner_rhw else combined(self.p[:n], tally.part(slice(0, n)), self.n_paths, LEVEL).rhw
        return self.n_asked if rhw <= INNER_RHW else n

    def _spread(self, tally: Tally, size: int, room: IntArray) -> IntArray:
        """Divide ``size`` tests among strata with ``room`` (S,) to where they narrow the crash rate most, (S,)."""
        weights = np.column_stack([self.p, np.zeros_like(self.p)])
        credit = ADDED * (tally.tests > 0)
        lower, upper = (
            np.column_stack([crashes + credit, tally.tests - crashes + credit])
            for crashes in (tally.crashes, tally.crashes + tally.failed)
        )
        return spread(weights, lower, upper, LEVEL, size, room)


class ShellRounds:
    """Rounds of tests of one pool, of whose strata ``available`` (S,) are the most tests; ``rule`` looks at each."""

    def __init__(self, campaign: Campaign, design: ShellDesign, available: IntArray, rule: RoundRule) -> None:
        self.rule, self._budget = rule, campaign.stop.episodes
        self._allocation = Allocation.of(campaign.testing.shells, design, available)

    def next_round(self, seen: SeenShells) -> list[IntArray]:
        """Tests to add per stratum, shape (S,), after all that were ``seen``; 0 when none or no budget is left."""
        tally = seen.tally
        added = self._allocation.next_round(tally, self._budget - int(tally.tests.sum()))
        self.rule.of_first_tests = self._allocation.is_first(tally.tests, added)
        return [added]


class SideBySide:
    """Rounds over the strata of several pools together: those inside a boundary come first.

    ``p`` (S,) is what the strata of all count in the answer; ``available`` (S,) of each pool are the most tests of its
    strata; ``rule`` looks at each round. What is tested next follows from counts alone.
    """

    def __init__(
        self,
        campaign: Campaign,
        designs: Sequence[ShellDesign],
        p: FloatArray,
        available: Sequence[IntArray],
        rule: RoundRule | PairRule,
    ) -> None:
        self.rule, self._budget = rule, campaign.stop.episodes
        shells = campaign.testing.shells
        inside = np.concatenate([np.arange(design.p.size) < design.n_inside for design in designs])
        self._order = np.argsort(~inside, kind="stable")
        self._place = np.argsort(self._order)
        self._ends = np.cumsum([design.p.size for design in designs])[:-1]
        first = np.concatenate([first_tests(design, shells.first_tests) for design in designs])
        self._available = np.concatenate(available)
        first, room = first[self._order], self._available[self._order]
        n_inside = int(inside.sum())
        self._all = Allocation(p[self._order], n_inside, first, room, shells.statement, shells.smallest_round)

    def _next(
        self,
        counts: Sequence[IntArray],
        inner_rhw: Callable[[], float],
        given_by: Callable[[int, IntArray], IntArray] | None = None,
    ) -> list[IntArray]:
        """Tests to add per stratum of each pool; ``counts`` are the columns of `Tally.counted`, over all strata."""
        tally = Tally.counted(*(column[self._order] for column in counts))
        in_order = None if given_by is None else (lambda n, room: given_by(n, room[self._place])[self._order])
        budget = self._budget - int(tally.tests.sum())
        added = self._all.next_round(tally, budget, inner_rhw=lambda _: inner_rhw(), given_by=in_order)
        self.rule.of_first_tests = self._all.is_first(tally.tests, added)
        return np.split(added[self._place], self._ends)


class PairRounds(SideBySide):
    """Rounds of pairs of tests of two vehicles, whose campaigns are equal but for the vehicle.

    As rounds of one vehicle, with pairs in place of tests; within a round pairs go to where one more narrows the
    likelihood ratio's interval of the difference most. ``none`` is an empty set of pairs.
    """

    rule: PairRule

    def __init__(self, campaign: Campaign, none: Pairs, available: Sequence[IntArray], rule: PairRule) -> None:
        super().__init__(campaign, [scenario.design for scenario in none.each], none.p, available, rule)

    def next_round(self, pairs: Pairs) -> list[IntArray]:
        """Pairs to add per stratum of each pool; all 0 when no stratum or no budget is left."""
        tests, differing = pairs.tests, pairs.outcomes()[:, 1:3].sum(1)  # differing pairs count as crashes do
        may_differ = np.maximum(pairs.ends[:, FAILED].sum(1), pairs.ends[:, :, FAILED].sum(1))
        counts = tests, differing, np.minimum(may_differ, tests - differing)
        return self._next(counts, lambda: pairs.within().rhw(LEVEL), partial(pairs.spread, LEVEL))

    def used_of_pool(self, pairs: Pairs) -> float:
        """Largest share of a stratum's events in the pool that these pairs have used."""
        return float(np.max(pairs.tests / np.maximum(self._available, 1)))


class HourRounds(SideBySide):
    """Rounds of tests of several families.

    Tests go where they narrow the sum's crashes per hour most; where each family's own rate is asked for, to the family
    whose rate is known worst.
    """

    def __init__(self, campaign: Campaign, hour: PerHour, available: Sequence[IntArray], rule: RoundRule) -> None:
        designs = [family.seen.design for family in hour.families]
        super().__init__(campaign, designs, np.concatenate([family.p for family in hour.families]), available, rule)
        shells, own = campaign.testing.shells, zip(designs, available, strict=True)
        self._own = [Allocation.of(shells, *family) for family in own] if campaign.stop.each_family else []

    def next_round(self, hour: PerHour) -> list[IntArray]:
        """Tests to add per stratum of each family; all 0 when no stratum or no budget is left."""
        tallies = [family.tally for family in hour.families]
        if self._own and all(tally.tests.any() for tally in tallies):
            worst = int(np.argmax([family.limits(LEVEL).rhw for family in hour.families]))
            added = [np.zeros_like(tally.tests) for tally in tallies]
            added[worst] = self._own[worst].next_round(tallies[worst], self._budget - hour.totals[0])
            return added
        counts = [np.concatenate(column) for column in zip(*(tally[:3] for tally in tallies), strict=True)]
        return self._next(counts, lambda: hour.limits(LEVEL, LIBRARY_STATEMENT).rhw)


def round_requests(
    tests: IntArray, added: IntArray, index: int, first_episode: int, shard_size: int
) -> list[ShardRequest]:
    """Divide a round into shards, each a range of the round's tests in the order of strata.

    ``tests`` (S,) are drawn so far, ``added`` (S,) are the round's; ``index`` and ``first_episode`` are the first
    shard's, ``shard_size`` is the most episodes of one.
    """
    total = int(added.sum())
    n_shards = max(-(-total // shard_size), min(MOST_SHARDS_PER_ROUND, total // SMALLEST_SHARD), 1)
    edges = np.linspace(0, total, n_shards + 1).round().astype(np.int64).tolist()
    ends = np.cumsum(added).tolist()
    requests = []
    for k, (low, high) in enumerate(pairwise(edges)):
        draws = []
        for s, (taken, begin, end) in enumerate(zip(tests.tolist(), [0, *ends], ends, strict=False)):
            first, last = max(low, begin), min(high, end)
            if first < last:
                draws.append(Draw(s, taken + first - begin, last - first))
        requests.append(ShardRequest(index + k, first_episode + low, high - low, tuple(draws)))
    return requests
