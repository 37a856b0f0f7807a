"""Compare two AVs on common random numbers: the same episodes with each, and the interval of the difference."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from harness.campaign.campaign import Campaign
from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, CampaignError, RunFolderError
from harness.estimators.block import Block
from harness.estimators.difference import Difference, difference_statement, paired_difference
from harness.estimators.from_records import EPISODE_COLUMNS, block_from_tables
from harness.estimators.pairs import PairedEstimate
from harness.importance.build import mixture_weights
from harness.progress import Progress
from harness.records.folder import MANIFEST, read_json, read_manifest, require_place, require_schema, write_json
from harness.records.reader import read_shards
from harness.records.stored_manifest import StoredStops
from harness.resolved import Resolved
from harness.runner.campaign_run import run_campaign
from harness.runner.compare_shells import PAIRING, compare_shells, exit_code, shells_content
from harness.runner.manifest import require_own_folder
from harness.runner.prepare import require_ready
from harness.runner.run_result import RunResult
from harness.vocabulary import STATE_COLUMNS

Side = Literal["a", "b"]
SIDES: tuple[Side, Side] = ("a", "b")
STOPS = "stops.json"
MAY_DIFFER = frozenset({"av", "name", "description"})


@dataclass(frozen=True)
class Comparison:
    """Two finished campaigns, in run folders ``a`` and ``b``, and the difference, under shells a `PairedEstimate`.

    ``content`` is that of ``compare.json``. The exit code is 4 when the budget was spent before the asked precision, or
    with the margin open, and 5 when B is worse than A by more than the margin.
    """

    folder: Path
    difference: Difference | PairedEstimate
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

    Each runs to its own stop rule; then the shorter one is continued to the length of the longer. Under shells there is
    one rule, of the difference (`harness.runner.compare_shells`). What an earlier call has finished in ``out`` is used
    again.

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
        Under shells, decide whether B's rate is at most 1 + margin times A's.

    Raises
    ------
    CampaignError
        The campaigns differ in something else.
    RunFolderError
        ``out`` holds other runs.
    """
    require_comparable(a, b)
    if margin is not None and a.testing.method != "shells":
        mend = "Write --set testing.method=shells, or read the ratio's interval."
        raise CampaignError("--margin", found=f"method {a.testing.method}", expected="shells", mend=mend)
    if a.accept is not None or b.accept is not None:
        mend = "Write --set accept=null, and --margin if something is to be decided."
        raise CampaignError("accept", found="a limit of one crash rate", expected="none in a comparison", mend=mend)
    sides: dict[Side, Resolved] = {"a": require_ready(a), "b": require_ready(b)}
    if stored is not None:
        _take_over(stored, out / "a", sides["a"])
    for side, of_side in sides.items():  # both, before either is touched
        require_own_folder(out / side, of_side, resume=True)
    names = labels or (a.name, b.name)
    if a.testing.method == "shells":
        both, folders = (sides["a"], sides["b"]), (out / "a", out / "b")
        pairs, rule = compare_shells(both, folders, margin=margin, workers=workers, progress=progress)
        content = _content(sides, names, shells_content(pairs, rule, margin, names))
        write_json(out / "compare.json", content)
        return Comparison(out, pairs, content, exit_code(rule, precision_asked=a.stop.rhw is not None))
    return _compare_weighted(sides, out, names, workers=workers, progress=progress)


def _compare_weighted(
    sides: dict[Side, Resolved], out: Path, names: tuple[str, str], *, workers: int | None, progress: Progress | None
) -> Comparison:
    """Each to its own stop rule, then both to the same length."""
    a, b = (sides[side].campaign for side in SIDES)
    stops = _Stops(out, sides)

    def run(side: Side, of_side: Resolved) -> RunResult:
        return run_campaign(of_side, out / side, workers=workers, resume=True, shorten=True, progress=progress)

    for side, of_side in sides.items():
        if not stops.known(side):
            result = run(side, of_side)
            stops.note(side, int(result.estimates["n_episodes"]), result.stopped_by)
    n = max(stops.of(side)["n_episodes"] for side in SIDES)
    for side, of_side in sides.items():
        if not _is_done(out / side, n):
            run(side, _exactly(of_side, n))
    found = paired_difference(_pairs(a, b, out), a.stop.confidence)
    own = {side: {"own_stop": stops.of(side)} for side in SIDES}
    answer = {**found.to_json(), "statement": difference_statement(found, *names)}
    content = _content(sides, names, answer, own)
    write_json(out / "compare.json", content)
    missed = a.stop.rhw is not None and any(stops.of(side)["stopped_by"] != "rhw" for side in SIDES)
    return Comparison(out, found, content, EXIT_BUDGET_SPENT if missed else EXIT_DONE)


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


