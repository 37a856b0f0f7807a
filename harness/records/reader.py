"""Read the tests that count, in index order: part by part, or all as pandas frames with units and weights.

Every function raises a `RunFolderError` that names a file which is missing or damaged.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.arguments import checked
from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.errors import CampaignError, RunFolderError
from harness.families.protocol import Environment, Family
from harness.files import read_bytes
from harness.processes import made_ahead
from harness.records.folder import (
    CAMPAIGN,
    ESTIMATES,
    SHELLS,
    Part,
    concatenated,
    no_episodes,
    read_as,
    read_kept,
    read_manifest,
    require_sum,
)
from harness.records.schemas import LEAD, path_columns, traces_schema
from harness.resolved import resolve
from harness.shown import ShownInPython, lines_of_run, plot_of_run
from harness.vocabulary import IntArray

if TYPE_CHECKING:
    import pandas as pd

    from harness.report.drawing import Plot

TableName = Literal["episodes", "moments", "traces"]

_MOST_SHELLS = 128
"""More than an int8 counts."""
N_READERS = 2
"""Threads; each holds a part."""
_WEIGHT = pa.field(
    "weight", pa.float64(), metadata={"unit": "1", "doc": "the mean of weight times crash is the crash rate"}
)


def read_campaign(folder: Path, manifest: Mapping[str, Any], *, check_files: bool = False) -> Campaign:
    """The campaign that a run's records are of; ``check_files`` as for `load_campaign`.

    Raises `RunFolderError`: ``campaign.yaml`` is missing or damaged, or is another campaign than the manifest's.
    """
    path = folder / CAMPAIGN
    mend = f"Restore {CAMPAIGN} as the run has written it, and files that it names, or run the campaign again."
    try:
        campaign = load_campaign(path, check_files=check_files)
    except CampaignError as error:
        found = error.found if error.where == str(path) else f"{error.found} ({error.where})"
        expected = "a campaign with all its sections, as the run has written it"
        raise RunFolderError(str(path), found, expected, mend) from error
    crc32 = manifest.get("campaign_crc32")
    require_sum(path, crc32, read_bytes(path), mend)
    if crc32 is None:  # its run was killed as it began
        with suppress(CampaignError):  # its environment file is gone: nobody can tell
            require_campaign(path, resolve(campaign).content_hash, manifest)
    return campaign


def require_campaign(path: Path, content_hash: str, manifest: Mapping[str, Any]) -> None:
    """Refuse (`RunFolderError`) a campaign that has not made the records."""
    if content_hash != manifest["campaign_hash"]:
        expected = f"campaign {manifest['campaign_hash']}, which made the records (manifest.json)"
        mend = "Restore campaign.yaml and what it names: environment.parameters, testing.challenge, surrogates, an FMU."
        raise RunFolderError(str(path), f"campaign {content_hash}", expected, mend)


def traffic_of(campaign: Campaign, manifest: Mapping[str, Any]) -> Environment | None:
    """The run's traffic, where its parameters are still what they were; else others cannot be driven."""
    with suppress(CampaignError):
        resolved = resolve(campaign)
        return resolved.environment if resolved.content_hash == manifest["campaign_hash"] else None
    return None


def read_traces(folder: Path, parts: Sequence[Part], episodes: Collection[int]) -> pa.Table | None:
    """Trace rows of a few episodes; None where none of them was traced."""
    found = []
    for part in parts:
        if "traces" in part.files and any(part.first_episode <= episode < part.end for episode in episodes):
            table = read_kept(folder, part, "traces")
            found.append(table.filter(pc.is_in(table["episode"], pa.array(sorted(episodes)))))
    return concatenated(found, folder) if any(table.num_rows for table in found) else None


