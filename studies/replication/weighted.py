"""Campaigns whose crashes carry weights (nde, forced, step and episode mixture), repeated on a chain or in the twin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise, product

import numpy as np

from harness.campaign.campaign import Campaign
from harness.estimators.block import Block, block_from_tables
from harness.estimators.one_pass import accumulator
from harness.estimators.stopping import StopRule
from harness.loop.loop import EpisodeLoop
from harness.records.schemas import shard_tables
from harness.resolved import resolve
from harness.sampling import prepare
from harness.sampling.protocol import Source
from harness.vocabulary import EstimatorName, Method
from harness.worlds.twin import TwinWorld
from studies.chains.chain import Chain
from studies.chains.sampler import draw
from studies.replication.judgement import Row, estimate_row

CELLS = 1024
CHUNK = 20_000
"""Episodes of several small replications that the twin runs at a time."""


EpisodeSource = Callable[[int, int], Block]
"""Gives so many episodes from a first one on: each index is an episode of its own, independent of all others."""


def chain_episodes(chain: Chain, method: Method, seed: int, first: int, n: int) -> Block:
    """Episodes of an exact chain; what is drawn depends on where a block begins."""
    return draw(chain, method, n, np.random.default_rng([seed, first]), first_episode=first)


def twin_episodes(campaign: Campaign, seed: int, estimators: Sequence[EstimatorName]) -> EpisodeSource:
    """Episodes of a campaign in the twin, without files; what the estimators need is kept."""
    kept = "first_9" if "scv" in estimators else "none"
    records = campaign.records.model_copy(update={"moments": kept, "traces": "none", "trace_share": 0.0})
    return partial(_twin_block, campaign.model_copy(update={"seed": seed, "records": records}))


def _twin_block(campaign: Campaign, first: int, n: int) -> Block:
    prepared, loop = prepared_twin(campaign.model_dump_json())
    tables = shard_tables(loop.run(first, prepared.tests(first, n)), campaign.seed, keep_traces=False)
    return block_from_tables(campaign, tables["episodes"], tables.get("moments"))


@cache
def prepared_twin(campaign_json: str) -> tuple[Source, EpisodeLoop]:
    """A campaign in the twin; prepared when a process asks for it first, and once only."""
    prepared = prepare(resolve(Campaign.model_validate_json(campaign_json)))
    return prepared, prepared.loop(TwinWorld(CELLS))


@dataclass(frozen=True, eq=False)
class WeightedCampaign:
    """A campaign to replicate: at a fixed n, or by its own online rule, which watches the first estimator."""

    campaign: Campaign
    source: EpisodeSource
    estimators: Sequence[EstimatorName]

    def run(self, replications: range) -> list[Row]:
        """Rows of some replications; replication r has the episodes from r times ``stop.episodes`` on."""
        if self.campaign.stop.rhw is not None:
            return [row for r in replications for row in self._online(r)]
        rows, each = [], self.campaign.stop.episodes
        at_once = max(1, CHUNK // each)
        for some in (replications[k : k + at_once] for k in range(0, len(replications), at_once)):
            block = self.source(some.start * each, len(some) * each)
            for k, replication in enumerate(some):
                rows += self.results(replication, [block.take(slice(k * each, (k + 1) * each))])
        return rows

    def results(self, replication: int, blocks: Sequence[Block], *, reached: bool = False) -> list[Row]:
        """Rows of one replication, by all estimators."""
        states = {name: accumulator(name) for name in self.estimators}
        for state, block in product(states.values(), blocks):
            state.add(block)
        results = {name: state.result(self.campaign.stop.confidence) for name, state in states.items()}
        return [estimate_row(name, replication, result, reached=reached) for name, result in results.items()]

    def _online(self, replication: int) -> list[Row]:
        campaign = self.campaign
        stop = campaign.stop.model_copy(update={"estimator": self.estimators[0]})
        ends = campaign.run.shard_ends(stop.episodes)
        rule = StopRule(stop, ends)
        watched, blocks = accumulator(campaign.sampling.headline), list[Block]()
        for n, look in pairwise([0, *rule.looks]):
            blocks.append(self.source(replication * stop.episodes + n, look - n))
            watched.add(blocks[-1])
            if rule.observe(look, watched.result(stop.confidence)):
                break
        return self.results(replication, blocks, reached=rule.look.stopped)