class _Stops:
    """Where each campaign's own stop rule ended, kept in a file: a continued folder does not say it any more."""

    def __init__(self, folder: Path, sides: dict[Side, Resolved]) -> None:
        self._folder, self._file = folder, folder / STOPS
        self._asked = {
            side: {"campaign_hash": of_side.content_hash, "stop": of_side.campaign.stop.model_dump()}
            for side, of_side in sides.items()
        }
        self._notes: dict[str, Any] = {}
        if self._file.exists():
            mend = "Delete it: the stop rules are then run through again."
            self._notes = read_json(self._file, mend=mend)
            require_schema(self._notes, StoredStops, self._file, mend=mend)

    def known(self, side: Side) -> bool:
        """Whether an earlier call took this campaign to its stop, and its run is still there."""
        note, folder = self._notes.get(side) or {}, self._folder / side
        same = all(note.get(key) == value for key, value in self._asked[side].items())
        return same and (folder / MANIFEST).exists() and read_manifest(folder)["campaign_hash"] == note["campaign_hash"]

    def note(self, side: Side, n_episodes: int, stopped_by: str) -> None:
        self._notes[side] = {**self._asked[side], "n_episodes": n_episodes, "stopped_by": stopped_by}
        write_json(self._file, self._notes)

    def of(self, side: Side) -> dict[str, Any]:
        """How many tests it took, and what ended it."""
        return {key: self._notes[side][key] for key in ("n_episodes", "stopped_by")}


def _is_done(folder: Path, n_episodes: int) -> bool:
    manifest = read_manifest(folder)
    return manifest.get("status") == "done" and manifest["n_episodes"] == n_episodes


def _exactly(resolved: Resolved, n_episodes: int) -> Resolved:
    """The campaign with a fixed number of episodes instead of its stop rule; its episodes are the same."""
    stop = resolved.campaign.stop.model_copy(update={"rhw": None, "episodes": n_episodes})
    return replace(resolved, campaign=resolved.campaign.model_copy(update={"stop": stop}))


def _pairs(a: Campaign, b: Campaign, out: Path) -> Iterator[tuple[Block, Block]]:
    columns = [*EPISODE_COLUMNS, *STATE_COLUMNS]
    shards = (read_shards(out / side, episode_columns=columns, moment_columns=[]) for side in SIDES)
    for (of_a, _), (of_b, _) in zip(*shards, strict=True):
        if any(of_a[name] != of_b[name] for name in STATE_COLUMNS):
            raise RunFolderError(
                str(out),
                found="episodes of one index that begin differently in a and b",
                expected="the same random numbers in both",
                mend="The two were run with different versions; choose another folder with --out.",
            )
        block_a, block_b = (
            block_from_tables(table, None, method=campaign.testing.method, alpha=mixture_weights(campaign))
            for table, campaign in ((of_a, a), (of_b, b))
        )
        yield block_a, block_b


def _content(
    of_sides: dict[Side, Resolved],
    labels: tuple[str, str],
    answer: dict[str, Any],
    facts: Mapping[Side, dict[str, Any]] | None = None,
) -> dict[str, Any]:
    campaign = of_sides["a"].campaign
    sides = {
        side: {"label": label, "campaign_hash": of_sides[side].content_hash, **(facts or {}).get(side, {})}
        for side, label in zip(SIDES, labels, strict=True)
    }
    return {
        "format": 1,
        "method": campaign.testing.method,
        "seed": campaign.seed,
        "pairing": _pairing(campaign),
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


def _pairing(campaign: Campaign) -> str:
    if campaign.testing.method == "shells":
        return PAIRING
    shared = "episode i of A is paired with episode i of B: same initial state and same random streams"
    if campaign.testing.method == "forced":
        return f"{shared}; under forced also the same paths, cut-ins and weights"
    if campaign.testing.method == "nde":
        return f"{shared}; all weights are 1"
    return f"{shared}; after the vehicles' motions part, maneuvers and weights of a pair may differ"
