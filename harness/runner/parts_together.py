"""Which folders make one run: all parts, each once, finished, of the same making, and their plan if they have one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from harness.campaign.loading import load_campaign
from harness.campaign.models import Campaign
from harness.errors import RunFolderError
from harness.records.folder import MANIFEST, read_manifest, require_schema
from harness.records.stored_manifest import PLAN, WHOLE, PartManifest, PlanManifest, kind_of, plan_hash

CAMPAIGN = "campaign.yaml"
SAME_SECTIONS = ("name", "records", "stop", "run")
"""Of the campaign, beside what its hash covers: together they must be one run's."""
_AGAIN = "Run the parts again that differ, with --resume, or merge those that belong together."


@dataclass(frozen=True)
class PartFolder:
    """What `harness.runner.run_part` has left, or `harness.runner.plan_second_phase`."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def number(self) -> int:
        """Of a part, from 1 on."""
        return int(self.manifest["part"]["number"])

    @property
    def of(self) -> int:
        """How many parts there are."""
        return int(self.manifest["part"]["of"])


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
    _require_alike(parts, {"a number of parts of": lambda manifest: manifest["part"]["of"]})
    _require_alike([*plans, *parts], _OF_ONE_RUN)
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


def _require_alike(folders: Sequence[PartFolder], values: Mapping[str, Callable[[Mapping[str, Any]], Any]]) -> None:
    """Refuse parts that could not have come from one run."""
    first, *others = folders
    for what, value in values.items():
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
    "plan": lambda manifest: plan_hash(manifest.get("plan")),
    "harness": lambda manifest: manifest["versions"].get("harness"),
    "libsumo": lambda manifest: manifest["versions"].get("libsumo") if manifest["engine"] == "sumo" else None,
    "a controller's source file with hash": lambda manifest: manifest.get("controller_sha256"),
}
"""What must be equal; the campaign's hash covers the environment's parameters."""


def _require_each_once(parts: Sequence[PartFolder]) -> None:
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


def one_campaign(parts: Sequence[PartFolder]) -> Campaign:
    """The parts' campaign; they may differ in what changes neither tests nor records nor their number.

    Raises
    ------
    HarnessError
        They differ in more, or a campaign cannot be read.
    """
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
