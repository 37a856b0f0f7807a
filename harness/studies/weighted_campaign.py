"""Campaigns whose crashes carry weights (nde, forced, step and episode mixture), repeated on a chain or in the twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from harness.campaign.models import Campaign
from harness.episode.loop import EpisodeLoop
from harness.estimators import StopRule, accumulator
from harness.estimators.block import Block
from harness.estimators.from_records import block_from_tables
from harness.importance.build import mixture_weights
from harness.methods import EstimatorName
from harness.records.tables import shard_tables
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.studies.chains.chain import Chain
from harness.studies.chains.sampler import draw
from harness.studies.rows import Row, estimate_row
from harness.twin import TwinWorld

CELLS = 1024
REDRAWN = 5
"""Seed of the pools' errors, apart from those of tests."""
CHUNK = 20_000
"""Episodes of several small replications that the twin runs at a time."""


class EpisodeSource(Protocol):
    """Where episodes come from: each index is an episode of its own, independent of all others."""

    def block(self, first: int, n: int) -> Block:
        """Episodes ``first … first + n - 1``."""
        ...


class ChainEpisodes:
    """Episodes of an exact chain; what is drawn depends on where a block begins."""

    def __init__(self, chain: Chain, campaign: Campaign, seed: int) -> None:
        self._chain, self._method, self._seed = chain, campaign.testing.method, seed

    def block(self, first: int, n: int) -> Block:
        """See `EpisodeSource`."""
        return draw(self._chain, self._method, n, np.random.default_rng([self._seed, first]), first_episode=first)


class TwinEpisodes:
    """Episodes of a campaign in the twin, without files.

    Parameters
    ----------
    campaign : Campaign
    seed : int
    estimators : sequence of str
        What they need is kept.
    """

    def __init__(self, campaign: Campaign, seed: int, estimators: Sequence[EstimatorName]) -> None:
        moments = "scv" in estimators
        kept = "first_9" if moments else "none"
        records = campaign.records.model_copy(update={"moments": kept, "traces": "none", "trace_share": 0.0})
        self._campaign = campaign.model_copy(update={"seed": seed, "records": records})
        resolved = resolve(self._campaign)
        self._prepared = prepare(resolved)
        self._loop: EpisodeLoop = self._prepared.loop(TwinWorld(CELLS))
        self._moments = moments

    def block(self, first: int, n: int) -> Block:
        """See `EpisodeSource`."""
        shard = self._loop.run(first, self._prepared.states(first, n))
        tables = shard_tables(shard, self._campaign.seed, keep_traces=False)
        return block_from_tables(
            tables.episodes,
            tables.moments if self._moments else None,
            method=self._campaign.testing.method,
            alpha=mixture_weights(self._campaign),
        )


class WeightedCampaign:
    """A campaign to replicate: at a fixed n, or by its own online rule.

    Parameters
    ----------
    campaign : Campaign
    source : EpisodeSource
    estimators : sequence of str
        Whose results are wanted; the first one is watched by the stop rule.
    """

    def __init__(self, campaign: Campaign, source: EpisodeSource, estimators: Sequence[EstimatorName]) -> None:
        self._campaign, self._source, self._estimators = campaign, source, tuple(estimators)
        self._n = campaign.stop.episodes

    def run(self, replications: range) -> list[Row]:
        """Rows of some replications; replication r has the episodes from r times ``stop.episodes`` on."""
        if self._campaign.stop.rhw is not None:
            return [row for r in replications for row in self._online(r)]
        rows = []
        at_once = max(1, CHUNK // self._n)
        for first in range(replications.start, replications.stop, at_once):
            n = min(at_once, replications.stop - first)
            block = self._source.block(first * self._n, n * self._n)
            rows += [
                row
                for k in range(n)
                for row in self._results(first + k, [block.take(slice(k * self._n, (k + 1) * self._n))])
            ]
        return rows

    def _results(self, replication: int, blocks: Sequence[Block], *, reached: bool = False) -> list[Row]:
        rows = []
        redrawn = [_with_redrawn_rates(block, replication) for block in blocks]
        for name in self._estimators:
            state = accumulator(name)
            for block in redrawn:
                state.add(block)
            result = state.result(self._campaign.stop.confidence)
            rows.append(estimate_row(name, replication, result, reached=reached))
        return rows

    def _online(self, replication: int) -> list[Row]:
        campaign = self._campaign
        stop = campaign.stop.model_copy(update={"estimator": self._estimators[0]})
        rule = StopRule(stop, campaign.testing.method, campaign.run.shard_size, min_crashes=campaign.min_crashes)
        watched, blocks, n = accumulator(rule.estimator), [], 0
        for look in rule.looks:
            block = self._source.block(replication * self._n + n, look - n)
            watched.add(block)
            blocks.append(block)
            n = look
            if rule.observe(n, watched.result(stop.confidence)):
                break
        return self._results(replication, blocks, reached=rule.reached)


def _with_redrawn_rates(block: Block, replication: int) -> Block:
    """The block with surrogates' crash rates as another pool of the same size would know them.

    A pool's rates are means over thousands of paths, so that their errors are normal, with the covariance it states.
    """
    known = block.known_rates
    if known is None:
        return block
    mu = np.random.default_rng([REDRAWN, replication]).multivariate_normal(known.mu, known.covariance, method="eigh")
    return replace(block, known_rates=replace(known, mu=mu))
