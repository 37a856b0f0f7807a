"""A run and its folder: one record, made anew with each shard, of what is in files and what the next write adds.

Tests come in order, whichever worker ran them, and lie in one file per table, beyond `PART_TESTS` in another. The last
file is written again every few seconds, whole and under a new name: a kill loses no more. Only files that the manifest
lists count.
"""

from __future__ import annotations

import platform
import re
import time
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.campaign.files import dump_campaign
from harness.errors import RunFolderError, TooManyFailedError
from harness.estimators.block import Block
from harness.numbers import leaves
from harness.records import folder as records
from harness.records.reader import ShownTests, by_kind, read_campaign, signature
from harness.resolved import Resolved
from harness.runner.workers import ShardResult
from harness.sampling.paths import BaselineResult
from harness.sampling.protocol import ShardRequest, Source
from harness.vocabulary import FAMILIES

SMALLEST_FAILED_SAMPLE = 200
"""Tests before the share of failures can end a run; a tenth of that where most fail."""
SHARE = "run.max_failed_share"
_PACKAGES = ("harness", "libsumo", "numba", "llvmlite", "numpy", "scipy", "pyarrow")
_INTERVAL_S, _WRITING_SHARE = 5.0, 0.05
"""Time between two writes, and the share of the time that they may take."""
PART_TESTS, PART_ROWS = 50_000, 2_000_000
"""Tests, or rows of all tables together, at which a part is full: it is kept in memory until then."""


class Earlier:
    """The tests that an earlier run has left in a folder: ``parts`` of them, of which one is read at a time."""

    def __init__(self, folder: Path, manifest: Mapping[str, Any]) -> None:
        self._folder = folder
        self.parts: list[records.Part] = manifest["parts"]
        self.n_episodes: int = manifest["n_episodes"]
        self._read: tuple[records.Part, records.Tables | None] | None = None

    def tables(self, first: int, n: int) -> records.Tables | None:
        """Tables of consecutive tests; None where there are too few, or a file is gone; refused if one is damaged."""
        parts = [self._tables(part) for part in self.parts if part.first_episode < first + n and part.end > first]
        if first + n > self.n_episodes or not parts or None in parts:
            return None
        slices: dict[str, list[pa.Table]] = {}
        for part in parts:
            for name, table in (part or {}).items():
                low, high = np.searchsorted(table["episode"].to_numpy(), (first, first + n)).tolist()
                slices.setdefault(name, []).append(table.slice(low, high - low))
        return {name: pa.concat_tables(tables) for name, tables in slices.items()}

    def _tables(self, part: records.Part) -> records.Tables | None:
        if self._read is None or self._read[0] is not part:
            exist = all((self._folder / file.path).exists() for file in part.files.values())
            tables = {name: records.read_kept(self._folder, part, name) for name in part.files} if exist else None
            self._read = part, tables
        return self._read[1]


