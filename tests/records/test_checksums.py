"""A bit that flips in a run folder, or a file of another run, changes no number without a word."""

from __future__ import annotations

import random
import shutil
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pytest

from harness.errors import HarnessError, RunFolderError
from harness.records.reader import read, table_sizes
from harness.report.summary import read_run_folder, summarise
from harness.runner.stored import estimate_run
from tests.golden.record import column_hash
from tests.in_process import run_here
from tests.stored_runs import copy_of, edit, golden, of_before, shard_files, unlike_columns

NAME, FLIPS = "mixture-twin", 200
TABLES = ("episodes", "moments", "traces")


@pytest.fixture
def stored(stored_run, tmp_path):
    return copy_of(stored_run(NAME), tmp_path / "run")


def hashes(table: pa.Table) -> dict[str, str]:
    return {name: column_hash(table[name]) for name in table.column_names}


def told(folder: Path) -> str:
    """All numbers that come out of a folder: its tables, estimates, and what stands on its page."""
    page, run = read_run_folder(folder), read(folder)
    summary = {name: repr(value) for name, value in vars(summarise(page)).items()}
    tables = [hashes(run.table(name)) for name in TABLES]
    return repr((tables, estimate_run(folder), page.estimates, page.campaign, table_sizes(folder), summary))


def flips_unnoticed(folder: Path, n: int, seed: int) -> Iterator[str]:
    """Flip ``n`` bits one after the other, in files of equal chance; those that changed a number without an error."""
    files = [
        path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix in (".parquet", ".json", ".yaml")
    ]
    before, chance = told(folder), random.Random(seed)
    for _ in range(n):
        path = chance.choice(files)
        content = path.read_bytes()
        bit = chance.randrange(8 * len(content))
        path.write_bytes(content[: bit // 8] + bytes([content[bit // 8] ^ 1 << bit % 8]) + content[bit // 8 + 1 :])
        try:
            if told(folder) != before:
                yield f"bit {bit} of {path}"
        except HarnessError:
            pass
        path.write_bytes(content)


def test_a_flipped_bit_changes_no_number_silently(stored):
    assert list(flips_unnoticed(stored, FLIPS, seed=1)) == []


def test_without_checksums_it_would(stored):
    """The same flips in a folder of before: this is what they are for."""
    assert told(of_before(stored))
    assert next(flips_unnoticed(stored, FLIPS, seed=2))


@pytest.mark.parametrize("table", TABLES)
def test_going_on_with_a_damaged_shard_names_it_and_its_mend_works(table, stored, stored_run):
    damaged = shard_files(stored, table)[1]
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(RunFolderError, match=f"{table}/{damaged.name}.*checksum.*Delete all files of this shard"):
        run_here(golden(NAME), stored, resume=True)
    for path in stored.glob(f"*/{damaged.name}"):
        path.unlink()
    with pytest.raises(RunFolderError, match=damaged.name):  # it stays in the manifest: nobody passes over it
        estimate_run(stored)
    run_here(golden(NAME), stored, resume=True)
    assert unlike_columns(stored_run(NAME), stored) == []
    assert told(stored) == told(stored_run(NAME))


@pytest.mark.parametrize("crc32", [True, False])
def test_the_campaign_of_another_run_is_refused(crc32, stored, stored_run):
    """With its checksum, and, in folders of before, by what changes an episode's bits."""
    shutil.copy(stored_run("mixture-seven") / "campaign.yaml", stored)
    if not crc32:
        text = (stored / "campaign.yaml").read_text()
        (stored / "campaign.yaml").write_text(text.replace("seed: ", "seed: 1"))
        edit(stored, campaign_crc32=None)
    for reading in (estimate_run, read_run_folder):
        with pytest.raises(RunFolderError, match=r"campaign\.yaml"):
            reading(stored)


def test_a_run_killed_while_it_replaces_its_campaign_can_be_read(stored):
    """Its manifest tells of no checksum in between."""
    edit(stored, campaign_crc32=None)
    assert estimate_run(stored)
