"""What a run folder holds, read and checked before anything is drawn from it."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.campaign.dumping import written_out
from harness.campaign.loading import load_campaign
from harness.errors import CampaignError, RunFolderError
from harness.records.folder import MANIFEST, NO_RUN, read_json, read_manifest, require_schema
from harness.records.stored_manifest import Count, StoredManifest
from harness.report.stored_estimates import StoredEstimates


class ShownManifest(StoredManifest):
    """A manifest with what the page shows of every run."""

    created: str
    versions: dict[str, str]
    seed: Count


@dataclass(frozen=True)
class Shard:
    """One contiguous range of episodes and the files that hold it, by table name."""

    index: int
    first_episode: int
    n_episodes: int
    files: dict[str, Path]


@dataclass(frozen=True)
class RunFolder:
    """A finished run: its campaign, manifest, estimates and the shards that count."""

    path: Path
    campaign: dict[str, Any]
    manifest: dict[str, Any]
    estimates: dict[str, Any]
    shards: tuple[Shard, ...]

    @property
    def n_episodes(self) -> int:
        """Number of tests that count: the prefix at which the run stopped."""
        return int(self.manifest["n_episodes"])

    @property
    def method(self) -> str:
        """How tests were drawn (``testing.method``); empty where the campaign does not say."""
        testing = self.campaign.get("testing")
        return str(testing.get("method", "")) if isinstance(testing, dict) else ""

    @property
    def headline(self) -> dict[str, Any]:
        """The estimate that answers the campaign's question."""
        chosen: dict[str, Any] = self.estimates["estimates"][self.estimates["headline"]]
        return chosen

    def files(self, table: str) -> list[tuple[Shard, Path]]:
        """Shards that have a file of this table (``episodes``, ``moments``, ``traces``)."""
        return [(shard, shard.files[table]) for shard in self.shards if table in shard.files]


def typed_folder(folder: Path) -> str:
    """Return the folder as it is typed in a shell: relative to the working directory, or its bare name.

    The bare name stands for a folder that is not below the working directory. An absolute path would say where somebody
    keeps their files to everybody whom the page is mailed to.
    """
    here = Path.cwd()
    unlinked = Path(os.path.abspath(folder))  # noqa: PTH100 - resolve() would leave by a link what was typed below `here`
    for path in (unlinked, folder.resolve()):
        if path.is_relative_to(here):
            return shlex.quote(path.relative_to(here).as_posix())
    return shlex.quote(folder.resolve().name)


def read_run_folder(path: Path) -> RunFolder:
    """Read campaign, manifest and estimates of a run.

    Raises
    ------
    RunFolderError
        If a file is missing, is not what its name says, or belongs to another campaign.
    """
    manifest = read_manifest(path)
    require_schema(manifest, ShownManifest, path / MANIFEST, mend=NO_RUN)
    again = f"Make it with `harness estimate {path} --write`."
    estimates = read_json(path / "estimates.json", mend=again)
    require_schema(estimates, StoredEstimates, path / "estimates.json", mend=again)
    _check_belong_together(path, manifest, estimates)
    return RunFolder(path, _read_campaign(path / "campaign.yaml"), manifest, estimates, _shards(path, manifest))


def _read_campaign(path: Path) -> dict[str, Any]:
    try:
        return written_out(load_campaign(path, check_files=False))
    except CampaignError as error:
        raise RunFolderError(
            str(path),
            found=error.found if error.where == str(path) else f"{error.found} ({error.where})",
            expected="a campaign with all its sections, as the run has written it",
            mend="Restore the file, or run the campaign again.",
        ) from error


def _check_belong_together(path: Path, manifest: dict[str, Any], estimates: dict[str, Any]) -> None:
    where, again = str(path / "estimates.json"), f"Make it again with `harness estimate {path} --write`."
    if estimates["campaign_hash"] != manifest["campaign_hash"]:
        raise RunFolderError(
            where,
            found=f"estimates of campaign {estimates['campaign_hash']}",
            expected=f"those of campaign {manifest['campaign_hash']} (manifest.json)",
            mend=again,
        )
    if estimates["headline"] not in estimates["estimates"]:
        raise RunFolderError(
            where,
            found=f"headline {estimates['headline']!r}, which is not among the estimates",
            expected=f"one of {sorted(estimates['estimates'])}",
            mend=again,
        )


def _shards(path: Path, manifest: dict[str, Any]) -> tuple[Shard, ...]:
    shards = [
        Shard(
            entry["index"],
            entry["first_episode"],
            entry["n_episodes"],
            {table: path / name for table, name in entry["files"].items() if name},
        )
        for entry in manifest["shards"]
    ]
    return tuple(sorted(shards, key=lambda shard: shard.first_episode))
