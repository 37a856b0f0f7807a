"""Events of the pool, drawn within shells, in rounds: each decides what the next one tests.

A round is run to its end before the next begins, whatever the number of workers, and the result is looked at. Rounds
grow geometrically, to where they narrow the interval most (`harness.sampling.allocation`). That depends on counts
alone, not on the stop rule or on time: a run can be continued to a smaller RHW. First the strata inside the
boundary are tested until their rate is roughly known; then all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.estimators.block import EPISODE_COLUMNS, SHELL_COLUMNS, Block
from harness.estimators.pairs import FAILED, Pairs
from harness.estimators.per_hour import PerHour
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import PairRule, RoundRule
from harness.estimators.tally import Tally, empty_tally
from harness.families.protocol import Recorded
from harness.loop.loop import EpisodeLoop, Shard
from harness.numbers import plain
from harness.pool.build import campaign_pool, campaign_pool_key, pool_name
from harness.pool.shells import Draw, Pool, PrescribedEpisodes
from harness.pool.vehicle_pool import baseline_paths_name, campaign_baseline_paths, vehicle_pool
from harness.progress import Progress
from harness.records.folder import SHELLS, read_as
from harness.resolved import Resolved
from harness.sampling.allocation import LEVEL, Allocation, Joined
from harness.sampling.protocol import Rounds, ShardRequest, Source
from harness.strata import LIBRARY_STATEMENT, ShellDesign, StoredDesign
from harness.vocabulary import IntArray

MOST_SHARDS_PER_ROUND = 16
SMALLEST_SHARD = 64
_FINISH = "Run `harness run` with --resume, which makes what is missing."

_IN_USE: WeakValueDictionary[str, Pool] = WeakValueDictionary()


def pool_of(resolved: Resolved, progress: Progress) -> Pool:
    """The pool of a campaign: the one that another run of this process, as of B beside A, has in use."""
    key = campaign_pool_key(resolved)
    if (pool := _IN_USE.get(key)) is None or pool.library != resolved.library:
        pool = _IN_USE[key] = campaign_pool(resolved, progress)
    return pool


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
        own = resolved.campaign.has_baseline_runs
        return [baseline_paths_name(resolved) if own else pool_name(campaign_pool_key(resolved))]

    @classmethod
    def stored_design(cls, folder: Path) -> ShellDesign:
        """Strata of a stored run; a `RunFolderError` where they are missing, damaged, or of a too early version."""
        return read_as(StoredDesign, folder / SHELLS, mend=_FINISH)

    def begin_after(self, runs: Recorded) -> None:
        if self.baseline_paths is None:
            raise ValueError("this campaign has no baseline runs")
        self._draw_from(vehicle_pool(self.resolved, self.baseline_paths, runs))

    def rounds(self, held: int = 0) -> ShellRounds:
        return ShellRounds(self.campaign, self.prescribed.design, self.prescribed.available, held)

    def run(self, loop: EpisodeLoop, request: ShardRequest) -> Shard:
        traffic, events = self.prescribed.tests(request.draws)
        shard = loop.run(request.first_episode, traffic)
        shard.events = events
        return shard

    def run_again(self, loop: EpisodeLoop, episode: int, stored: pa.Table) -> Shard:
        row, stratum = (np.asarray(stored[name]).astype(np.int64) for name in ("pool_row", "component"))
        shard = loop.run(episode, self.prescribed.of_rows(row, stratum))
        shard.events = self.prescribed.events(row)
        return shard

    def is_shard(self, request: ShardRequest, episodes: pa.Table) -> bool:
        """See `Source`: nor of the last round of a smaller budget."""
        events, wanted = episodes.column("pool_row"), self.prescribed.rows(request.draws)[0]
        return super().is_shard(request, episodes) and not events.null_count and np.array_equal(events, wanted)


class ShellRounds(Rounds):
    """Fed with finished tests of shells in order; says what is tested next, and when it is enough.

    ``available``, shape (S,), are the most tests of each stratum, ``held`` see `RoundRule`; ``seen`` are the tests, of
    which those that were cut off may have crashed wherever a limit is decided.
    """

    rule: RoundRule

    def __init__(self, campaign: Campaign, design: ShellDesign, available: IntArray, held: int = 0) -> None:
        self.rule = RoundRule(campaign, held)
        self._campaign = campaign
        self._allocation = Allocation.of(campaign.testing.shells, design, available)
        self.seen = SeenShells()
        self._n_episodes = self._look = 0

    @property
    def tally(self) -> Tally:
        """What the tests of each stratum have come to so far."""
        return self.seen.tally if self._n_episodes else empty_tally(self._allocation.available.size)

    def __iter__(self) -> Iterator[Iterator[ShardRequest]]:
        n_shards, size = 0, self._campaign.run.smallest_shard
        while (added := self.next_round()).any():
            requests = round_requests(self.tally.tests, added, n_shards, self._n_episodes, size)
            n_shards += len(requests)
            yield iter(requests)

    def next_round(self) -> IntArray:
        """Tests to add per stratum, shape (S,); all 0 when no stratum or no budget is left."""
        tally = self.tally
        added = self._allocation.next_round(tally, self._campaign.stop.episodes - self._n_episodes)
        self.rule.of_first_tests = self._allocation.is_first(tally.tests, added)
        self._look = self._n_episodes + int(added.sum())
        return added

    def enough(self, block: Block) -> bool:
        self.seen.add(block if self._campaign.accept is None else block.cut_off_as_failed())
        return self.enough_after(len(block))

    def enough_after(self, n: int) -> bool:
        """Whether testing can end, with the next ``n`` tests in `seen`."""
        self._n_episodes += n
        return self._n_episodes == self._look and self.rule.observe(self.seen)


class PairRounds:
    """Says which pairs of tests of two vehicles are driven next, from counts alone.

    Rounds are those of one vehicle, with pairs in place of tests; within a round pairs go to where the likelihood ratio
    says that one more narrows the interval of the difference most. The campaigns are equal but for the vehicle;
    ``none`` are no pairs, ``available`` the most of each stratum, (S,) of each pool; ``rule`` looks at each round.
    """

    def __init__(self, campaign: Campaign, none: Pairs, available: Sequence[IntArray], rule: PairRule) -> None:
        self.rule, self._budget, self._available = rule, campaign.stop.episodes, np.concatenate(available)
        designs = [of.design for of in none.each]
        self._joined = Joined(campaign.testing.shells, designs, none.p, available)

    def next_round(self, pairs: Pairs) -> list[IntArray]:
        """Pairs to add per stratum of each pool; all 0 when no stratum or no budget is left."""
        tests, differing = pairs.tests, pairs.outcomes()[:, 1:3].sum(1)  # those stand in the crashes' place
        may_differ = np.maximum(pairs.ends[:, FAILED].sum(1), pairs.ends[:, :, FAILED].sum(1))
        added, self.rule.of_first_tests = self._joined.next_round(
            (tests, differing, np.minimum(may_differ, tests - differing)),
            self._budget - int(tests.sum()),
            lambda: pairs.within().rhw(LEVEL),
            partial(pairs.spread, LEVEL),
        )
        return added

    def used_of_pool(self, pairs: Pairs) -> float:
        """Largest share of a pool's events of a stratum that these pairs have used."""
        return float(np.max(pairs.tests / np.maximum(self._available, 1)))


