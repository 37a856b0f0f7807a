"""Files are there completely or not at all, and what cannot be read is named."""

from __future__ import annotations

import errno
import os
import pickle
import resource
import signal
from pathlib import Path

import pytest

from harness.errors import RunFolderError
from harness.records.folder import (
    encoded,
    read_as,
    read_table,
    shard_file,
    write_atomically,
    write_json,
    write_shard,
)
from harness.records.reader import read_shards
from harness.records.schemas import ShardTables
from tests.stored_runs import stored_table


@pytest.fixture
def tables(stored_run) -> ShardTables:
    """A shard with all three."""
    return ShardTables(*(stored_table(stored_run("mixture-twin"), name) for name in ShardTables._fields))


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


def test_a_real_limit_on_file_size_leaves_nothing(tmp_path, tables):
    """The kernel itself refuses to write more than a kilobyte, as a full disk would."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.getsignal(signal.SIGXFSZ)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, before[1]))
    try:
        with pytest.raises(OSError, match=r"[Ff]ile too large") as raised:
            write_shard(tmp_path, 0, encoded(tables))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert files_below(tmp_path) == set()
    assert raised.value.filename == str(tmp_path / shard_file("traces", 0))  # the kernel alone names no file
    sent = pickle.loads(pickle.dumps(raised.value))
    assert (sent.errno, sent.filename) == (errno.EFBIG, raised.value.filename)  # also from a worker
    assert set(write_shard(tmp_path, 0, encoded(tables))) == {"episodes", "moments", "traces"}


def test_episodes_come_last_so_that_they_say_that_a_shard_is_complete(tmp_path, tables, monkeypatch):
    written = []
    write = Path.write_bytes

    def fail_at_third(path: Path, content: bytes) -> int:
        written.append(path.parent.name)
        if len(written) == 3:
            half_then_fail(path)
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", fail_at_third)
    with pytest.raises(OSError, match="No space left"):
        write_shard(tmp_path, 4, encoded(tables))
    assert written == ["traces", "moments", "episodes"]
    assert files_below(tmp_path) == {shard_file("traces", 4), shard_file("moments", 4)}


def test_json_is_strict(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "file.json", {"rhw": float("inf")})
    assert files_below(tmp_path) == set()
    write_json(tmp_path / "file.json", {"rate": 0.1, "σ": [1, None]})
    assert read_as(dict, tmp_path / "file.json", mend="") == {"rate": 0.1, "σ": [1, None]}


@pytest.mark.parametrize("damage", [lambda content: content[:-30], lambda content: b"", lambda content: content[::-1]])
def test_a_damaged_table_is_named(damage, tmp_path, tables):
    path = tmp_path / write_shard(tmp_path, 0, encoded(tables))["episodes"]
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(RunFolderError, match="a file that cannot be read") as raised:
        read_table(path)
    assert raised.value.where == str(path)
    assert "--resume" in raised.value.mend


def test_shards_are_read_in_the_manifests_order_and_no_others(tmp_path, tables):
    shards = []
    for index, first in enumerate((0, 30, 60)):
        files = write_shard(tmp_path, index, encoded(ShardTables(tables.episodes.slice(first, 30), None, None)))
        shards.append({"index": index, "first_episode": first, "n_episodes": 30, "files": files})
    write_json(tmp_path / "manifest.json", {"campaign_hash": "", "n_episodes": 60, "shards": shards[:2]})
    assert [episodes["episode"].to_pylist()[0] for episodes in read_shards(tmp_path)] == [0, 30]
    assert [episodes.column_names for episodes in read_shards(tmp_path, ["outcome"])] == [["outcome"]] * 2