@dataclass(frozen=True)
class Run:
    """A campaign on its way into a folder, in which nobody but this process writes.

    ``parts`` are in files; ``open`` are the shards since the last full part, some of which may be in a file that will
    be replaced. ``blocks`` are of all tests, in order; ``facts`` are more keys of the manifest.
    """

    folder: Path
    resolved: Resolved
    source: Source
    earlier: Earlier
    began: float
    facts: Mapping[str, Any]
    parts: tuple[records.Part, ...] = ()
    open: tuple[ShardResult, ...] = ()
    blocks: tuple[Block, ...] = ()
    shown: tuple[ShownTests, ...] = ()
    """What the page shows of the shards, with the causes of failures."""
    repeated: records.Repeated | None = None
    before: Mapping[str, tuple[pa.Table, ...]] = field(default_factory=dict)
    """Tables of what comes before tests that count, by name; ``parts_before`` are those in files, earlier runs' too."""
    parts_before: Mapping[str, records.Part] = field(default_factory=dict)
    wrote: tuple[float, float] = (0.0, 0.0)
    """The clock's time when it was last written, and how long writing took (s)."""
    is_named: bool = False
    """Whether ``campaign.yaml`` is this campaign's, and no earlier run's with another stop rule."""

    @property
    def n_episodes(self) -> int:
        """How many tests there are."""
        return self.blocks[-1].first_episode + len(self.blocks[-1]) if self.blocks else 0

    @property
    def is_behind(self) -> bool:
        """Whether it has fewer tests than an earlier run, whose manifest stays valid until then."""
        return self.n_episodes < self.earlier.n_episodes

    def known(self, request: ShardRequest) -> ShardResult | None:
        """The shard as an earlier run left it, or None where it has to be run: fewer tests there, or other events."""
        tables = self.earlier.tables(request.first_episode, request.n_episodes)
        if tables is None or not self.source.is_shard(request, tables["episodes"]):
            return None
        return ShardResult(request, tables, self.source.block(tables), is_new=False)

    def noting(self, **facts: Any) -> Run:
        """The run with more keys of the manifest."""
        return replace(self, facts={**self.facts, **facts})

    def with_shard(self, shard: ShardResult) -> Run:
        """The run with the next tests; what it has is written every few seconds."""
        drawn = self.blocks[0].drawn if self.blocks else shard.block.drawn  # equal copies: one is kept in memory
        repeated, new = self.repeated, shard.repeated
        if new and (not repeated or not self.is_behind):  # the earlier run's sum has those of its own tests already
            repeated = repeated + new if repeated else new
        run = replace(
            self,
            open=(*self.open, shard),
            blocks=(*self.blocks, replace(shard.block, drawn=drawn)),
            shown=(*self.shown, ShownTests.of(shard.tables["episodes"], self.resolved.family)),
            repeated=repeated,
        )
        n_rows = sum(table.num_rows for shard in run.open for table in shard.tables.values())
        if run.n_episodes - run.open[0].request.first_episode >= PART_TESTS or n_rows >= PART_ROWS:
            n_open = len(run.open)  # joined, as each table takes memory beside its rows
            shown = (*run.shown[:-n_open], ShownTests.joined(run.shown[-n_open:], run.folder))
            return replace(run.written(), open=(), shown=shown)
        return run if run.is_behind else run.written_if_due()

    def with_baseline(self, name: str, result: BaselineResult) -> Run:
        """The run with the next baseline runs, or tests of milder events, written as often as tests are."""
        before = {**self.before, name: (*self.before.get(name, ()), result.table)}
        return replace(self, before=before).written_if_due()

    def written_if_due(self) -> Run:
        """Write it where the last write is some seconds ago."""
        when, took = self.wrote
        return self if time.monotonic() - when < max(_INTERVAL_S, took / _WRITING_SHARE) else self.written()

    def written(self, status: str = "running", **of_the_end: Any) -> Run:
        """Write all tests that there are, then the manifest that lists them; the run that knows its files."""
        began = time.monotonic()
        run = self._with_parts()
        if status == "done" or not run.is_behind:
            before = {name: asdict(part) for name, part in run.parts_before.items()}
            content = run.content(status, **of_the_end)
            content |= {"parts": [asdict(part) for part in run.parts], "before": before}
            if not run.is_named:
                # While the campaign's file is replaced, the manifest has no checksum of it: neither would be right.
                records.write_sealed(run.folder / records.MANIFEST, {**content, "campaign_crc32": None})
                records.write_bytes(run.folder / records.CAMPAIGN, dump_campaign(run.resolved.campaign).encode())
            records.write_sealed(run.folder / records.MANIFEST, content)
            records.remove_unlisted(run.folder, [*run.parts, *run.parts_before.values()])
            run = replace(run, is_named=True)
        return replace(run, wrote=(time.monotonic(), time.monotonic() - began))

    def _with_parts(self) -> Run:
        """Write the open shards as the last part, in the place of one with fewer of them, and what comes before."""
        parts_before = dict(self.parts_before)
        for name, tables in self.before.items():
            n = sum(table.num_rows for table in tables)
            if name not in parts_before or n > parts_before[name].n_episodes:
                parts_before[name] = records.write_part(self.folder, [{name: table} for table in tables], 0, n)
        if not self.open:
            return replace(self, parts_before=parts_before)
        first = self.open[0].request.first_episode
        last = [part for part in self.earlier.parts if (part.first_episode, part.end) == (first, self.n_episodes)]
        if any(shard.is_new for shard in self.open) or not last:
            shards = [shard.tables for shard in self.open]
            last = [records.write_part(self.folder, shards, first, self.n_episodes - first)]
        parts = (*(part for part in self.parts if part.first_episode < first), *last)
        return replace(self, parts=parts, parts_before=parts_before)

    def require_few_failed(self, *, at_least: int = 0) -> None:
        """Refuse tests of which too many failed, once there are ``at_least``; a tenth of that if most failed."""
        failures = sum((shown.causes for shown in self.shown), Counter[str]())
        if self.n_episodes >= (at_least / 10 if 2 * failures.total() > self.n_episodes else at_least):
            failed = (block.first_episode + int(block.failed.argmax()) for block in self.blocks if block.failed.any())
            again = f"`harness replay {self.folder} {next(failed, 0)}` runs one of them again"
            require_few_failed(failures, self.n_episodes, self.resolved.campaign, again)

    def require_no_fewer(self) -> None:
        """Refuse (`RunFolderError`) a stop rule that ends before the finished tests: some would be thrown away."""
        if self.is_behind:
            n, n_kept = self.earlier.n_episodes, self.n_episodes
            found = f"{n:,} finished tests, of which the campaign as it is asked for now would keep {n_kept:,}"
            expected = "a stop rule (stop.rhw, stop.episodes) that needs at least the tests that are there"
            mend = f"Ask for more, or repeat its --set options; `harness estimate {self.folder}` reads what is there."
            raise RunFolderError(str(self.folder), found, expected, mend)

    @property
    def took_s(self) -> float:
        """Wall time so far (s), with that of earlier runs into the folder."""
        return round(time.monotonic() - self.began, 3)

    def content(self, status: str, **of_the_end: Any) -> dict[str, Any]:
        """Content of the manifest."""
        repeated, campaign = self.repeated, self.resolved.campaign
        baseline = self.before.get(records.SHADOW, ())
        n_failed = sum(len(table) - table["failure"].null_count for table in baseline)
        failures = by_kind(sum((shown.causes for shown in self.shown), Counter[str]())).most_common(1)
        return {
            **self.facts,
            "status": status, "stopped_by": None, "unmet": [], "wall_time_s": self.took_s, **of_the_end,
            "reproducible": campaign.av.reproducible and not (repeated and repeated.differing),
            "repeated": None if repeated is None else asdict(repeated),
            "failure": failures[0][0] if failures else None,  # the most frequent
            "n_episodes": self.n_episodes, "parts": self.parts, "before": self.parts_before,
            **({"shadow_runs": {"n_runs": sum(map(len, baseline)), "n_failed": n_failed}} if baseline else {}),
        }  # fmt: skip


