"""What pages show of tests: kept while a run makes them, or read from its folder."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from harness.families.protocol import Family
from harness.processes import made_ahead
from harness.records.folder import Part, concatenated, no_episodes, read_kept
from harness.records.reader import N_READERS
from harness.records.schemas import LEAD, path_columns

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
