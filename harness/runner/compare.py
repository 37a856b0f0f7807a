"""Compare two AVs on common random numbers: the same episodes with each, and the interval of the difference."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from harness.campaign.campaign import Campaign
from harness.errors import CampaignError, RunFolderError
from harness.estimators.pairs import PairedEstimate
from harness.progress import Progress
from harness.records.folder import read_manifest, require_place, write_json
from harness.resolved import Resolved
from harness.runner.compare_shells import PAIRING, compare_shells, exit_code, shells_content
from harness.runner.manifest import require_own_folder
from harness.runner.prepare import require_ready

Side = Literal["a", "b"]
SIDES: tuple[Side, Side] = ("a", "b")
MAY_DIFFER = frozenset({"av", "name", "description"})


@dataclass(frozen=True)
class Comparison:
    """Two finished campaigns, in run folders ``a`` and ``b``, and the difference.

    ``content`` is that of ``compare.json``. The exit code is 4 when the budget was spent before the asked precision, or
    with the margin open, and 5 when B is worse than A by more than the margin.
    """

    folder: Path
    difference: PairedEstimate
    content: dict[str, Any]
    exit_code: int


def compare_campaigns(
    a: Campaign,
    b: Campaign,
    out: Path,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
    labels: tuple[str, str] | None = None,
    stored: Path | None = None,
    margin: float | None = None,
) -> Comparison:
    """Run two campaigns that differ in the AV over the same episodes, and estimate the difference.

    One rule looks at the difference (`harness.runner.compare_shells`). What an earlier call has finished in ``out`` is
    used again.

    Parameters
    ----------
    a, b : Campaign
        Equal but for ``av``, ``name`` and ``description``.
    out : Path
        Folder; ``out/a`` and ``out/b`` become run folders.
    workers, progress
        See `harness.runner.run_campaign`.
    labels : (str, str), optional
        Names for the answer; the campaigns' own by default.
    stored : Path, optional
        Run folder of A, whose tests are not driven again; it is copied to ``out/a``.
    margin : float, optional
        Decide whether B's rate is at most 1 + margin times A's.

    Raises
    ------
    CampaignError
        The campaigns differ in something else, or do not draw from shells.
    RunFolderError
        ``out`` holds other runs.
    """
    require_comparable(a, b)
    sides: dict[Side, Resolved] = {"a": require_ready(a, "compare"), "b": require_ready(b, "compare")}
    if stored is not None:
        _take_over(stored, out / "a", sides["a"])
    for side, of_side in sides.items():  # both, before either is touched
        require_own_folder(out / side, of_side, resume=True)
    names = labels or (a.name, b.name)
    both, folders = (sides["a"], sides["b"]), (out / "a", out / "b")
    pairs, rule = compare_shells(both, folders, margin=margin, workers=workers, progress=progress)
    content = _content(sides, names, shells_content(pairs, rule, names))
    write_json(out / "compare.json", content)
    return Comparison(out, pairs, content, exit_code(rule, precision_asked=a.stop.rhw is not None))


def require_comparable(a: Campaign, b: Campaign) -> None:
    """Refuse campaigns that differ in more than the vehicle, by a `CampaignError` that names every key that differs."""
    keys = set(MAY_DIFFER)
    apart = list(_differing("", a.model_dump(exclude=keys), b.model_dump(exclude=keys)))
    if not apart:
        return
    where, of_a, of_b = apart[0]
    more = f"; also {', '.join(key for key, _, _ in apart[1:])}" if len(apart) > 1 else ""
    raise CampaignError(
        where,
        found=f"{of_a} in A and {of_b} in B{more}",
        expected=f"campaigns that differ in {', '.join(sorted(keys))} only: pairs of episodes need equal settings",
        mend=f"Make them equal, e.g. with --set {where}=…, which holds for both.",
    )


def _differing(prefix: str, a: Any, b: Any) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(a, dict) and isinstance(b, dict):
        for key in dict.fromkeys([*a, *b]):
            yield from _differing(f"{prefix}.{key}" if prefix else str(key), a.get(key), b.get(key))
        if a == b and list(a) != list(b):
            yield prefix, f"the order {', '.join(a)}", f"{', '.join(b)}"
    elif a != b:
        yield prefix, a, b


def _content(of_sides: dict[Side, Resolved], labels: tuple[str, str], answer: dict[str, Any]) -> dict[str, Any]:
    campaign = of_sides["a"].campaign
    sides = {
        side: {"label": label, "campaign_hash": of_sides[side].content_hash}
        for side, label in zip(SIDES, labels, strict=True)
    }
    return {
        "format": 1,
        "method": campaign.testing.method,
        "seed": campaign.seed,
        "pairing": PAIRING,
        "campaigns": sides,
        **answer,
    }


def _take_over(stored: Path, folder: Path, resolved: Resolved) -> None:
    """Copy a stored run of A, and no other (`RunFolderError`), to where A is to be run, unless it is there already."""
    if folder.exists() and any(folder.iterdir()):
        return
    manifest = read_manifest(stored)
    if manifest["campaign_hash"] != resolved.content_hash:
        raise RunFolderError(
            str(stored),
            found=f"a run of campaign {manifest['campaign_hash']}",
            expected=f"one of A as it is to be compared ({resolved.content_hash})",
            mend="Leave out --set and --av where they change more than the stop rule, or name A's campaign file.",
        )
    require_place(folder.parent)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=folder.parent, prefix=".", suffix=".part") as unfinished:
        copy = shutil.copytree(stored, Path(unfinished) / "a")
        if folder.exists():
            folder.rmdir()
        copy.replace(folder)
