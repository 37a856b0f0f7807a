"""What a run folder holds of a run: the manifest that tells of it, and what ``--resume`` takes over.

A shard whose file of episodes is there is complete: `harness.records.folder.write_shard` writes that last. Baseline
runs are taken over in `harness.sampling.baseline`.
"""

from __future__ import annotations

import platform
import time
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from harness.campaign.files import dump_campaign
from harness.errors import RunFolderError, TooManyFailedError
from harness.files import checksum
from harness.records.folder import (
    CAMPAIGN,
    MANIFEST,
    SHELLS,
    Repeated,
    listed_crc32,
    read_as,
    read_manifest,
    read_table,
    require_place,
    shard_files,
    write_bytes,
    write_sealed,
)
from harness.records.origin import signature
from harness.records.schemas import ShardTables
from harness.resolved import Resolved
from harness.runner.workers import ShardResult, finished
from harness.sampling.protocol import ShardRequest, Source

INTERVAL_S = 5.0
SMALLEST_FAILED_SAMPLE = 200
"""Episodes before the share of failures can end a campaign."""
_PACKAGES = ("harness", "libsumo", "numba", "llvmlite", "numpy", "scipy", "pyarrow")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version(), **{package: metadata.version(package) for package in _PACKAGES}}


def cpu_name() -> str:
    """Model name of the processor: bits are promised for one CPU family."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def require_few_failed(
    n_failed: int, n: int, causes: Counter[str], most: float, what: str = "episodes", where: str = "the episodes table"
) -> None:
    """Refuse (`TooManyFailedError`) an answer where more than the share ``most`` of tests, or ``what`` else, failed."""
    if n_failed > most * n:
        cause = "".join(f", {n_such} of them with: {why}" for why, n_such in causes.most_common(1))
        raise TooManyFailedError(
            "run.max_failed_share",
            f"{n_failed} of {n} {what} failed{cause}",
            f"a share of at most {most:g}",
            "Mend the AV (`harness av-check` looks at it in seconds), or raise the share to go on. All causes "
            f"are in the column 'failure' of {where}.",
        )


class Manifest:
    """Finished shards in order, from the first on, and counts over them: keeps ``manifest.json`` and its campaign true.

    ``earlier`` is what `require_own_folder` found, ``began`` `time.monotonic` at the run's beginning; ``facts`` are
    more keys.
    """

    def __init__(
        self, folder: Path, resolved: Resolved, earlier: dict[str, Any], *, began: float, **facts: Any
    ) -> None:
        self._folder, self._earlier, self._campaign = folder, earlier, resolved.campaign
        campaign, self._yaml = self._campaign, dump_campaign(self._campaign).encode()
        self.shards: list[dict[str, Any]] = []
        self.n_episodes = self.n_crashes = self._n_failed = 0
        self._repeated: Repeated | None = None
        self._causes: Counter[str] = Counter()
        self._began = began - float(earlier.get("wall_time_s") or 0.0)
        self._content: dict[str, Any] = {
            "format": 1,
            "name": campaign.name,
            "campaign_hash": resolved.content_hash,
            "campaign_crc32": zlib.crc32(self._yaml),
            "signature": signature(self._yaml),
            "created": earlier.get("created") or datetime.now(UTC).isoformat(timespec="seconds"),
            "seed": campaign.seed,
            "engine": campaign.world.engine,
            "versions": versions(),
            "cpu": cpu_name(),
            "controller_sha256": resolved.controller_sha256,
            **facts,
        }
        self._written = began
        self.write("running")  # first: --resume knows a folder by its manifest

    def add(self, done: ShardResult) -> None:
        """Append a shard that is on disk."""
        request = done.request
        place = {name: getattr(request, name) for name in ("index", "first_episode", "n_episodes")}
        self.shards.append({**place, "files": done.files, "crc32": done.crc32})
        self.n_episodes += request.n_episodes
        self.n_crashes += int(done.block.crash.sum())
        self._n_failed += int(done.block.failed.sum())
        self._causes += done.failures
        self._repeated = self._repeated or done.repeated

    def require_few_failed(self, *, at_least: int = 0) -> None:
        """Refuse an answer from tests of which too many failed, once there are ``at_least`` so many."""
        if self.n_episodes >= at_least:
            most = self._campaign.run.max_failed_share
            require_few_failed(self._n_failed, self.n_episodes, self._causes, most)

    def listed(self, request: ShardRequest) -> dict[str, Any]:
        """What an earlier run has noted of a shard of the same place and size; empty if it has not."""
        found: list[dict[str, Any]] = self._earlier["shards"][request.index : request.index + 1]
        return next((shard for shard in found if shard["n_episodes"] == request.n_episodes), {})

    def earlier(self, key: str) -> Sequence[int]:
        """Checksums that an earlier run has noted of what comes before tests."""
        found: Sequence[int] = self._earlier.get(key, ())
        return found

    def forget_replaced(self, request: ShardRequest) -> None:
        """Cut what an earlier run has left before the shard that this one is about to take the place of, if it does.

        One of the same size whose file is missing is only made anew.
        """
        shards, listed = self._earlier["shards"], self.listed(request)
        if request.index >= len(shards):
            return
        if listed and not (self._folder / listed["files"]["episodes"]).exists():
            listed.pop("crc32", None)  # another version of pyarrow writes other bytes
            write_sealed(self._folder / MANIFEST, self._earlier)
            return
        kept = shards[: request.index]
        cut: dict[str, Any] = {"status": "interrupted", "stopped_by": None, "unmet": []}
        n_kept = sum(shard["n_episodes"] for shard in kept)
        self._earlier = {**self._earlier, **cut, "n_episodes": n_kept, "shards": kept}
        write_sealed(self._folder / MANIFEST, self._earlier)

    def note(self, **facts: Any) -> None:
        """More keys, from the next time on that it is written."""
        self._content.update(facts)

    def follow(self) -> None:
        """Write it every few seconds, so that a run which goes on can be read."""
        if time.monotonic() - self._written > INTERVAL_S:
            self.write("running")

    def write(self, status: str, **of_the_end: Any) -> None:
        """Record the finished shards.

        While a run goes on and has not come as far as an earlier one, what that one has left stays true.
        """
        self._written = time.monotonic()
        if status != "done" and self.n_episodes < self._earlier["n_episodes"]:
            return
        repeated = self._repeated
        content = {
            **self._content,
            "status": status,
            "stopped_by": None,
            "unmet": [],
            **of_the_end,
            "reproducible": self._campaign.av.reproducible and not (repeated and repeated.differing),
            "repeated": None if repeated is None else asdict(repeated),
            "wall_time_s": round(self._written - self._began, 3),
            "n_episodes": self.n_episodes,
            "shards": self.shards,
        }
        path = self._folder / CAMPAIGN
        if not path.exists() or path.read_bytes() != self._yaml:
            # Until it is there no checksum is told: not of the old one, nor of this.
            write_sealed(self._folder / MANIFEST, {**content, "campaign_crc32": None})
            write_bytes(path, self._yaml)
        write_sealed(self._folder / MANIFEST, content)


def require_own_folder(folder: Path, resolved: Resolved, *, resume: bool) -> dict[str, Any]:
    """Refuse a folder that holds something else; return the manifest of a run to be continued, or one without shards.

    Raises `RunFolderError`: the folder cannot be written to, holds another campaign, this one without ``--resume`` or
    with another controller (one file may not mix two versions of it), or files that are no run.
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


def stored_shard(folder: Path, source: Source, listed: Mapping[str, Any], request: ShardRequest) -> ShardResult | None:
    """A shard that needs not be run again, or None; ``listed`` is what the manifest tells of it (`Manifest.listed`).

    It is taken over if its episodes are on disk, and its moments where the campaign keeps some, with as many rows as
    are wanted and, of shells, the cut-ins that are to be drawn now.

    Raises `RunFolderError`: one of its files is damaged.
    """
    files = shard_files(folder, request.index)
    needed = {"episodes"} | (
        {"moments"} if source.campaign.sampling.mixes and source.campaign.records.moments != "none" else set()
    )
    if not needed <= files.keys():
        return None
    tables = {name: read_table(folder / path, crc32=listed_crc32(listed, name)) for name, path in files.items()}
    kept = ShardTables(tables["episodes"], tables.get("moments"), tables.get("traces"))
    if not source.is_shard(request, kept.episodes):
        return None
    crc32 = {name: checksum(folder / path) for name, path in files.items()}
    return replace(finished(source, request, kept), files=files, crc32=crc32)
