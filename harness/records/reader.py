"""Read a run's campaign, traces of a few tests, and what pages show of all tests; read replicates of traffic.

Every function raises a `RunFolderError` that names a file which is missing or damaged.
"""

from __future__ import annotations

import hmac
import os
import re
import secrets
import uuid
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import platformdirs
import pyarrow as pa
import pyarrow.compute as pc

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.campaign.models import shipped_or_own
from harness.campaign.vehicle import AutomatedVehicle
from harness.errors import CampaignError, RunFolderError
from harness.families.numbers import ParameterFile
from harness.families.protocol import Environment, Family
from harness.files import content_hash
from harness.processes import made_ahead
from harness.records import folder as records
from harness.records.schemas import LEAD, path_columns
from harness.resolved import resolve
from harness.vocabulary import FAMILIES

N_READERS = 2
"""Threads that read; each holds one part in memory."""
OF_REPLICATES = b"harness fit"
"""Key in the metadata of a file of replicates: hash of the numbers that they belong to."""


def read_campaign(folder: Path, manifest: Mapping[str, Any], *, check_files: bool = False) -> Campaign:
    """The campaign that a run's records are of; ``check_files`` as for `load_campaign`.

    Raises `RunFolderError`: ``campaign.yaml`` is missing or damaged, or is another campaign than the manifest's.
    """
    path = folder / records.CAMPAIGN
    mend = f"Restore {records.CAMPAIGN} as the run has written it, and files that it names, or run the campaign again."
    try:
        campaign = load_campaign(path, check_files=check_files)
    except CampaignError as error:
        found = error.found if error.where == str(path) else f"{error.found} ({error.where})"
        expected = "a campaign with all its sections, as the run has written it"
        raise RunFolderError(str(path), found, expected, mend) from error
    crc32 = manifest.get("campaign_crc32")
    records.require_sum(path, crc32, path.read_bytes(), mend)
    if crc32 is None:  # its run was killed as it began
        with suppress(CampaignError):  # its environment file is gone: it cannot be checked
            require_campaign(path, resolve(campaign).content_hash, manifest)
    return campaign


def require_campaign(path: Path, content_hash: str, manifest: Mapping[str, Any]) -> None:
    """Refuse (`RunFolderError`) a campaign that has not made the records."""
    if content_hash != manifest["campaign_hash"]:
        expected = f"campaign {manifest['campaign_hash']}, which made the records (manifest.json)"
        mend = "Restore campaign.yaml and what it names: environment.parameters, testing.challenge, surrogates, an FMU."
        raise RunFolderError(str(path), f"campaign {content_hash}", expected, mend)


def traffic_of(campaign: Campaign, manifest: Mapping[str, Any]) -> Environment | None:
    """The run's traffic; None where its parameters have changed since."""
    with suppress(CampaignError):
        resolved = resolve(campaign)
        return resolved.environment if resolved.content_hash == manifest["campaign_hash"] else None
    return None


def read_traces(folder: Path, parts: Sequence[records.Part], episodes: Collection[int]) -> pa.Table | None:
    """Trace rows of a few episodes; None where none of them was traced."""
    traces = []
    for part in parts:
        if "traces" in part.files and any(part.first_episode <= episode < part.end for episode in episodes):
            table = records.read_kept(folder, part, "traces")
            traces.append(table.filter(pc.is_in(table["episode"], pa.array(sorted(episodes)))))
    return records.concatenated(traces, folder) if any(table.num_rows for table in traces) else None


def read_replicates(name: str, parameters: ParameterFile, shipped: Path) -> list[dict[str, float]]:
    """Numbers that vary, by replicate, of an environment (a ``shipped`` name or a path); refused if of another's."""
    file, replicates = shipped_or_own(name, shipped, "environment.parameters"), parameters.replicates
    if replicates is None:
        return []
    path, mend = file.parent / replicates.file, "Write it anew with `harness fit`, or leave out the key replicates."
    table = records.read_table(path, mend=mend)
    numbers_hash = (table.schema.metadata or {}).get(OF_REPLICATES)
    expected = f"the replicates that {file.name} was written with"
    if content_hash(path.read_bytes()) != replicates.sha256:
        raise RunFolderError(str(path), "replicates of another fit, or changed ones", expected, mend)
    if numbers_hash != parameters.content_hash().encode():
        raise RunFolderError(str(path), f"replicates of other numbers than those of {file.name}", expected, mend)
    rows: list[dict[str, float]] = table.to_pylist()
    return rows


# -- whether a folder was made on this machine by this user: if not, a replay would run code that somebody else named. A
# key of the user's own signs each run's campaign.yaml; a folder that is moved keeps its signature --


def signature(campaign: bytes) -> str | None:
    """Signature of a campaign for the manifest, which `require_trust` checks; None for a user without a home."""
    key = _key()
    return None if key is None else hmac.new(key, campaign, "sha256").hexdigest()


def code_of(av: AutomatedVehicle) -> str | None:
    """The user's own code that a vehicle runs in processes of the harness; None for a vehicle without any."""
    return av.controller or (None if av.fmu is None else av.fmu.file)


