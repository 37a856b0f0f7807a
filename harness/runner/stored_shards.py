"""What ``--resume`` takes over of shards on disk.

A shard whose file of episodes is there is complete: `harness.records.folder.write_shard` writes that last. Shadow runs
are taken over in `harness.runner.shadow_runs`. Before, `harness.runner.manifest.require_own_folder` has refused folders
of another campaign or controller, and `harness.runner.prepare.require_same_pool` other pools.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from harness.records.folder import read_table, shard_files
from harness.records.schemas import ShardTables
from harness.runner.prepare import Prepared
from harness.runner.retrace import Retracing
from harness.runner.worker import ShardDone, ShardSpec, finished


def stored_shard(folder: Path, prepared: Prepared, retracing: Retracing, spec: ShardSpec) -> ShardDone | None:
    """A shard that needs not be run again, or None.

    It is taken over if its episodes are on disk, and its moments where the campaign keeps some, with as many rows as
    are wanted and, of shells, the cut-ins that are to be drawn now. The twin retraces it.

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
    tables = {name: read_table(folder / path) for name, path in files.items()}
    kept = ShardTables(tables["episodes"], tables.get("moments"), tables.get("traces"))
    if kept.episodes.num_rows != spec.n_episodes:
        return None  # the last shard of a smaller budget
    if prescribed is not None:
        cut_ins = kept.episodes.column("pool_cut_in")
        if cut_ins.null_count or not np.array_equal(cut_ins.to_numpy(), prescribed.rows(spec.draws)[0]):
            return None  # the last round of a smaller budget
    return replace(finished(prepared, retracing, spec, kept), files=files)
