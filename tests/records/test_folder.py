"""Files are there completely or not at all, and what cannot be read is named."""

from __future__ import annotations

import errno
import fcntl
import io
import os
import pickle
import random
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from harness.errors import HarnessError, RunFolderError
from harness.files import write_atomically
from harness.records.folder import arrow_file, parquet, read_as, read_table, write_json, write_together
from harness.report.summary import read_run_folder, summarise
from harness.runner.stored import estimate_run, replay_episode
from harness.runner.tables import read
from tests.golden.record import column_hash
from tests.in_process import controllers_here, run_here
from tests.stored_runs import copy_of, edit, golden, manifest, part_files, stored_table, unlike_columns


@pytest.fixture
def tables(stored_run) -> dict:
    """A shard with all three."""
    return {name: stored_table(stored_run("mixture-twin"), name) for name in TABLES}


def files_below(path: Path) -> set[str]:
    return {str(file.relative_to(path)) for file in path.rglob("*") if file.is_file()}


def half_then_fail(path: Path) -> None:
    path.write_text("half of it")
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def test_a_write_that_fails_leaves_nothing_but_the_old_file(tmp_path):
    path = tmp_path / "new" / "file"
    for old in (set(), {"new/file"}):
        with pytest.raises(OSError, match="No space left"):
            write_atomically(path, half_then_fail)
        assert files_below(tmp_path) == old
        write_atomically(path, lambda temporary: temporary.write_text("old"))
    assert path.read_text() == "old"


def test_where_rows_come_from_changes_no_byte_of_a_file():
    lists = {"fixed": pa.list_(pa.float64(), 2), "any": pa.list_(pa.int8())}
    table = pa.table({name: pa.array([[1, 2], [3, 4]], kind) for name, kind in lists.items()})
    written = parquet(table)
    read_again = pq.read_table(io.BytesIO(written))
    assert parquet(read_again) == parquet(pickle.loads(pickle.dumps(read_again))) == written
    plain = io.BytesIO(), io.BytesIO()
    for file, each in zip(plain, (table, read_again), strict=True):
        pq.write_table(each, file)
    assert plain[0].getvalue() != plain[1].getvalue()  # Arrow's own way


