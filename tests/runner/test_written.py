"""What a run writes: few files, none without rows, and none that it opens again itself; what it reads, once."""

from __future__ import annotations

import os
import shutil
import sys
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import harness
from harness import cache
from harness.families.cut_in.parameters import SHIPPED_FOLDER
from harness.runner import kept
from harness.runner.stored import write_report
from harness.vehicles import library
from tests.golden.campaigns import BASE, RUNS
from tests.in_process import controllers_here, one_process, run_here, run_with_workers
from tests.stored_runs import golden, manifest, part_files, unlike_columns

opened: dict[Path, Counter[str]] = {}
hooked: list[bool] = []


def note(event, arguments):
    if event == "open" and opened and isinstance(arguments[0], str | os.PathLike):
        path, mode, flags = str(arguments[0]), arguments[1], arguments[2]
        [folder] = opened
        # That of `harness.files.opened`, the opener of an open, has been counted with that.
        reads = mode.startswith("r") if mode else not flags & (os.O_WRONLY | os.O_RDWR | os.O_NONBLOCK)
        if reads and Path(path).is_relative_to(folder) and not path.endswith(".part") and not Path(path).is_dir():
            opened[folder][str(Path(path).relative_to(folder))] += 1


@contextmanager
def opens_below(folder):
    """How often each file below a folder is opened for reading."""
    if not hooked:  # it stays
        sys.addaudithook(note)
        hooked.append(True)
    opened[folder] = Counter()
    try:
        yield opened[folder]
    finally:
        opened.clear()


def inputs_in(folder, name):
    """Files of one's own that a golden campaign may be run from, and its overrides."""
    campaign = golden(name)
    drivers = campaign.pool.library or library.OF_TRAFFIC[False]
    shutil.copy(BASE, folder / "campaign.yaml")
    shutil.copy(SHIPPED_FOLDER / f"{campaign.environment.parameters}.yaml", folder / "traffic.yaml")
    shutil.copy(library.SHIPPED_FOLDER / f"{drivers}.yaml", folder / "drivers.yaml")
    return [*RUNS[name], "environment.parameters=traffic.yaml", "pool.library=drivers.yaml"]


@pytest.mark.parametrize("name", ["shells-twin", pytest.param("shells-acting-twin", marks=pytest.mark.slow)])
def test_the_answer_and_the_page_come_from_what_is_in_hand(name, tmp_path):
    """But for traces, which the page plays; made from the folder it is the same page. Each input is read once."""
    overrides = inputs_in(tmp_path, name)
    inputs = ["campaign.yaml", "traffic.yaml", *(["drivers.yaml"] if golden(name).sampling.strata else [])]
    with opens_below(tmp_path) as reads, one_process(), controllers_here():
        harness.run(harness.load_campaign(tmp_path / "campaign.yaml", overrides), tmp_path / "run", workers=1)
        read = {path: n for path, n in reads.items() if not path.startswith("run/traces/")}
    assert read == dict.fromkeys(inputs, 1)
    page = (tmp_path / "run" / "report.html").read_bytes()
    assert write_report(tmp_path / "run").read_bytes() == page


def test_a_pool_is_read_once_in_a_process(stored_run, tmp_path):
    stored_run("shells-twin")  # has built it
    with opens_below(cache.own_folder()) as reads:
        run_here(golden("shells-twin"), tmp_path / "run")  # its one worker is this process, too
        pools = {path: n for path, n in reads.items() if path.startswith("pools/")}
    assert list(pools.values()) == [1]


@pytest.mark.slow
def test_what_an_earlier_run_has_left_is_read_once(tmp_path):
    name = "shells-acting-twin"
    run_here(golden(name, "stop.episodes=200"), tmp_path / "run")
    with opens_below(tmp_path / "run") as reads, one_process(), controllers_here():
        harness.run(golden(name), tmp_path / "run", workers=1, resume=True)
    assert set(reads) >= {"manifest.json", "shells.json"}
    assert {path: n for path, n in reads.items() if n > 1 and not path.startswith("traces/")} == {}


def test_there_is_one_file_per_table_and_none_without_rows(stored_run, tmp_path):
    run_with_workers(golden("nde-twin"), tmp_path / "run", workers=2)
    n = manifest(tmp_path / "run")["n_episodes"]
    for table in kept.TABLES:
        files = part_files(tmp_path / "run", table)
        assert all(pq.read_metadata(path).num_rows for path in files)
        assert [path.name for path in files] in ([], [f"{0:09d}-{n:09d}.parquet"])
    assert unlike_columns(stored_run("nde-twin"), tmp_path / "run") == []
