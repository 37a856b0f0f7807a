"""What ``--resume`` takes over, and which folders it refuses.

A shard whose file of episodes is there is complete: `harness.records.folder.write_shard` writes that last. Baseline
runs are taken over in `harness.drawing.baseline`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from harness.drawing import ShardRequest, Source
from harness.errors import RunFolderError
from harness.pool.replay import Retracing
from harness.records.folder import MANIFEST, SHELLS, read_as, read_manifest, read_table, require_place, shard_files
from harness.records.schemas import ShardTables
from harness.resolved import Resolved
from harness.runner.worker import ShardResult, finished


def require_own_folder(folder: Path, resolved: Resolved, *, resume: bool) -> dict[str, Any]:
    """Refuse a folder that holds something else; return the manifest of a run to be continued, or one without shards.

    Raises `RunFolderError`: the folder cannot be written to, holds another campaign, this one without ``--resume`` or
    with another controller (one file may not mix two versions of it), only a part of a run, or files that are no run.
    """

    def refusal(found: str, expected: str, mend: str) -> RunFolderError:
        return RunFolderError(str(folder), found, expected, mend)

    require_place(folder)
    if not folder.exists() or not any(folder.iterdir()):
        return {"n_episodes": 0, "shards": []}
    elsewhere = "Choose another folder with --out."
    if not (folder / MANIFEST).exists():
        expected = "a new or empty folder, or one that a run has left"
        raise refusal("a folder with other files", expected, elsewhere)
    manifest = read_manifest(folder, mend=elsewhere)
    if manifest["campaign_hash"] != resolved.content_hash:
        raise refusal(
            f"another campaign ({manifest.get('name')}, {manifest['campaign_hash']})",
            f"a folder for this one ({resolved.content_hash})",
            "Choose another folder with --out, or run the campaign.yaml that it holds.",
        )
    if not resume:
        mend = "Continue it with --resume, or choose another folder with --out."
        raise refusal("this campaign, already begun", "a new or empty folder", mend)
    if manifest.get("controller_sha256") != resolved.controller_sha256:
        raise refusal(
            "tests of this campaign whose controller's source file has been changed since",
            "the same controller for all tests of a run",
            "Restore the file, or test the new controller in another folder with --out.",
        )
    return manifest


def require_no_fewer(folder: Path, earlier: dict[str, Any], n_episodes: int) -> None:
    """Refuse (`RunFolderError`) to throw away finished tests, which the stop rule asked for now would not keep."""
    if n_episodes < (held := earlier["n_episodes"]):
        found = f"{held:,} finished tests, of which the campaign as it is asked for now would keep {n_episodes:,}"
        expected = "a stop rule (stop.rhw, stop.episodes) that needs at least the tests that are there"
        mend = "Repeat the --set options of the earlier run or ask for more; `harness estimate` reads what is there."
        raise RunFolderError(str(folder), found, expected, mend)


def require_same_pool(folder: Path, source: Source) -> None:
    """Refuse (`RunFolderError`) to go on with a run whose cut-ins came from another pool.

    Its library, or the harness itself, has changed since.
    """
    path, design = folder / SHELLS, source.design
    if design is None or not path.exists():
        return
    found = read_as(dict[str, object], path, mend="Run the campaign into a new folder.").get("pool")
    if found != design.pool:
        expected = f"those of pool {design.pool}, which this campaign now has"
        mend = "Restore the surrogate library, or the version of the harness (manifest.json), or use a new folder."
        raise RunFolderError(str(path), f"cut-ins of pool {found}", expected, mend)


def stored_shard(folder: Path, source: Source, retracing: Retracing, request: ShardRequest) -> ShardResult | None:
    """A shard that needs not be run again, or None.

    It is taken over if its episodes are on disk, and its moments where the campaign keeps some, with as many rows as
    are wanted and, of shells, the cut-ins that are to be drawn now. The twin retraces it.

    Raises `RunFolderError`: one of its files is damaged. Raises `WorldDisagreementError`: the twin retraces an episode
    differently.
    """
    files = shard_files(folder, request.index)
    needed = {"episodes"} | ({"moments"} if source.campaign.records.moments != "none" else set())
    if not needed <= files.keys():
        return None
    tables = {name: read_table(folder / path) for name, path in files.items()}
    kept = ShardTables(tables["episodes"], tables.get("moments"), tables.get("traces"))
    if not source.is_shard(request, kept.episodes):
        return None
    return replace(finished(source, retracing, request, kept), files=files)
