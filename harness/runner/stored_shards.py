"""What ``--resume`` takes over of shards on disk, and what estimates read of them block by block.

A shard whose file of episodes is there is complete: `harness.records.folder.write_shard` writes that last. Shadow runs
are taken over in `harness.runner.shadow_runs`.

Before a run looks at any shard, `harness.runner.manifest.require_own_folder` has refused folders of another campaign or
controller, `harness.runner.prepare.require_same_pool` other pools; a finished run that is asked for unchanged is
answered by `harness.runner.run_result.earlier_result`. Columns gathered of a part cost hardly more than those of one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.estimators.block import Block, joined
from harness.estimators.from_records import EPISODE_COLUMNS, block_from_tables
from harness.importance.build import mixture_weights
from harness.records.folder import read_table, shard_files
from harness.records.gathered import Gathered
from harness.records.tables import ShardTables
from harness.runner.prepare import Prepared
from harness.runner.retrace import Retracing
from harness.runner.worker import ShardDone, ShardSpec, finished, repeated_of

COLUMNS = (*EPISODE_COLUMNS, "failure")
"""Of tests that are known beforehand; those drawn from shells are few, and not gathered."""


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

    def take(self, spec: ShardSpec, files: dict[str, str]) -> ShardDone | None:
        """A shard; None if it is not gathered, or its ``files``, by table, are not the same any more."""
        shard = self._gathered.find(spec.index, spec.first_episode, spec.n_episodes, files)
        if shard is None or (part := self._part(shard.path)) is None:
            return None
        block = part.block.take(slice(shard.row, shard.row + spec.n_episodes))
        causes = Counter(part.failure.slice(shard.row, spec.n_episodes).drop_null().to_pylist())
        known = repeated_of(shard.metadata)
        return ShardDone(spec, block, shard.n_retraced, causes, known, files=files, gathered=True)

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


def stored_shard(
    folder: Path, prepared: Prepared, retracing: Retracing, gathered: GatheredBlocks | None, spec: ShardSpec
) -> ShardDone | None:
    """A shard that needs not be run again, or None.

    It is taken over if its episodes are on disk, and its moments where the campaign keeps some, with as many rows as
    are wanted and, of shells, the cut-ins that are to be drawn now. The twin retraces it, unless that was done before
    it was ``gathered`` and neither its files nor the code have changed since.

    Raises
    ------
    RunFolderError
        One of its files is damaged.
    WorldDisagreementError
        The twin retraces an episode differently.
    """
    campaign, prescribed = prepared.campaign, prepared.prescribed
    files = shard_files(folder, spec.index)
    needed = {"episodes"} | ({"moments"} if campaign.records.moments != "none" else set())
    if not needed <= files.keys():
        return None
    if gathered is not None and (done := gathered.take(spec, files)):
        return done
    tables = {name: read_table(folder / path) for name, path in files.items()}
    kept = ShardTables(tables["episodes"], tables.get("moments"), tables.get("traces"))
    if kept.episodes.num_rows != spec.n_episodes:
        return None  # the last shard of a smaller budget
    if prescribed is not None:
        cut_ins = kept.episodes.column("pool_cut_in")
        if cut_ins.null_count or not np.array_equal(cut_ins.to_numpy(), prescribed.rows(spec.draws)[0]):
            return None  # the last round of a smaller budget
    return replace(finished(prepared, retracing, spec, kept), files=files)
