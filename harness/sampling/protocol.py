"""What the runner knows of a way of drawing tests: the class `Source`; and when tests known beforehand are enough.

What holds for the way itself is an attribute of the class and is asked before anything is built; an instance holds what
the tests of one campaign are drawn from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.campaign.sections import LEAST_TESTS
from harness.controllers.find import build_host
from harness.controllers.hosts import BeforeTest
from harness.estimators.block import EPISODE_COLUMNS, Block, block_from_tables
from harness.estimators.one_pass import accumulator, headline_of
from harness.estimators.stopping import StopRule
from harness.families.protocol import Paths, Recorded
from harness.loop.judge import judge
from harness.loop.loop import EpisodeLoop, RecordPolicy, Shard
from harness.loop.repeat import Traffic
from harness.pool.shells import Draw, Pool
from harness.pool.vehicle_pool import BaselinePaths
from harness.progress import Progress
from harness.random_stream import INITIAL, uniforms
from harness.records.folder import Tables
from harness.resolved import Resolved
from harness.strata import ShellDesign
from harness.worlds import World


@dataclass(frozen=True)
class ShardRequest:
    """A fixed range of episodes; ``draws`` says which of the pool's events they are, where they are drawn from one.

    ``before`` is the name of the table, if they are none of the tests that count but come before these.
    """

    index: int
    first_episode: int
    n_episodes: int
    draws: tuple[Draw, ...] = ()
    before: str = ""

    @property
    def rows(self) -> slice:
        """Its episodes, as a slice of all."""
        return slice(self.first_episode, self.first_episode + self.n_episodes)


class KnownTests:
    """Tests that are all known beforehand, shard by shard; a stop rule looks at the end of some of these."""

    def __init__(self, campaign: Campaign) -> None:
        self._total, self._confidence = campaign.stop.episodes, campaign.stop.confidence
        self._ends = campaign.run.shard_ends(self._total)
        least = LEAST_TESTS.get(campaign.testing.estimator or "", 0)
        self.rule = StopRule(campaign.stop, [end for end in self._ends if end >= least])
        self._sums, self._n_episodes = accumulator(headline_of(campaign)), 0

    def __iter__(self) -> Iterator[ShardRequest]:
        edges = enumerate(pairwise(chain((0,), self._ends)))
        return (ShardRequest(index, first, min(end, self._total) - first) for index, (first, end) in edges)

    def enough(self, block: Block) -> bool:
        """Add the tests of the next shard; True when the campaign is to stop."""
        self._sums.add(block)
        self._n_episodes += len(block)
        if not self.rule.due(self._n_episodes):
            return False
        return self.rule.observe(self._n_episodes, self._sums.result(self._confidence))


class Source:
    """What the tests of a campaign are drawn from, built or read from the cache; tests are independent by default.

    ``scenario`` is what they have in common. Where they are drawn from a ``pool``, ``design`` has its strata. Along
    ``baseline_paths`` the vehicle has to be driven without an event before tests can be drawn; see `begin_after`.
    """

    columns: ClassVar[tuple[str, ...]] = EPISODE_COLUMNS
    """Columns of the episodes table that estimates need."""
    kernel: ClassVar[Callable[..., Any]] = staticmethod(judge)
    """One of those that have to be compiled."""

    def __init__(self, resolved: Resolved, progress: Progress) -> None:  # noqa: ARG002 - most build something
        self.resolved, self.campaign = resolved, resolved.campaign
        self.scenario = resolved.scenario
        self.pool: Pool | None = None
        self.design: ShellDesign | None = None
        self.baseline_paths: BaselinePaths | None = None

    @classmethod
    def cached_files(cls, resolved: Resolved) -> list[str]:  # noqa: ARG003 - here nothing is built
        """Names of the files that building leaves in the cache: with a copy of them another machine builds nothing."""
        return []

    def begin_after(self, runs: Recorded) -> None:  # noqa: ARG002 - there are none
        """Draw tests by what the vehicle did in its baseline runs, along `baseline_paths`.

        Raises `HarnessError`: nothing on these paths can be tested.
        """
        raise ValueError("this campaign has no baseline runs")

    def paths(self, first_episode: int, n_episodes: int) -> Paths:
        """Paths of consecutive episodes, (n_episodes,)."""
        u = uniforms(self.campaign.seed, first_episode, n_episodes, INITIAL, self.resolved.family.n_uniforms)
        return Paths(first_episode + np.arange(n_episodes), self.resolved.family.start(self.resolved.environment, u))

    def tests(self, first_episode: int, n_episodes: int) -> Traffic:
        """What the others do in consecutive episodes."""
        raise NotImplementedError

    def loop(self, world: World, *, traces: str | None = None, before_test: BeforeTest = lambda _: None) -> EpisodeLoop:
        """Episode loop in a world, recording what the campaign asks for, or other ``traces``."""
        seed, names = self.scenario.seed, self.scenario.shown
        av = build_host(self.campaign.av, n_cells=world.n_cells, seed=seed, before_test=before_test, names=names)
        return EpisodeLoop(world, self.scenario, self.records(traces), av)

    def records(self, traces: str | None = None) -> RecordPolicy:
        """What the campaign asks to be recorded of its tests, or with other ``traces``."""
        return RecordPolicy(traces or self.campaign.records.traces, self.campaign.records.trace_share)

    def run(self, loop: EpisodeLoop, request: ShardRequest) -> Shard:
        """Run the tests of a shard."""
        return loop.run(request.first_episode, self.tests(request.first_episode, request.n_episodes))

    def run_again(self, loop: EpisodeLoop, episode: int, stored: pa.Table) -> Shard:  # noqa: ARG002 - the index says all
        """Run an episode that is ``stored`` as one row."""
        return self.run(loop, ShardRequest(0, episode, 1))

    def is_shard(self, request: ShardRequest, episodes: pa.Table) -> bool:
        """Whether stored episodes are the requested ones: the last shard of a smaller budget has fewer."""
        return bool(episodes.num_rows == request.n_episodes)

    def block(self, tables: Tables) -> Block:
        """The shard's tests as the stop rule and estimates read them."""
        steps = tables.get("moments") if self.campaign.sampling.mixes_steps else None
        return block_from_tables(self.campaign, tables["episodes"], steps, self.design)