def take_over(
    folder: Path, resolved: Resolved, source: Source, earlier: Mapping[str, Any], began: float, **facts: Any
) -> Run:
    """A run that begins in a folder, or goes on from the manifest ``earlier`` that `require_own_folder` gave."""
    campaign, family, environment = resolved.campaign, resolved.family, resolved.environment
    yaml = dump_campaign(campaign).encode()
    facts = {
        "format": 1, "name": campaign.name, "campaign_hash": resolved.content_hash,
        "campaign_crc32": zlib.crc32(yaml), "signature": signature(yaml),
        "created": earlier.get("created") or datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": campaign.seed, "engine": campaign.world.engine, "versions": versions(), "cpu": cpu_name(),
        "controller_sha256": resolved.controller_sha256, "tried_script": resolved.script and resolved.script._asdict(),
        "events_show": family.shows(environment),
        "distance_per_test_m": None if campaign.av.acts_before_event else family.mean_distance_m(environment), **facts,
    }  # fmt: skip
    began -= float(earlier.get("wall_time_s") or 0.0)
    parts_before = {name: part for name, part in earlier["before"].items() if (folder / part.files[name].path).exists()}
    repeated = records.Repeated(**earlier["repeated"]) if earlier.get("repeated") else None
    left = Earlier(folder, earlier)
    return Run(folder, resolved, source, left, began, facts, repeated=repeated, parts_before=parts_before).written()


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version(), **{package: metadata.version(package) for package in _PACKAGES}}