class HourRounds:
    """Says which tests of each family are driven next, from counts alone: the strata of all lie side by side.

    The next test goes where it narrows the crashes per hour of the sum most; where each family's own rate is asked for,
    it is of the one that is known worst. ``available`` (S,) of each are the most tests of its strata; ``rule`` looks at
    each round.
    """

    def __init__(self, campaign: Campaign, hour: PerHour, available: Sequence[IntArray], rule: RoundRule) -> None:
        self.rule, self._budget, self._each = rule, campaign.stop.episodes, campaign.stop.each_family
        shells, designs = campaign.testing.shells, [of.seen.design for of in hour.families]
        self._own = [Allocation.of(shells, *each) for each in zip(designs, available, strict=True)]
        self._all = Joined(shells, designs, np.concatenate([of.p for of in hour.families]), available)

    def next_round(self, hour: PerHour) -> list[IntArray]:
        """Tests to add per stratum of each family; all 0 when no stratum or no budget is left."""
        tallies = [of.tally for of in hour.families]
        left = self._budget - hour.totals[0]
        if self._each and all(tally.tests.any() for tally in tallies):
            worst = int(np.argmax([of.limits(LEVEL).rhw for of in hour.families]))
            of_each = [np.zeros_like(tally.tests) for tally in tallies]
            of_each[worst] = self._own[worst].next_round(tallies[worst], left)
            return of_each
        columns = [np.concatenate(column) for column in zip(*(each[:3] for each in tallies), strict=True)]
        added, first = self._all.next_round(columns, left, lambda: hour.limits(LEVEL, LIBRARY_STATEMENT).rhw)
        self.rule.of_first_tests = first
        return added


def round_requests(
    tests: IntArray, added: IntArray, index: int, first_episode: int, shard_size: int
) -> list[ShardRequest]:
    """Divide a round into shards, each a range of the round's tests in the order of strata.

    ``tests`` and ``added``, shape (S,), are draws taken so far and those of the round; ``index`` and ``first_episode``
    are the first shard's, ``shard_size`` the most episodes of one.
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
