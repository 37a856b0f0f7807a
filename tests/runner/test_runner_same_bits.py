"""The same campaign gives the same bits, however it was run: workers, cells, deaths and resumption leave no trace."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from harness.progress import Progress
from tests.runner.conftest import MIXTURE_FILE, SMALL, sets
from tests.stored_runs import copy_of, manifest, shard_files, stored_table, unlike_columns

PATIENCE_S = 300.0


def test_the_reference_has_something_to_compare(sumo_run):
    episodes = stored_table(sumo_run, "episodes")
    assert episodes["episode"].to_pylist() == list(range(1600))
    assert episodes["outcome"].to_pylist().count("crash") >= 500
    assert stored_table(sumo_run, "moments").num_rows >= 8_000
    assert stored_table(sumo_run, "traces").num_rows >= 80_000


def test_one_bit_of_one_value_makes_the_comparison_fail(sumo_run, tmp_path):
    other = copy_of(sumo_run, tmp_path / "run")
    path = shard_files(other, "traces")[7]
    traces = pq.read_table(path, partitioning=None)
    x = traces["x_m"].to_numpy().copy()
    x[123] = np.nextafter(x[123], 0.0)
    index = traces.column_names.index("x_m")
    pq.write_table(traces.set_column(index, traces.schema.field("x_m"), [x]), path)
    assert unlike_columns(sumo_run, other) == ["traces.x_m"]


def test_two_workers_and_sixty_four_cells(sumo_run, campaign, run, tmp_path):
    run(campaign("world.cells=64"), tmp_path / "run", workers=2)
    assert unlike_columns(sumo_run, tmp_path / "run") == []


class KillOneWorker(Progress):
    """Kills a worker process when the fourth shard is handed back."""

    def __init__(self) -> None:
        self.calls, self.killed = 0, []

    def advance(self, n: int = 1) -> None:
        self.calls += 1
        if self.calls == 4:
            self.killed = [multiprocessing.active_children()[0].pid]
            os.kill(self.killed[0], signal.SIGKILL)


def test_a_worker_that_is_killed_changes_nothing(sumo_run, campaign, run, tmp_path):
    progress = KillOneWorker()
    run(campaign("world.cells=16"), tmp_path / "run", workers=2, progress=progress)
    assert progress.killed
    assert unlike_columns(sumo_run, tmp_path / "run") == []


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


def struck(number: signal.Signals, nth_shard: int, *words: object) -> subprocess.CompletedProcess:
    """A command that a signal reaches when a file of the n-th shard that it makes is half written."""
    command = [sys.executable, "-c", STRUCK, str(number.value), str(nth_shard), *map(str, words), "--workers", "1"]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


def struck_run(out: Path, number: signal.Signals, nth_shard: int, *options: str) -> subprocess.CompletedProcess:
    """The same of `harness run`."""
    settings = sets(*SMALL, "world.cells=16")
    return struck(number, nth_shard, "run", MIXTURE_FILE, "--out", out, *options, *settings)


def test_interrupted_then_killed_then_resumed(sumo_run, campaign, run_here, tmp_path):
    out = tmp_path / "run"
    first = struck_run(out, signal.SIGINT, 4)
    assert (first.returncode, "--resume" in first.stderr) == (130, True)
    assert (manifest(out)["status"], manifest(out)["n_episodes"]) == ("interrupted", 240)
    assert len(shard_files(out)) == 3
    assert not list(out.rglob("*.part"))

    assert struck_run(out, signal.SIGKILL, 4, "--resume").returncode == -signal.SIGKILL
    assert manifest(out)["status"] != "done"
    assert len(shard_files(out)) == 6
    assert len(list(out.rglob("*.part"))) == 1

    run_here(campaign("world.cells=64"), out, resume=True)
    assert manifest(out)["status"] == "done"
    assert unlike_columns(sumo_run, out) == []
    assert not list(out.rglob("*.part"))
