"""Bring the parts of a run together: a folder as one process would have left it, or none.

One run they are if they are all there, each once, finished, of the same making, with their plan if they have one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.errors import RunFolderError
from harness.estimators import Shells
from harness.estimators.round_stopping import RoundRule
from harness.progress import Progress
from harness.records.folder import (
    MANIFEST,
    SHELLS,
    link_or_copy,
    read_manifest,
    require_place,
    require_schema,
    write_bytes,
    write_json,
)
from harness.records.reader import footer, read_shard
from harness.records.stored_manifest import PLAN, WHOLE, PartManifest, PlanManifest, kind_of, plan_hash
from harness.runner.manifest import require_few_failed
from harness.runner.run_result import RunResult, conclusion, exit_code
from harness.runner.shadow_runs import SHADOW
from harness.runner.stored_estimates import estimate_run, stored_blocks
from harness.stopped_by import StoppedBy

CAMPAIGN = "campaign.yaml"
SAME_SECTIONS = ("name", "records", "stop", "run")
"""Of the campaign, beside what its hash covers: together they must be one run's."""
_AGAIN = "Run the parts again that differ, with --resume, or merge those that belong together."


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
    progress = progress or Progress()
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


@dataclass(frozen=True)
class PartFolder:
    """What `harness.runner.run_part` has left, or `harness.runner.plan_second_phase`."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def number(self) -> int:
        """Of a part, from 1 on."""
        return int(self.manifest["part"]["number"])


def in_order(folders: Sequence[Path]) -> list[PartFolder]:
    """All that makes one run, in the order of its tests: the plan, if its parts have one, comes first.

    Raises
    ------
    RunFolderError
        A part or the plan is missing, there twice, not finished, or of another run.
    """
    plans: list[PartFolder] = []
    parts: list[PartFolder] = []
    for folder in folders:
        manifest = read_manifest(folder)
        if (kind := kind_of(manifest)) == WHOLE:
            mend = "Name the folders that `harness run --part` has written, and their plan if they have one."
            raise RunFolderError(str(folder), found=WHOLE, expected="a part of one", mend=mend)
        model = PlanManifest if kind == PLAN else PartManifest
        require_schema(manifest, model, folder / MANIFEST, mend=_AGAIN)
        (plans if kind == PLAN else parts).append(PartFolder(folder, manifest))
    parts.sort(key=lambda part: part.number)
    _require_a_plan(plans, parts)
    _require_alike(parts, lambda manifest: {"a number of parts of": manifest["part"]["of"]})
    _require_alike([*plans, *parts], _making)
    _require_each_once(parts)
    return [*plans, *parts]


def _require_a_plan(plans: Sequence[PartFolder], parts: Sequence[PartFolder]) -> None:
    """Refuse a plan by itself, several, one that is not finished, or none for parts that have one."""

    def refusal(where: Sequence[PartFolder], found: str, expected: str, mend: str) -> RunFolderError:
        return RunFolderError(", ".join(str(each.folder) for each in where), found=found, expected=expected, mend=mend)

    planned = [part for part in parts if part.manifest.get("plan")]
    if planned and not plans:
        mend = "Name the plan's folder too: harness merge PLAN PART... --out DIR."
        raise refusal(planned[:1], kind_of(planned[0].manifest), "its plan beside it", mend)
    if len(plans) > 1:
        raise refusal(plans, f"{len(plans)} plans", "the one that the parts were begun from", "Name that one.")
    for plan in plans:
        if plan.manifest["status"] != "done":
            mend = "Let `harness plan` go on with --resume, then merge again."
            raise refusal(plans, "not finished: the plan", "a finished one", mend)
        if not parts:
            mend = f"Run its parts, `harness run {plan.folder} --part K/N --out PART`, and name them too."
            raise refusal(plans, "a plan by itself", "all parts of its second phase", mend)


def _require_alike(folders: Sequence[PartFolder], making: Callable[[Mapping[str, Any]], dict[str, Any]]) -> None:
    """Refuse parts that could not have come from one run."""
    first, *others = folders
    for what, expected in making(first.manifest).items():
        for other in others:
            if (found := making(other.manifest)[what]) != expected:
                as_first = f"{expected}, as in {first.folder}"
                raise RunFolderError(str(other.folder), found=f"{what} {found}", expected=as_first, mend=_AGAIN)


def _making(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """What must be equal; the campaign's hash covers the environment's parameters."""
    versions = manifest["versions"]
    return {
        "campaign": manifest["campaign_hash"],
        "plan": plan_hash(manifest.get("plan")),
        "harness": versions.get("harness"),
        "libsumo": versions.get("libsumo") if manifest["engine"] == "sumo" else None,
        "a controller's source file with hash": manifest.get("controller_sha256"),
    }


def _require_each_once(parts: Sequence[PartFolder]) -> None:
    of = parts[0].manifest["part"]["of"]
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


def one_campaign(parts: Sequence[PartFolder]) -> Campaign:
    """The parts' campaign; they may not differ (`RunFolderError`) in what changes tests, records or their number."""
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


def _linked(parts: Sequence[PartFolder], folder: Path, campaign: Campaign, progress: Progress) -> list[dict[str, Any]]:
    """Put all shards into a folder, one after another; what the manifest lists of them.

    A `RunFolderError` names one that is missing or damaged, or does not continue the last one.
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
    failures, _ = read_shard(folder, shard, episode_columns=["failure"], moment_columns=[])
    return Counter(failures.column("failure").drop_null().to_pylist())


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
    rule, seen = RoundRule(campaign), Shells()
    if manifest["reported_from"]:
        rule.of_first_tests = True
        for block in stored_blocks(folder, moments=False):
            seen.add(block)
        rule.observe(seen)
    return conclusion(campaign, rule, manifest["n_episodes"], manifest["reported_from"])


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
