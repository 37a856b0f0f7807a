"""Read what a run has left: its campaign, motion of a few tests, and what pages show of all.

Every function raises a `RunFolderError` that names a file which is missing or damaged.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.errors import CampaignError, RunFolderError
from harness.families.protocol import Environment, Family
from harness.files import read_bytes
from harness.processes import made_ahead
from harness.records.folder import CAMPAIGN, Part, concatenated, no_episodes, read_kept, require_sum
from harness.records.schemas import LEAD, path_columns
from harness.resolved import resolve

N_READERS = 2
"""Threads; each holds a part."""


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