def cpu_name() -> str:
    """Model name of the processor; bits are promised for one CPU family."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def require_few_failed(
    causes: Counter[str],
    n: int,
    campaign: Campaign,
    again: str,
    what: str = "tests",
    where: str = "the table `episodes`",
) -> None:
    """Refuse (`TooManyFailedError`) where more of ``n`` tests, or of ``what``, failed than the campaign allows.

    ``causes`` counts the failures by cause; ``again`` says how to see one fail, ``where`` all causes are listed.
    """
    if causes.total() > (allowed := campaign.run.max_failed_share) * n:
        cause = "".join(f", {n_such} of them with: {why}" for why, n_such in by_kind(causes).most_common(1))
        mend = f"Fix the AV ({again}): a corrected one needs a new --out; or raise the share and go on (run: --resume)."
        found, expected = f"{causes.total()} of {n} {what} failed{cause}", f"a share of at most {allowed:g}"
        if re.search(r"\b(nan|infinity|inf)\b", cause, re.IGNORECASE):
            mend = f"With nobody ahead gap_m is infinite and lead_speed_mps NaN (docs/controllers.md). {mend}"
        mend += f" All causes are in the column 'failure' of {where}."
        raise TooManyFailedError(SHARE, found, expected, mend)


def require_own_folder(folder: Path, resolved: Resolved, *, resume: bool) -> dict[str, Any]:
    """Refuse a folder that holds something else; return the manifest of a run to be continued, or one without tests.

    Raises `RunFolderError`: the folder holds another campaign, this one without ``--resume`` or with another controller
    (one file may not mix two versions of it), or files that are no run.
    """

    def refusal(found: str, expected: str, mend: str) -> RunFolderError:
        return RunFolderError(str(folder), found, expected, mend)

    empty: dict[str, Any] = {"n_episodes": 0, "parts": [], "before": {}}
    if not any(folder.iterdir()):
        return empty
    elsewhere = "Choose another folder with --out."
    if not (folder / records.MANIFEST).exists():
        expected = "a new or empty folder, or one that a run has left"
        several = (folder / FAMILIES).exists()
        raise refusal("a run of several scenarios" if several else "a folder with other files", expected, elsewhere)
    manifest = records.read_manifest(folder, mend=elsewhere)
    if manifest["campaign_hash"] != resolved.content_hash:
        again = f"harness run {folder / records.CAMPAIGN} --out {folder} --resume"
        mend = f"Choose another folder with --out, or go on by `{again}`."
        other = read_campaign(folder, manifest)
        there, here = (dict(leaves(each.model_dump(exclude={"name", "stop"}))) for each in (other, resolved.campaign))
        differing = [f"{key} {there.get(key)}" for key in there | here if there.get(key) != here.get(key)][:3]
        found = f"another campaign, {other.name}{': ' * bool(differing)}{', '.join(differing)}"
        raise refusal(found, "a folder for this one, which has other settings or files", mend)
    if not (manifest["n_episodes"] or manifest["before"]):  # it was interrupted before anything was finished
        return empty
    if manifest.get("controller_sha256") != resolved.controller_sha256:
        found = "tests of this campaign; since then its controller, or a file that it is made of, has been changed"
        mend = "Give a corrected vehicle a new --out. To compare with the old version, bring that back as another file."
        raise refusal(found, "the same controller for all tests of a run", mend)
    if not resume:
        mend = "Continue it with --resume, or choose another folder with --out."
        raise refusal("this campaign, already begun", "a new or empty folder", mend)
    return manifest


def require_same_pool(folder: Path, source: Source) -> None:
    """Refuse (`RunFolderError`) to go on with a run whose events came from another pool, as of another library."""
    path, design = folder / records.SHELLS, source.design
    if design is None or not path.exists():
        return
    pool = records.read_as(dict[str, object], path, mend="Run the campaign into a new folder.").get("pool")
    if pool != design.pool:
        expected = f"those of pool {design.pool}, which this campaign now has"
        mend = "Restore the surrogate library, or the version of the harness (manifest.json), or use a new folder."
        raise RunFolderError(str(path), f"events of pool {pool}", expected, mend)
