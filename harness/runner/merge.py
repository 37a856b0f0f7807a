"""Bring the parts of a run together: a folder as one process would have left it, or none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.campaign.models import Campaign
from harness.errors import RunFolderError
from harness.estimators import Shells
from harness.estimators.round_stopping import RoundRule
from harness.progress import Progress, SilentProgress
from harness.records.folder import (
    MANIFEST,
    MEND_SHARD,
    SHELLS,
    link_or_copy,
    read_table,
    require_place,
    write_bytes,
    write_json,
)
from harness.records.reader import footer
from harness.runner.manifest import require_few_failed
from harness.runner.parts_together import CAMPAIGN, PartFolder, in_order, one_campaign
from harness.runner.run_result import RunResult, exit_code, what_stopped
from harness.runner.shadow_runs import SHADOW
from harness.runner.stored_estimates import estimate_run, stored_blocks
from harness.stopped_by import StoppedBy, ending


def merge_parts(folders: Sequence[Path], out: Path, *, progress: Progress | None = None) -> RunResult:
    """Make one run of its parts; shards are linked where the file system can, and copied elsewhere.

    Parameters
    ----------
    folders : sequence of Path
        What `harness.runner.run_part` has left of every part, in any order; with the plan, if they are parts of one.
    out : Path
        New folder. It appears when all is in it.
    progress : Progress, optional

    Raises
    ------
    RunFolderError
        ``out`` is there already; a part or its plan is missing, there twice, not finished, damaged, or of another run.
    TooManyFailedError
        More episodes failed than the campaign allows.
    """
    progress = progress or SilentProgress()
    if out.exists() or out.is_symlink():
        mend = "Choose another folder with --out, or remove this one."
        raise RunFolderError(str(out), found="a folder or file that is there already", expected="a new name", mend=mend)
    parts = in_order(folders)
    campaign = one_campaign(parts)
    require_place(out.parent)
    out.parent.mkdir(parents=True, exist_ok=True)
    progress.stage("merge", len(parts))
    with TemporaryDirectory(dir=out.parent, prefix=".", suffix=".part") as unfinished:
        folder = Path(unfinished) / out.name
        folder.mkdir()
        shards = _linked(parts, folder, campaign, progress)
        manifest = _joined(parts, shards)
        write_bytes(folder / CAMPAIGN, (parts[0].folder / CAMPAIGN).read_bytes())
        if manifest["reported_from"]:
            lent = parts[0].folder
            for file in (lent / SHELLS, *(lent / SHADOW).glob("*.parquet")):
                link_or_copy(file, folder / file.relative_to(lent))
        write_json(folder / MANIFEST, manifest)
        stopped_by, manifest["ending"] = _ended(folder, campaign, manifest)
        write_json(folder / MANIFEST, {**manifest, "stopped_by": stopped_by})
        progress.stage("estimates and report", None)
        estimates = _estimated(parts, folder)
        from harness.report import write_report  # noqa: PLC0415 - matplotlib, only once the parts are right

        write_report(folder, final=out)
        folder.rename(out)
    code = exit_code(campaign, stopped_by, None)
    return RunResult(out, out / "report.html", estimates, stopped_by, manifest["ending"], code)


def _linked(parts: Sequence[PartFolder], folder: Path, campaign: Campaign, progress: Progress) -> list[dict[str, Any]]:
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
                link_or_copy(part.folder / file, folder / file)
            shards.append(shard)
        progress.advance(1)
    plan = parts[0].manifest.get("plan")
    expected = campaign.stop.episodes if plan is None else plan["first_episode"] + sum(plan["tests"])
    if n != expected:
        raise _not_the_tests(parts[-1].folder / MANIFEST, f"{n} tests in all parts", f"{expected}")
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


def _joined(parts: Sequence[PartFolder], shards: list[dict[str, Any]]) -> dict[str, Any]:
    """The manifest of the whole. Where machines differed each is named, for whoever wonders about a bit."""
    manifests = [part.manifest for part in parts]
    n_episodes = sum(shard["n_episodes"] for shard in shards)
    retraced = manifests[0].get("retraced") or {}
    if "n_episodes" in retraced:  # else it says why not
        retraced = {**retraced, "n_episodes": n_episodes, "n_equal": n_episodes}
    packages, plan = manifests[0]["versions"], manifests[0].get("plan")
    joined = {
        **manifests[0],
        "created": min(manifest["created"] for manifest in manifests),
        "versions": {name: _each(manifest["versions"].get(name) for manifest in manifests) for name in packages},
        "cpu": _each(manifest["cpu"] for manifest in manifests),
        "workers": sum(manifest["workers"] for manifest in manifests),
        "wall_time_s": round(sum(manifest["wall_time_s"] for manifest in manifests), 3),
        "retraced": retraced,
        "n_episodes": n_episodes,
        "reported_from": 0 if plan is None else plan["first_episode"],
        "shards": shards,
    }
    return {key: value for key, value in joined.items() if key not in ("part", "plan")}


def _ended(folder: Path, campaign: Campaign, manifest: Mapping[str, Any]) -> tuple[StoppedBy, str]:
    """What one process would have said of why it ended: after a plan it looks at the second phase once, at its end."""
    n_episodes, reported_from = manifest["n_episodes"], manifest["reported_from"]
    if not reported_from:
        return "episodes", ending("episodes", n_episodes, (), precision_asked=False)
    rule, seen = RoundRule(campaign), Shells()
    rule.of_first_tests = True
    for block in stored_blocks(folder, moments=False):
        seen.add(block)
    rule.observe(seen)
    stopped_by = what_stopped(campaign, rule, n_episodes, reported_from)
    return stopped_by, ending(stopped_by, n_episodes, rule.waited_for, precision_asked=True)


def _each(values: Iterator[str | None]) -> str:
    return ", ".join(sorted({str(value) for value in values}))


def _estimated(parts: Sequence[PartFolder], folder: Path) -> dict[str, Any]:
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
