"""Bring the parts of a run together: a folder as one process would have left it, or none."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.campaign.loading import load_campaign
from harness.campaign.models import Campaign
from harness.errors import EXIT_DONE, RunFolderError, writing
from harness.progress import Progress, SilentProgress
from harness.records.folder import (
    MANIFEST,
    MEND_SHARD,
    read_manifest,
    read_table,
    require_place,
    require_schema,
    write_bytes,
    write_json,
)
from harness.records.reader import footer
from harness.records.stored_manifest import WHOLE, PartManifest, kind_of
from harness.runner.manifest import require_few_failed
from harness.runner.run_result import RunResult
from harness.runner.stored_estimates import estimate_run
from harness.stopped_by import ending

CAMPAIGN = "campaign.yaml"
SAME_SECTIONS = ("name", "records", "stop", "run")
"""Of the campaign, beside what its hash covers: together they must be one run's."""
_AGAIN = "Run the parts again that differ, with --resume, or merge those that belong together."


@dataclass(frozen=True)
class _Part:
    folder: Path
    manifest: dict[str, Any]

    @property
    def number(self) -> int:
        return int(self.manifest["part"]["number"])

    @property
    def of(self) -> int:
        return int(self.manifest["part"]["of"])


def merge_parts(folders: Sequence[Path], out: Path, *, progress: Progress | None = None) -> RunResult:
    """Make one run of its parts; shards are linked where the file system can, and copied elsewhere.

    Parameters
    ----------
    folders : sequence of Path
        What `harness.runner.run_part` has left of every part, in any order.
    out : Path
        New folder. It appears when all is in it.
    progress : Progress, optional

    Raises
    ------
    RunFolderError
        ``out`` is there already; a part is missing, there twice, not finished, damaged, or of another run.
    TooManyFailedError
        More episodes failed than the campaign allows.
    """
    progress = progress or SilentProgress()
    if out.exists() or out.is_symlink():
        mend = "Choose another folder with --out, or remove this one."
        raise RunFolderError(str(out), found="a folder or file that is there already", expected="a new name", mend=mend)
    parts = _in_order(folders)
    campaign = _one_campaign(parts)
    require_place(out.parent)
    out.parent.mkdir(parents=True, exist_ok=True)
    progress.stage("merge", len(parts))
    with TemporaryDirectory(dir=out.parent, prefix=".", suffix=".part") as unfinished:
        folder = Path(unfinished) / out.name
        folder.mkdir()
        shards = _linked(parts, folder, campaign, progress)
        manifest = _joined(parts, shards)
        write_json(folder / MANIFEST, manifest)
        write_bytes(folder / CAMPAIGN, (parts[0].folder / CAMPAIGN).read_bytes())
        progress.stage("estimates and report", None)
        estimates = _estimated(parts, folder)
        from harness.report import write_report  # noqa: PLC0415 - matplotlib, only once the parts are right

        write_report(folder, final=out)
        folder.rename(out)
    return RunResult(out, out / "report.html", estimates, manifest["stopped_by"], manifest["ending"], EXIT_DONE)


def _in_order(folders: Sequence[Path]) -> list[_Part]:
    """All parts of one run, each once, finished, of the same making."""
    parts = []
    for folder in folders:
        manifest = read_manifest(folder)
        if kind_of(manifest) == WHOLE:
            mend = "Name the folders that `harness run --part` has written."
            raise RunFolderError(str(folder), found=WHOLE, expected="a part of one", mend=mend)
        require_schema(manifest, PartManifest, folder / MANIFEST, mend=_AGAIN)
        parts.append(_Part(folder, manifest))
    parts.sort(key=lambda part: part.number)
    _require_alike(parts)
    _require_each_once(parts)
    return parts


def _require_alike(parts: Sequence[_Part]) -> None:
    """Refuse parts that could not have come from one run."""
    for what, value in _OF_ONE_RUN.items():
        first, *others = parts
        for other in others:
            if value(other.manifest) != value(first.manifest):
                raise RunFolderError(
                    str(other.folder),
                    found=f"{what} {value(other.manifest)}",
                    expected=f"{value(first.manifest)}, as in {first.folder}",
                    mend=_AGAIN,
                )


_OF_ONE_RUN: dict[str, Callable[[Mapping[str, Any]], Any]] = {
    "campaign": lambda manifest: manifest["campaign_hash"],
    "a number of parts of": lambda manifest: manifest["part"]["of"],
    "harness": lambda manifest: manifest["versions"].get("harness"),
    "libsumo": lambda manifest: manifest["versions"].get("libsumo") if manifest["engine"] == "sumo" else None,
    "a controller's source file with hash": lambda manifest: manifest.get("controller_sha256"),
}
"""What must be equal; the campaign's hash covers the environment's parameters."""


def _require_each_once(parts: Sequence[_Part]) -> None:
    of = parts[0].of
    numbers = Counter(part.number for part in parts)
    wrong = {
        "given twice": ([n for n in numbers if numbers[n] > 1], "Name each folder once"),
        "missing": ([n for n in range(1, of + 1) if n not in numbers], "Run them"),
        "not finished": (
            [part.number for part in parts if part.manifest["status"] != "done"],
            "Run them again with --resume",
        ),
    }
    for how, (found, mend) in wrong.items():
        if found:
            told = ranges(found)
            where = ", ".join(str(part.folder) for part in parts if part.number in found)
            raise RunFolderError(
                where or "the parts of a run",
                found=f"{how}: part {told} of {of}",
                expected=f"all {of} parts, finished, once each",
                mend=f"{mend} (as a job array takes numbers: {told}), then merge again.",
            )