def require_trust(folder: Path, manifest: Mapping[str, Any], code: str | None, mend: str) -> None:
    """Refuse (`RunFolderError`) to run ``code`` named by a folder that this user has not made on this machine."""
    signed = signature((folder / records.CAMPAIGN).read_bytes())
    if code is not None and (signed is None or not hmac.compare_digest(signed, str(manifest.get("signature")))):
        found = f"a run that was not made on this machine by this user; it names {code}, which would be run"
        raise RunFolderError(str(folder), found, "a run of your own, or your word for that code", mend)


def _key() -> bytes | None:
    """The user's key, made when it is first asked for; None where there is no place for one."""
    with suppress(OSError, RuntimeError):  # the user's home is unknown, or cannot be written
        path = platformdirs.user_config_path("harness") / "key"
        if not path.is_absolute():  # older versions of platformdirs give this for an unknown home
            return None
        unfinished = path.with_name(f".{uuid.uuid4().hex}.part")
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            unfinished.touch(0o600)
            unfinished.write_bytes(secrets.token_bytes(32))
            with suppress(FileExistsError):  # another process was faster
                path.hardlink_to(unfinished)
            unfinished.unlink()
        return path.read_bytes() if path.stat().st_uid == os.geteuid() else None
    return None


# -- what pages show of tests: kept while a run makes them, or read from its folder --

COLUMNS = (
    "episode", "component", "log_weight", "impact_speed_mps", "crash_time_s", "event_step",
    "event_gap_m", "event_rate_mps",
)  # fmt: skip
_NUMBER = re.compile(r"(?<!\.py:)(?<!\d)-?\d[\d.]*(e[-+]?\d+)?")
"""A number in a failure's cause, but not the line of the user's code: other lines are other faults."""


@dataclass(frozen=True)
class ShownTests:
    """Consecutive tests of a run.

    ``outcomes``, and ``causes`` of failures, are counted over all. ``rows`` are of tests that had an event or a weight
    other than 1, with `COLUMNS`, outcome, and facts that are numbers; there is nothing to draw of the others, which are
    most in plain naturalistic driving. ``crashes`` has the columns that the motion of crashes follows from.
    """

    outcomes: Counter[str]
    causes: Counter[str]
    rows: pa.Table
    crashes: pa.Table

    @classmethod
    def of(cls, episodes: pa.Table, family: Family) -> ShownTests:
        """From rows of the episodes table."""
        rows, motion = _columns(family, shows=LEAD in episodes.column_names)
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
        """From a run folder; a `RunFolderError` where a file is damaged or missing, or no test is there."""
        rows, motion = _columns(family, shows=manifest["events_show"])
        columns = sorted({"failure", *rows, *motion})

        def shown(part: records.Part) -> ShownTests:
            episodes = records.read_kept(folder, part, "episodes", columns)
            return cls.of(episodes.slice(0, max(manifest["n_episodes"] - part.first_episode, 0)), family)

        return cls.joined(list(made_ahead(shown, manifest["parts"], N_READERS)), folder)

    @classmethod
    def joined(cls, parts: Sequence[ShownTests], folder: Path) -> ShownTests:
        """Consecutive parts of a run as one; a `RunFolderError` without any."""
        if not parts:
            raise records.no_episodes(folder)
        return cls(
            sum((part.outcomes for part in parts), Counter[str]()),
            sum((part.causes for part in parts), Counter[str]()),
            records.concatenated([part.rows for part in parts], folder),
            records.concatenated([part.crashes for part in parts], folder),
        )


def _columns(family: Family, *, shows: bool) -> tuple[list[str], list[str]]:
    """Columns of ``rows`` and of ``crashes`` of `ShownTests`."""
    numbers = [column.name for column in family.columns if not column.length]
    return [*COLUMNS, *numbers, "outcome"], [*path_columns(family), *([LEAD] if shows else []), "outcome"]


def hardest_crash(folder: Path) -> tuple[Path, int]:
    """Run folder and number of the test with the largest impact speed, the first of equals; of a sum, of all its runs.

    Raises `RunFolderError`: there is no crash.
    """
    several, crashes = (folder / FAMILIES).is_file(), list[tuple[float, int, Path]]()
    runs = [manifest.parent for manifest in sorted(folder.glob("*/manifest.json")) if several] or [folder]
    for run in runs:
        if not (parts := records.read_manifest(run)["parts"]):
            raise records.no_episodes(run)
        for part in parts:
            # Tests without a crash have no impact speed.
            tests = records.read_kept(run, part, "episodes", ["impact_speed_mps", "episode"]).drop_null().to_pylist()
            crashes += [(-test["impact_speed_mps"], test["episode"], run) for test in tests]
    if not crashes:
        expected, mend = "the number of a test to replay", f"Name one: harness replay {run} 0."
        raise RunFolderError(str(folder), "no crash", expected, mend)
    _, episode, run = min(crashes)
    return run, episode


def by_kind(causes: Mapping[str, int]) -> Counter[str]:
    """Failures by kind, named by its most frequent cause: causes that differ in digits alone are of one kind."""
    names, kinds = dict[str, str](), Counter[str]()
    for cause, n in sorted(causes.items(), key=lambda item: -item[1]):
        kinds[names.setdefault(_NUMBER.sub("0", cause), cause)] += n
    return kinds


def _counted(names: pa.ChunkedArray) -> Counter[str]:
    values, counts = names.value_counts().flatten()
    return Counter(dict(zip(values.to_pylist(), counts.to_pylist(), strict=True)))
