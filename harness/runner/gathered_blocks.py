"""Blocks of stored shards from gathered columns: of a whole part at once, which costs hardly more than of one shard."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from harness.campaign.models import Campaign
from harness.estimators.block import Block, joined
from harness.estimators.from_records import EPISODE_COLUMNS, block_from_tables
from harness.importance.build import mixture_weights
from harness.records.gathered import Gathered, GatheredShard

COLUMNS = (*EPISODE_COLUMNS, "failure")
"""Of tests that are known beforehand; those drawn from shells are few, and not gathered."""


class Taken(NamedTuple):
    """A shard's tests, the causes of its failures, and what else is known of it."""

    block: Block
    failures: Counter[str]
    shard: GatheredShard


class _Part(NamedTuple):
    path: Path
    block: Block
    failure: pa.ChunkedArray


class GatheredBlocks:
    """Blocks as `block_from_tables` makes them of a shard's episodes table alone; one part is in memory at a time.

    ``same_sources`` see `Gathered`.
    """

    def __init__(self, folder: Path, campaign: Campaign, *, same_sources: bool = False) -> None:
        self._gathered = Gathered(folder, same_sources=same_sources)
        self._method, self._alpha = campaign.testing.method, mixture_weights(campaign)
        self._held: _Part | None = None

    def holds(self, index: int, first_episode: int, n_episodes: int, files: Mapping[str, str]) -> bool:
        """Whether a shard is gathered and its ``files`` are the same."""
        return self._gathered.find(index, first_episode, n_episodes, files) is not None

    def take(self, index: int, first_episode: int, n_episodes: int, files: Mapping[str, str]) -> Taken | None:
        """A shard; None if it is not gathered, or its ``files``, by table, are not the same any more."""
        shard = self._gathered.find(index, first_episode, n_episodes, files)
        if shard is None or (part := self._part(shard.path)) is None:
            return None
        block = part.block.take(slice(shard.row, shard.row + n_episodes))
        causes = part.failure.slice(shard.row, n_episodes).drop_null().to_pylist()
        return Taken(block, Counter(causes), shard)

    def take_together(self, shards: Sequence[Mapping[str, Any]]) -> Block | None:
        """Consecutive shards, as the manifest lists them, as one; None if the episodes of one are not gathered."""
        found = []
        for shard in shards:
            files = {"episodes": shard["files"]["episodes"]}
            if (one := self._gathered.find(shard["index"], shard["first_episode"], shard["n_episodes"], files)) is None:
                return None
            found.append(one)
        blocks = []
        for path, group in groupby(found, key=attrgetter("path")):  # in a part they stand one after another
            several = list(group)
            if (part := self._part(path)) is None:
                return None
            blocks.append(part.block.take(slice(several[0].row, several[-1].row + several[-1].n_episodes)))
        return joined(blocks)

    def _part(self, path: Path) -> _Part | None:
        if self._held is None or self._held.path != path:
            if (table := self._gathered.table(path)) is None:
                return None
            block = block_from_tables(table, None, method=self._method, alpha=self._alpha)
            self._held = _Part(path, block, table.column("failure"))
        return self._held
