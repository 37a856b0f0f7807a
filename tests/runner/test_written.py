"""What a run writes: few files, none without rows, and none that it opens again itself."""

from __future__ import annotations

import os
import sys

import pyarrow.parquet as pq
import pytest

from harness.runner import kept
from tests.in_process import run_here, run_with_workers
from tests.stored_runs import golden, manifest, part_files, unlike_columns

opened: dict[str, list[str]] = {}


def note(event, arguments):
    if event == "open" and opened and isinstance(arguments[0], str | os.PathLike):
        path, mode, flags = str(arguments[0]), arguments[1], arguments[2]
        (folder,) = opened
        reads = mode.startswith("r") if mode else not flags & (os.O_WRONLY | os.O_RDWR)
        if path.startswith(folder + os.sep) and reads and not path.endswith(".part"):
            opened[folder].append(path)


@pytest.mark.parametrize("name", ["nde-twin", "shells-twin", "step-recursive-twin"])
def test_estimates_come_from_what_is_in_hand(name, tmp_path):
    """The page is another matter: it plays traces."""
    sys.addaudithook(note)
    opened[str(tmp_path / "run")] = []
    try:
        run_here(golden(name), tmp_path / "run")
        assert list(opened.values()) == [[]]
    finally:
        opened.clear()


def test_there_is_one_file_per_table_and_none_without_rows(stored_run, tmp_path):
    run_with_workers(golden("nde-twin"), tmp_path / "run", workers=2)
    n = manifest(tmp_path / "run")["n_episodes"]
    for table in kept.TABLES:
        files = part_files(tmp_path / "run", table)
        assert all(pq.read_metadata(path).num_rows for path in files)
        assert [path.name for path in files] in ([], [f"{0:09d}-{n:09d}.parquet"])
    assert unlike_columns(stored_run("nde-twin"), tmp_path / "run") == []


def test_what_there_is_is_written_again_while_a_file_is_not_full(stored_run, tmp_path, monkeypatch):
    """With every shard, here: the end is the same, and no earlier file of it is left."""
    monkeypatch.setattr(kept, "_INTERVAL_S", 0.0)
    monkeypatch.setattr(kept, "_SHARE", 1e9)
    run_with_workers(golden("mixture-twin"), tmp_path / "run", workers=1)
    assert len(part_files(tmp_path / "run")) == 1
    assert unlike_columns(stored_run("mixture-twin"), tmp_path / "run") == []