@dataclass(frozen=True, repr=False)
class StoredRun(ShownInPython):
    """A run folder, whose tables are read when asked for; shown, it is the short answer.

    ``frame.attrs["unit"]`` and ``frame.attrs["doc"]`` give unit and meaning of each column by its name; the unit
    of a number without one is ``"1"``, that of a text ``""``.
    """

    folder: Path

    @property
    def estimates(self) -> dict[str, Any]:
        """Content of ``estimates.json``: estimates, and the ``severity`` of crashes."""
        again = f"Make it again with `harness estimate {self.folder} --write`."
        return read_as(dict[str, Any], self.folder / ESTIMATES, mend=again)

    def _lines(self) -> list[str]:
        manifest = read_manifest(self.folder)
        if not (self.folder / ESTIMATES).is_file():
            return [f"{self.folder}: {manifest['n_episodes']:,} tests, without an answer as yet"]
        return lines_of_run(read_campaign(self.folder, manifest), manifest, self.estimates, self.folder)

    def _plot(self) -> Plot | None:
        return plot_of_run(self.folder) if (self.folder / ESTIMATES).is_file() else None

    @checked("episodes")
    def episodes(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """One row per test, failed ones included, with its ``weight`` and all ``columns``, or those that are named.

        The mean of ``weight`` over all rows, those alone counted that crashed, is the crash rate per test, whatever the
        method. With ``shells`` a row weighs p_s n / n_s: its shell has probability p_s and n_s of the n tests.
        """
        return _described(self.table("episodes", columns))

    @checked("moments")
    def moments(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """One row per control step; a `RunFolderError` where the campaign kept none (``records.moments``)."""
        return _described(self.table("moments", columns))

    @checked("traces")
    def traces(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """One row per step and vehicle; a `RunFolderError` where nothing was traced (``records.traces``)."""
        return _described(self.table("traces", columns))

    @checked("table")
    def table(self, name: TableName, columns: Sequence[str] | None = None) -> pa.Table:
        """What the method of that ``name`` gives, as an Arrow table: several times faster, and smaller, for long runs.

        Unit and meaning of a column are in its field's metadata.
        """
        return concatenated(list(self.batches(name, columns)), self.folder)

    @checked("batches")
    def batches(self, name: TableName, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """`table` in consecutive pieces, one per part: for what does not fit into memory."""
        manifest = read_manifest(self.folder)
        parts = [part for part in manifest["parts"] if name in part.files]
        if not parts and name == "traces" and read_campaign(self.folder, manifest).records.traces != "none":
            yield traces_schema(shows=bool(manifest["events_show"])).empty_table()
            return
        if not parts and name == "episodes":
            raise no_episodes(self.folder)
        if not parts:
            mend = f"Run it into another folder with --set records.{name}=all."
            raise RunFolderError(str(self.folder), f"no {name}", f"a run whose campaign kept {name}", mend)
        read = partial(read_kept, self.folder, table=name)
        made, of = ((_WEIGHT.name,), ("log_weight", "component")) if name == "episodes" else ((), ())
        kept = read(parts[0]).column_names
        shown = list(dict.fromkeys([*(kept if columns is None else columns), *made]))
        needed = [column for column in dict.fromkeys([*shown, *of]) if column not in made]
        if unknown := sorted({*needed} - {*kept}):
            found = f"no column {unknown[0]!r} in {name}"
            raise RunFolderError(str(self.folder), found, f"one of {', '.join(sorted(kept))}", "Correct its name.")
        per_shell = None
        if made and (self.folder / SHELLS).is_file():
            components = (read(part, columns=["component"])["component"] for part in parts)
            per_shell = np.sum([np.bincount(shells, minlength=_MOST_SHELLS) for shells in components], axis=0)
        for piece in made_ahead(partial(read, columns=needed), parts, N_READERS):
            yield (piece.append_column(_WEIGHT, _weights(piece, per_shell)) if made else piece).select(shown)


def _weights(episodes: pa.Table, per_shell: IntArray | None) -> pa.Array:
    """Weights of tests, of which there are so many ``per_shell``; None where they are not drawn from shells."""
    # The weight of a failed test, which counts as no crash, may be unknown.
    log_weight = episodes["log_weight"].to_numpy()
    weight = np.exp(np.where(np.isnan(log_weight), 0.0, log_weight))
    if per_shell is not None:
        weight *= per_shell.sum() / per_shell[episodes["component"].to_numpy()]
    return pa.array(weight)


def _described(table: pa.Table) -> pd.DataFrame:
    """A table as a frame, with what Arrow's field metadata says of its columns."""
    frame: pd.DataFrame = table.to_pandas()
    for key in ("unit", "doc"):
        frame.attrs[key] = {field.name: field.metadata[key.encode()].decode() for field in table.schema}
    return frame


@checked("harness.read")
def read(folder: str | Path) -> StoredRun:
    """Tables of a stored run, as pandas frames or Arrow tables, with units and weights.

    Parameters
    ----------
    folder : str or Path
        Run folder.

    Raises `RunFolderError`: the folder is no run.

    Examples
    --------
    Of the run that `harness.run` shows:

    >>> import harness
    >>> tests = harness.read("runs/idm").episodes(["outcome", "impact_speed_mps"])
    >>> tests.attrs["unit"]["impact_speed_mps"]
    'm/s'
    >>> crashed = tests["outcome"] == "crash"
    >>> f"{int(crashed.sum())} crashes, {(tests['weight'] * crashed).mean():.2e} per test"
    '95 crashes, 1.95e-07 per test'
    """
    read_manifest(Path(folder))
    return StoredRun(Path(folder))


# -- what pages show of tests: kept while a run makes them, or read from its folder --

COLUMNS = (
    "episode", "component", "log_weight", "impact_speed_mps", "crash_time_s", "event_step",
    "event_gap_m", "event_rate_mps",
)  # fmt: skip
_NUMBER = re.compile(r"(?<!\.py:)(?<!\d)-?\d[\d.]*(e[-+]?\d+)?")
"""But for the line of the user's code: other lines are other faults."""


@dataclass(frozen=True)
class ShownTests:
    """Consecutive tests of a run.

    ``outcomes``, and ``causes`` of failures, are counted over all. ``rows`` are of tests that had an event or a weight
    other than 1: `COLUMNS`, outcome, facts that are numbers and, of events that can be seen beforehand, their lead and
    the contact. Of the others, most in plain naturalistic driving, there is nothing to draw. ``crashes`` are what the
    motion of crashes follows from.
    """

    outcomes: Counter[str]
    causes: Counter[str]
    rows: pa.Table
    crashes: pa.Table

    @classmethod
    def of(cls, episodes: pa.Table, family: Family) -> ShownTests:
        """What is shown of rows of the episodes table."""
        rows, motion = _columns(family, sees=LEAD in episodes.column_names)
        outcome = episodes["outcome"].cast(pa.string())
        shown = pc.or_(pc.is_valid(episodes["event_step"]), pc.not_equal(episodes["log_weight"], 0.0))
        return cls(
            _counted(outcome),
            _counted(episodes["failure"].drop_null()),
            episodes.select(rows).filter(shown),
            episodes.select(motion).filter(pc.equal(outcome, "crash")),
        )

    @classmethod
    def stored(cls, folder: Path, manifest: Mapping[str, Any], family: Family) -> ShownTests:
        """Those of a run folder; a `RunFolderError` where a file is damaged or missing, or no test is there."""
        asked = {"failure", *(name for of in _columns(family, sees=manifest["events_show"]) for name in of)}

        def shown(part: Part) -> ShownTests:
            episodes = read_kept(folder, part, "episodes", sorted(asked))
            return cls.of(episodes.slice(0, max(manifest["n_episodes"] - part.first_episode, 0)), family)

        return cls.joined(list(made_ahead(shown, manifest["parts"], N_READERS)), folder)

    @classmethod
    def joined(cls, parts: Sequence[ShownTests], folder: Path) -> ShownTests:
        """All tests of the run in a folder."""
        if not parts:
            raise no_episodes(folder)
        return cls(
            sum((part.outcomes for part in parts), Counter[str]()),
            sum((part.causes for part in parts), Counter[str]()),
            concatenated([part.rows for part in parts], folder),
            concatenated([part.crashes for part in parts], folder),
        )


def _columns(family: Family, *, sees: bool) -> tuple[list[str], list[str]]:
    """Columns of `ShownTests.rows` and of its crashes."""
    numbers = [each.name for each in family.columns if not each.length]
    in_time = [LEAD, "contact"] if sees else []
    return [*COLUMNS, *numbers, *in_time, "outcome"], [*path_columns(family), *in_time[:1], "outcome"]


def by_kind(causes: Mapping[str, int]) -> Counter[str]:
    """How often each kind of failure was: of causes that differ in digits alone the most frequent stands for all."""
    shown, kinds = dict[str, str](), Counter[str]()
    for cause, n in sorted(causes.items(), key=lambda item: -item[1]):
        kinds[shown.setdefault(_NUMBER.sub("0", cause), cause)] += n
    return kinds


def _counted(names: pa.ChunkedArray) -> Counter[str]:
    values, counts = names.value_counts().flatten()
    return Counter(dict(zip(values.to_pylist(), counts.to_pylist(), strict=True)))
