"""The same campaign gives the same bits, however it was run: worlds, workers, cells and deaths leave no trace."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from harness.progress import Progress
from tests.golden.campaigns import BASE, IN_BOTH_WORLDS
from tests.in_process import run_here, workers_alive
from tests.stored_runs import MORE, copy_of, golden, manifest, sets, shard_files, stored_table, unlike_columns

PATIENCE_S = 300.0
SEVEN = "mixture-seven"


@pytest.mark.parametrize("name", IN_BOTH_WORLDS)
def test_sumo_and_the_twin(name, stored_run):
    assert unlike_columns(stored_run(f"{name}-sumo"), stored_run(f"{name}-twin")) == ["estimates.json"]


@pytest.mark.parametrize("name", ["forced-batch", "forced-traci-style"])
def test_the_idm_however_it_is_brought(name, stored_run):
    assert unlike_columns(stored_run(name), stored_run("forced-twin")) == ["estimates.json"]


@pytest.mark.parametrize(
    ("name", "cells"),
    [
        *(
            ("step-recursive-sumo", 64),
            ("forced-inattentive", 7),
            ("forced-acting-twin", 5),
            ("forced-lateral-twin", 7),
        ),
        *(("shells-twin", 64), ("shells-acting-twin", 64), ("shells-lateral-twin", 5)),
    ],
)
def test_any_number_of_cells(name, cells, stored_run, tmp_path):
    run_here(golden(name, f"world.cells={cells}"), tmp_path / "run")
    assert unlike_columns(stored_run(name), tmp_path / "run") == []


@pytest.mark.parametrize("name", [SEVEN, "shells-acting-twin"])
def test_two_workers(name, stored_run, run, tmp_path):
    run(golden(name, "world.cells=64"), tmp_path / "run", workers=2)
    assert unlike_columns(stored_run(name), tmp_path / "run") == []


def test_one_bit_of_one_value_makes_the_comparison_fail(stored_run, tmp_path):
    other = copy_of(stored_run(SEVEN), tmp_path / "run")
    path = shard_files(other, "traces")[5]
    traces = pq.read_table(path, partitioning=None)
    x = traces["x_m"].to_numpy().copy()
    x[123] = np.nextafter(x[123], 0.0)
    index = traces.column_names.index("x_m")
    pq.write_table(traces.set_column(index, traces.schema.field("x_m"), [x]), path)
    assert unlike_columns(stored_run(SEVEN), other) == ["traces.x_m"]


class KillOneWorker(Progress):
    """Kills a worker process when the fourth shard is handed back."""

    def __init__(self) -> None:
        self.calls, self.killed = 0, []

    def advance(self, n: int = 1) -> None:
        self.calls += 1
        if self.calls == 4:
            self.killed = [workers_alive()[0]]
            os.kill(self.killed[0], signal.SIGKILL)


def test_a_worker_that_is_killed_changes_nothing(stored_run, run, tmp_path):
    progress = KillOneWorker()
    run(golden(SEVEN), tmp_path / "run", workers=2, progress=progress)
    assert progress.killed
    assert unlike_columns(stored_run(SEVEN), tmp_path / "run") == []


STRUCK = """
import os, signal, sys
from pathlib import Path
from harness.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever starts tests in the background ignores it
n_writes, write = 0, Path.write_bytes

def half_then_strike(path, content):
    global n_writes
    of_shard = path.parent.name == "moments"
    n_writes += of_shard
    if of_shard and n_writes == int(sys.argv[2]):
        write(path, content[: len(content) // 2])
        os.kill(os.getpid(), int(sys.argv[1]))
    return write(path, content)

Path.write_bytes = half_then_strike
sys.exit(main(sys.argv[3:]))
"""


def struck_run(out: Path, number: signal.Signals, nth_shard: int, *options: str) -> subprocess.CompletedProcess:
    """`harness run` that a signal reaches when a file of the n-th shard that it makes is half written."""
    command = [sys.executable, "-c", STRUCK, str(number.value), str(nth_shard), "run", BASE, "--out", out, *options]
    command += [*sets(*MORE[SEVEN]), "--workers", "1"]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


def test_interrupted_then_killed_then_resumed(stored_run, tmp_path):
    out = tmp_path / "run"
    first = struck_run(out, signal.SIGINT, 3)
    assert (first.returncode, "--resume" in first.stderr) == (130, True)
    assert (manifest(out)["status"], manifest(out)["n_episodes"]) == ("interrupted", 160)
    assert len(shard_files(out)) == 2
    assert not list(out.rglob("*.part"))

    assert struck_run(out, signal.SIGKILL, 4, "--resume").returncode == -signal.SIGKILL
    assert manifest(out)["status"] != "done"
    assert len(shard_files(out)) == 5
    assert len(list(out.rglob("*.part"))) == 1

    run_here(golden(SEVEN), out, resume=True)
    assert manifest(out)["status"] == "done"
    assert stored_table(out, "episodes")["episode"].to_pylist() == list(range(560))
    assert unlike_columns(stored_run(SEVEN), out) == []
    assert not list(out.rglob("*.part"))