@pytest.mark.parametrize(("umask", "mode"), [(0o077, 0o600), (0o027, 0o640), (0o002, 0o664)])
def test_who_may_read_a_file_is_what_the_umask_says(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        write_atomically(tmp_path / "file", lambda temporary: temporary.write_text("new"))
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == mode


def test_files_that_belong_together_are_all_old_or_all_new(tmp_path, monkeypatch):
    paths = [tmp_path / name for name in "abc"]
    write_together(dict.fromkeys(paths, b"old"))
    write, n_written = Path.write_bytes, []

    def fail_at_last(path: Path, content: bytes) -> int:
        n_written.append(path)
        if len(n_written) == len(paths):
            half_then_fail(path)
        return write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", fail_at_last)
        with pytest.raises(OSError, match="No space left"):
            write_together(dict.fromkeys(paths, b"new"))
    assert [path.read_bytes() for path in paths] == [b"old"] * 3
    write_together(dict.fromkeys(paths, b"new"))
    assert [path.read_bytes() for path in paths] == [b"new"] * 3
    assert files_below(tmp_path) == set("abc")


def test_what_a_killed_writer_has_left_goes_with_the_next_write(tmp_path):
    names = "harness-a", "harness-b", "harness-c", "harness-d", "download"
    left, empty, new, in_use, foreign = (tmp_path / f".{name}.part" for name in names)
    for path in (left, in_use, foreign):
        path.write_text("half of it")
    empty.touch()
    new.touch()
    os.utime(empty, (0, 0))
    with in_use.open() as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        write_json(tmp_path / "file.json", {})
    assert files_below(tmp_path) == {"file.json", new.name, in_use.name, foreign.name}


# -- a bit that flips, or a file of another run, changes no number without a word --


NAME, ACTS, FLIPS = "mixture-twin", "shells-acting-twin", 100
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
    return repr((tables, {**estimate_run(folder)}, page.estimates, page.campaign, summary))


@contextmanager
def flipped(path: Path, chance: random.Random) -> Iterator[int]:
    """Flip a bit of a file for a while."""
    content = path.read_bytes()
    bit = chance.randrange(8 * len(content))
    path.write_bytes(content[: bit // 8] + bytes([content[bit // 8] ^ 1 << bit % 8]) + content[bit // 8 + 1 :])
    try:
        yield bit
    finally:
        path.write_bytes(content)


def flips_unnoticed(folder: Path, n: int, seed: int) -> Iterator[str]:
    """Flip ``n`` bits one after the other, in files of equal chance; those that changed a number without an error."""
    files = [
        path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix in (".parquet", ".json", ".yaml")
    ]
    before, chance = told(folder), random.Random(seed)
    for _ in range(n):
        path = chance.choice(files)
        with flipped(path, chance) as bit, suppress(HarnessError):
            if told(folder) != before:
                yield f"bit {bit} of {path}"


@pytest.mark.slow
def test_a_flipped_bit_changes_no_number_silently(stored):
    assert list(flips_unnoticed(stored, FLIPS, seed=1)) == []


def test_a_flipped_bit_of_a_baseline_run_changes_no_test(stored_run, tmp_path):
    """Of one whose checksum the manifest does not tell, too: its pages and the pool have checksums."""
    whole, chance, n_refused = stored_run(ACTS), random.Random(4), 0
    folder = copy_of(whole, tmp_path / "run")
    for listed in (True, False):
        if not listed:
            before = manifest(folder)["before"]
            before["shadow"]["files"]["shadow"]["crc32"] = None
            edit(folder, before=before)
        for path in (folder / "shadow").iterdir():
            with flipped(path, chance), controllers_here():
                begun = copy_of(folder, tmp_path / path.stem)
                edit(begun, n_episodes=0, parts=[], status="running")
                for table in ("episodes", "traces"):
                    shutil.rmtree(begun / table)
                try:
                    assert replay_episode(folder, 5).bit_equal
                    run_here(golden(ACTS), begun, resume=True)
                    assert not listed
                    assert unlike_columns(whole, begun) == []
                except RunFolderError:
                    n_refused += 1
                shutil.rmtree(begun)
    assert n_refused == 2


@pytest.mark.parametrize("table", ["episodes", *(pytest.param(each, marks=pytest.mark.slow) for each in TABLES[1:])])
def test_going_on_with_a_damaged_file_names_it_and_its_mend_works(table, stored, stored_run):
    damaged = part_files(stored, table)[1]
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(RunFolderError, match=f"{table}/{damaged.name}.*checksum.*Delete this file"):
        run_here(golden(NAME), stored, resume=True)
    damaged.unlink()
    with pytest.raises(RunFolderError, match=damaged.name):  # it stays in the manifest: nobody passes over it
        read(stored).table(table)
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


def test_a_pipe_in_a_files_place_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "x")
    with pytest.raises(RunFolderError, match=r"cannot be read .a pipe"):
        read_table(tmp_path / "x")
    with pytest.raises(RunFolderError, match=r"cannot be read .a pipe"):
        read_as(dict, tmp_path / "x", mend="Delete it.")


def test_json_is_strict(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "file.json", {"rhw": float("inf")})
    assert files_below(tmp_path) == set()


def test_what_arrow_reads_is_not_memory_of_python():
    """A thread that let go of that as a process ended aborted it: 13 of 36 short commands, three at once."""
    content = bytes(range(256)) * 100
    before = sys.getrefcount(content)
    own, borrowed = arrow_file(content), pa.BufferReader(content)
    assert sys.getrefcount(content) == before + 1  # that of the sibling
    assert own.read() == borrowed.read() == content
