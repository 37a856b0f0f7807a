"""The manifest of a run: what was run, with what, and which shards count."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from harness.campaign.dumping import dump_campaign
from harness.campaign.models import Campaign
from harness.errors import RunFolderError
from harness.records.folder import MANIFEST, read_json, require_place, write_json, write_text
from harness.runner.worker import ShardSpec

_PACKAGES = ("harness", "libsumo", "numba", "llvmlite", "numpy", "scipy", "pyarrow")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def cpu_name() -> str:
    """Model name of the processor: bits are promised for one CPU family."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def require_own_folder(folder: Path, content_hash: str, *, resume: bool) -> dict[str, Any] | None:
    """Refuse a folder that holds something else; return the manifest of a run to be continued.

    Raises
    ------
    RunFolderError
        The folder cannot be written to, holds another campaign, this one without ``--resume``, or files that are no
        run.
    """
    require_place(folder)
    if not folder.exists() or not any(folder.iterdir()):
        return None
    if not (folder / MANIFEST).exists():
        raise RunFolderError(
            str(folder),
            found="a folder with other files",
            expected="a new or empty folder, or one that a run has left",
            mend="Choose another folder with --out.",
        )
    manifest = read_json(folder / MANIFEST, mend="Choose another folder with --out.")
    if manifest.get("campaign_hash") != content_hash:
        raise RunFolderError(
            str(folder),
            found=f"another campaign ({manifest.get('name')}, {manifest.get('campaign_hash')})",
            expected=f"a folder for this one ({content_hash})",
            mend="Choose another folder with --out, or run the campaign.yaml that it holds.",
        )
    if not resume:
        raise RunFolderError(
            str(folder),
            found="this campaign, already begun",
            expected="a new or empty folder",
            mend="Continue it with --resume, or choose another folder with --out.",
        )
    return manifest


class Manifest:
    """Keeps ``manifest.json`` and ``campaign.yaml`` of a run folder true."""

    def __init__(
        self, folder: Path, campaign: Campaign, content_hash: str, earlier: dict[str, Any] | None, **facts: Any
    ) -> None:
        self._folder = folder
        self._wall_time_s = float((earlier or {}).get("wall_time_s", 0.0))
        self._content: dict[str, Any] = {
            "format": 1,
            "name": campaign.name,
            "campaign_hash": content_hash,
            "created": (earlier or {}).get("created") or datetime.now(UTC).isoformat(timespec="seconds"),
            "seed": campaign.seed,
            "engine": campaign.world.engine,
            "reproducible": campaign.av.reproducible,
            "versions": versions(),
            "cpu": cpu_name(),
            **facts,
        }
        folder.mkdir(parents=True, exist_ok=True)
        self.write([], [], status="running")  # first: --resume knows a folder by its manifest
        write_text(folder / "campaign.yaml", dump_campaign(campaign))

    def write(
        self,
        specs: Sequence[ShardSpec],
        files: Sequence[dict[str, str]],
        *,
        status: str,
        elapsed_s: float = 0.0,
        stopped_by: str | None = None,
        retraced: dict[str, Any] | None = None,
    ) -> None:
        """Record the contiguous prefix of finished shards."""
        shards = [
            {"index": spec.index, "first_episode": spec.first_episode, "n_episodes": spec.n_episodes, "files": file}
            for spec, file in zip(specs, files, strict=True)
        ]
        write_json(
            self._folder / MANIFEST,
            {
                **self._content,
                "status": status,
                "stopped_by": stopped_by,
                "retraced": retraced,
                "wall_time_s": round(self._wall_time_s + elapsed_s, 3),
                "n_episodes": sum(spec.n_episodes for spec in specs),
                "shards": shards,
            },
        )