def ranges(numbers: Sequence[int]) -> str:
    """Ascending numbers as a job array takes them: ``3,7-9``."""
    runs = (list(run) for _, run in groupby(enumerate(numbers), key=lambda each: each[1] - each[0]))
    return ",".join(f"{run[0][1]}-{run[-1][1]}" if len(run) > 1 else str(run[0][1]) for run in runs)


def _one_campaign(parts: Sequence[_Part]) -> Campaign:
    """The parts' campaign; they may differ in what changes neither tests nor records nor their number."""
    read: dict[bytes, Campaign] = {}  # mostly one text
    for part in parts:
        file = part.folder / CAMPAIGN
        if (text := file.read_bytes() if file.is_file() else b"") in read:
            continue
        read[text] = campaign = load_campaign(file, check_files=False)  # says it if there is none
        first = next(iter(read.values()))
        for section in SAME_SECTIONS:
            if (value := getattr(campaign, section)) != (of_first := getattr(first, section)):
                expected = f"{of_first!r}, as in {parts[0].folder}"
                raise RunFolderError(str(file), found=f"{section}: {value!r}", expected=expected, mend=_AGAIN)
    return next(iter(read.values()))


def _linked(parts: Sequence[_Part], folder: Path, campaign: Campaign, progress: Progress) -> list[dict[str, Any]]:
    """Put all shards into a folder, one after another; what the manifest lists of them.

    Raises
    ------
    RunFolderError
        A shard is missing or damaged, or does not continue the last one.
    TooManyFailedError
        More episodes failed than the campaign allows.
    """
    shards: list[dict[str, Any]] = []
    causes = Counter[str]()
    n = 0
    for part in parts:
        for shard in part.manifest["shards"]:
            causes += _checked(part.folder, shard, n)
            n += shard["n_episodes"]
            for file in filter(None, shard["files"].values()):
                _link(part.folder / file, folder / file)
            shards.append(shard)
        progress.advance(1)
    if n != campaign.stop.episodes:
        raise _not_the_tests(parts[-1].folder / MANIFEST, f"{n} tests in all parts", f"{campaign.stop.episodes}")
    require_few_failed(causes.total(), n, causes, campaign.run.max_failed_share)
    return shards


def _checked(folder: Path, shard: Mapping[str, Any], n: int) -> Counter[str]:
    """Causes of failures in a shard whose files are whole, and which begins at the ``n``-th test."""
    if shard["first_episode"] != n:
        found = f"a shard that begins at episode {shard['first_episode']}"
        raise _not_the_tests(folder / MANIFEST, found, f"one that begins at {n}")
    for file in filter(None, shard["files"].values()):
        footer(folder / file)
    file = folder / shard["files"]["episodes"]
    failures = read_table(file, ["failure"]).column("failure")
    if len(failures) != shard["n_episodes"]:
        expected = f"{shard['n_episodes']} rows (manifest.json)"
        raise RunFolderError(str(file), found=f"{len(failures)} rows", expected=expected, mend=MEND_SHARD)
    return Counter(failures.drop_null().to_pylist())


def _not_the_tests(where: Path, found: str, expected: str) -> RunFolderError:
    return RunFolderError(str(where), found=found, expected=expected, mend="Run this part again, into a new folder.")


def _link(file: Path, to: Path) -> None:
    """A second name of the same bytes, or a copy where there can be none; nobody writes into a finished shard."""
    with writing(to):
        to.parent.mkdir(exist_ok=True)
        try:
            os.link(file, to)
        except OSError:  # another file system, or one without links
            shutil.copyfile(file, to)


def _joined(parts: Sequence[_Part], shards: list[dict[str, Any]]) -> dict[str, Any]:
    """The manifest of the whole. Where machines differed each is named, for whoever wonders about a bit."""
    manifests = [part.manifest for part in parts]
    n_episodes = sum(shard["n_episodes"] for shard in shards)
    retraced = manifests[0].get("retraced") or {}
    if "n_episodes" in retraced:  # else it says why not
        retraced = {**retraced, "n_episodes": n_episodes, "n_equal": n_episodes}
    packages = manifests[0]["versions"]
    joined = {
        **manifests[0],
        "created": min(manifest["created"] for manifest in manifests),
        "versions": {name: _each(manifest["versions"].get(name) for manifest in manifests) for name in packages},
        "cpu": _each(manifest["cpu"] for manifest in manifests),
        "workers": sum(manifest["workers"] for manifest in manifests),
        "wall_time_s": round(sum(manifest["wall_time_s"] for manifest in manifests), 3),
        "stopped_by": "episodes",
        "ending": ending("episodes", n_episodes, (), precision_asked=False),
        "retraced": retraced,
        "n_episodes": n_episodes,
        "shards": shards,
    }
    del joined["part"]
    return joined


def _each(values: Iterator[str | None]) -> str:
    return ", ".join(sorted({str(value) for value in values}))


def _estimated(parts: Sequence[_Part], folder: Path) -> dict[str, Any]:
    """Estimates of the whole; a file that cannot be read is named where it came from."""
    try:
        estimates = estimate_run(folder)
    except RunFolderError as error:
        for part in parts:
            if Path(error.where).is_relative_to(folder):
                named = part.folder / Path(error.where).relative_to(folder)
                error.where = str(named) if named.exists() else error.where
        raise
    write_json(folder / "estimates.json", estimates)
    return estimates
