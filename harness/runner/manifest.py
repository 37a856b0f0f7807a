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
from harness.records.folder import MANIFEST, read_manifest, require_place, write_json, write_text
from harness.runner.repeat import Repeated
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


def require_own_folder(
    folder: Path, content_hash: str, controller: str | None, *, resume: bool
) -> dict[str, Any] | None:
    """Refuse a folder that holds something else; return the manifest of a run to be continued.

    Parameters
    ----------
    folder : Path
    content_hash : str
        Of the campaign.
    controller : str, optional
        Hash of the AV's own code: one file may not mix two versions of it.
    resume : bool
        Whether to continue what the folder holds.

    Raises
    ------
    RunFolderError
        The folder cannot be written to, holds another campaign, this one without ``--resume`` or with another
        controller, or files that are no run.
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
    manifest = read_manifest(folder, mend="Choose another folder with --out.")
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
    if manifest.get("controller_sha256") != controller:
        raise RunFolderError(
            str(folder),
            found="tests of this campaign whose controller's source file has been changed since",
            expected="the same controller for all tests of a run",
            mend="Restore the file, or test the new controller in another folder with --out.",
        )
    return manifest


def require_no_fewer(folder: Path, earlier: dict[str, Any] | None, n_episodes: int) -> None:
    """Refuse to throw away tests that an earlier run has finished.

    Raises
    ------
    RunFolderError
        The folder holds more tests than the stop rule that is asked for now would keep.
    """
    held = 0 if earlier is None else int(earlier["n_episodes"])
    if n_episodes < held:
        raise RunFolderError(
            str(folder),
            found=f"{held:,} finished tests, of which the campaign as it is asked for now would keep {n_episodes:,}",
            expected="a stop rule (stop.rhw, stop.episodes) that needs at least the tests that are there",
            mend="Repeat the --set options of the earlier run or ask for more; `harness estimate` reads what is there.",
        )


class Manifest:
    """Keeps ``manifest.json`` and ``campaign.yaml`` of a run folder true."""

    def __init__(
        self, folder: Path, campaign: Campaign, content_hash: str, earlier: dict[str, Any] | None, **facts: Any
    ) -> None:
        self._folder = folder
        self._campaign = dump_campaign(campaign)
        self._reproducible = campaign.av.reproducible
        self._earlier = earlier
        self._n_kept = int((earlier or {}).get("n_episodes", 0))
        self._wall_time_s = float((earlier or {}).get("wall_time_s", 0.0))
        self._content: dict[str, Any] = {
            "format": 1,
            "name": campaign.name,
            "campaign_hash": content_hash,
            "created": (earlier or {}).get("created") or datetime.now(UTC).isoformat(timespec="seconds"),
            "seed": campaign.seed,
            "engine": campaign.world.engine,
            "versions": versions(),
            "cpu": cpu_name(),
            **facts,
        }
        folder.mkdir(parents=True, exist_ok=True)
        self.write([], [], status="running")  # first: --resume knows a folder by its manifest

    def forget_replaced(self, spec: ShardSpec) -> None:
        """Cut what an earlier run has left before the shard that this one is about to take the place of, if it does.

        One of the same size whose file is missing is only made anew.
        """
        earlier = [] if self._earlier is None else self._earlier["shards"]
        if self._earlier is None or spec.index >= len(earlier):
            return
        shard = earlier[spec.index]
        if shard["n_episodes"] == spec.n_episodes and not (self._folder / shard["files"]["episodes"]).exists():
            return
        self._n_kept = sum(shard["n_episodes"] for shard in earlier[: spec.index])
        cut = {"status": "interrupted", "stopped_by": None, "ending": None, "n_episodes": self._n_kept}
        self._earlier = {**self._earlier, **cut, "shards": earlier[: spec.index]}
        write_json(self._folder / MANIFEST, self._earlier)

    def write(
        self,
        specs: Sequence[ShardSpec],
        files: Sequence[dict[str, str]],
        *,
        status: str,
        elapsed_s: float = 0.0,
        stopped_by: str | None = None,
        ending: str | None = None,
        retraced: dict[str, Any] | None = None,
        repeated: Repeated | None = None,
    ) -> None:
        """Record the contiguous prefix of finished shards.

        While a run goes on and has not come as far as an earlier one, what that one has left stays true.
        """
        n_episodes = sum(spec.n_episodes for spec in specs)
        if status != "done" and n_episodes < self._n_kept:
            return
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
                "ending": ending,
                "retraced": retraced,
                "reproducible": self._reproducible and not (repeated and repeated.differing),
                "repeated": None if repeated is None else repeated.to_json(),
                "wall_time_s": round(self._wall_time_s + elapsed_s, 3),
                "n_episodes": n_episodes,
                "shards": shards,
            },
        )
        write_text(self._folder / "campaign.yaml", self._campaign)
