"""Run folders for tests: which are there to be shared, how to look at them, and how to damage a copy.

The fixture ``stored_run`` (tests/conftest.py) gives a golden campaign's folder by its name, or one of `MORE`.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.estimators.answer import STORED_ESTIMATES
from harness.records.folder import SEAL, read_kept, read_manifest, write_part, write_sealed
from harness.records.reader import read_campaign
from harness.report.words import short_answer
from tests.golden.campaigns import BASE, RUNS
from tests.golden.record import TABLES, tables_of

ROOT = Path(__file__).parents[1]
SCENARIOS = ROOT / "scenarios"
MIXTURE_FILE = SCENARIOS / "overtaking_mixture.yaml"
MORE = {
    "mixture-seven": (*RUNS["mixture-sumo"], "stop.episodes=560"),
    "step-seldom": (*RUNS["step-recursive-twin"], "testing.criticality_threshold=0.5"),
}
"""Further runs: of seven shards, and one in which most tests are not controlled."""


def golden(name: str, *more: str) -> Campaign:
    """A campaign of `RUNS` or `MORE`, with further overrides."""
    return load_campaign(BASE, [*{**RUNS, **MORE}[name], *more])


def sets(*overrides: str) -> list[str]:
    """Overrides on a command line."""
    return [word for override in overrides for word in ("--set", override)]


def manifest(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "manifest.json").read_text())


def edit(folder: Path, file: str = "manifest.json", **changes: Any) -> None:
    """Change keys of a JSON file of a run, and its checksum with them."""
    write_sealed(folder / file, {**json.loads((folder / file).read_text()), **changes})


def unnoted(folder: Path) -> Path:
    """Let the manifest tell of no other file's checksum, as while a run is at it: a test may change them."""
    parts = manifest(folder)["parts"]
    for file in (file for part in parts for file in part["files"].values()):
        file["crc32"] = None
    edit(folder, parts=parts, campaign_crc32=None)
    return folder


def estimates(folder: Path) -> dict[str, Any]:
    """Content of estimates.json, without its checksum."""
    content = json.loads((folder / "estimates.json").read_text())
    del content[SEAL]
    return content


def answer(content: dict[str, Any], campaign: Campaign, of: dict[str, Any] | None = None) -> dict[str, Any]:
    """The answer of estimates.json in words, with those of a manifest."""
    return json.loads(json.dumps(asdict(short_answer(campaign, of or {}, STORED_ESTIMATES.validate_python(content)))))


def answer_in(folder: Path) -> dict[str, Any]:
    """That of a run."""
    return answer(estimates(folder), read_campaign(folder, manifest(folder)), manifest(folder))


def with_fewer_before(folder: Path, name: str, n: int) -> None:
    """Let a run have been ended after so many baseline runs and before any test."""
    for table in ("episodes", "traces"):
        shutil.rmtree(folder / table)
    before = read_manifest(folder)["before"]
    part = write_part(folder, [{name: read_kept(folder, before[name], name).slice(0, n)}], 0, n)
    kept = {key: asdict(each) for key, each in {**before, name: part}.items()}
    edit(folder, n_episodes=0, parts=[], before=kept, status="interrupted")


def part_files(folder: Path, table: str = "episodes") -> list[Path]:
    return sorted((folder / table).glob("*.parquet"))


def stored_table(folder: Path, table: str) -> pa.Table:
    """All rows of a table, sorted; the vehicles of a step keep their order."""
    rows = pa.concat_tables([pq.read_table(file, partitioning=None) for file in part_files(folder, table)])
    return rows.take(pc.sort_indices(rows.select(TABLES[table]), [(key, "ascending") for key in TABLES[table]]))


def unlike_columns(a: Path, b: Path) -> list[str]:
    """Columns in which two runs differ in any bit, as ``table.column``; estimates.json counts as one."""
    (of_a, of_b), unlike = (tables_of(a), tables_of(b)), []
    assert {name: list(table) for name, table in of_a.items()} == {name: list(table) for name, table in of_b.items()}
    for name, table in of_a.items():
        unlike += [f"{name}.{column}" for column in table if table[column] != of_b[name][column]]
    if (a / "estimates.json").read_bytes() != (b / "estimates.json").read_bytes():
        unlike.append("estimates.json")
    return unlike


def copy_of(folder: Path, to: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(folder, to))


def truncate(path: Path) -> None:
    """Cut a file in half, as a crashed machine may leave it."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
