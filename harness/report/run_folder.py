"""What a run folder holds, read and checked before anything is drawn from it."""

from __future__ import annotations

import json
import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from harness.errors import RunFolderError
from harness.records.folder import NO_RUN

MANIFEST_KEYS = ("campaign_hash", "created", "versions", "seed", "shards", "n_episodes")
ESTIMATES_KEYS = ("campaign", "campaign_hash", "lane_change_level", "confidence", "headline", "estimates", "statement")


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
    manifest = _read_json(path / "manifest.json", MANIFEST_KEYS, mend=NO_RUN)
    estimates = _read_json(
        path / "estimates.json", ESTIMATES_KEYS, mend=f"Make it with `harness estimate {path} --write`."
    )
    _check_belong_together(path, manifest, estimates)
    return RunFolder(path, _read_campaign(path / "campaign.yaml"), manifest, estimates, _shards(path, manifest))


def _read_text(path: Path, mend: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RunFolderError(str(path), found="no such file", expected="a finished run folder", mend=mend) from None
    except (OSError, UnicodeDecodeError) as error:
        raise RunFolderError(str(path), found=str(error), expected="a readable text file", mend=mend) from error


def _read_json(path: Path, keys: tuple[str, ...], mend: str) -> dict[str, Any]:
    try:
        content = json.loads(_read_text(path, mend))
    except json.JSONDecodeError as error:
        raise RunFolderError(str(path), found=f"broken JSON ({error})", expected="a JSON object", mend=mend) from error
    missing = [key for key in keys if not isinstance(content, dict) or key not in content]
    if missing:
        raise RunFolderError(str(path), found=f"no key {missing[0]!r}", expected=f"the keys {list(keys)}", mend=mend)
    result: dict[str, Any] = content
    return result


def _read_campaign(path: Path) -> dict[str, Any]:
    mend = "Restore the file, or run the campaign again."
    try:
        content = YAML(typ="safe", pure=True).load(_read_text(path, mend))
    except YAMLError as error:
        raise RunFolderError(str(path), found=f"broken YAML ({error})", expected="a campaign", mend=mend) from error
    if not isinstance(content, dict) or not isinstance(content.get("testing"), dict):
        found = "no section 'testing'" if isinstance(content, dict) else type(content).__name__
        raise RunFolderError(str(path), found=found, expected="a campaign with all its sections", mend=mend)
    return content


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
    try:
        shards = [
            Shard(
                int(entry["index"]),
                int(entry["first_episode"]),
                int(entry["n_episodes"]),
                {table: path / name for table, name in entry["files"].items() if name},
            )
            for entry in manifest["shards"]
        ]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RunFolderError(
            str(path / "manifest.json"),
            found=f"a shard entry that cannot be read ({error!r})",
            expected="index, first_episode, n_episodes and files per shard",
            mend="Restore the file, or run the campaign again.",
        ) from error
    return tuple(sorted(shards, key=lambda shard: shard.first_episode))
