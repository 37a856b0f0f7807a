"""The same campaign gives the same bits, however it was run: workers, cells, deaths and resumption leave no trace."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from harness.progress import SilentProgress
from tests.runner.conftest import MIXTURE_FILE, SMALL
from tests.runner.stored_runs import copy_of, manifest, shard_files, stored_table, unlike_columns

PATIENCE_S = 120.0
N_SHARDS = 20


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


class KillOneWorker(SilentProgress):
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


@pytest.fixture
def begin() -> Iterator[Callable[..., subprocess.Popen]]:
    """Start `harness run` in a process group of its own, which does not outlive the test."""
    begun: list[subprocess.Popen] = []

    def start(out: Path, complaints: Path, *options: str) -> subprocess.Popen:
        command = [
            sys.executable,
            "-m",
            "harness",
            "run",
            str(MIXTURE_FILE),
            "--out",
            str(out),
            "--workers",
            "1",
            *options,
        ]
        for override in (*SMALL, "world.cells=16"):
            command += ["--set", override]
        with complaints.open("w") as stderr:
            begun.append(
                subprocess.Popen(
                    command,
                    cwd=MIXTURE_FILE.parents[1],
                    start_new_session=True,
                    # A shell starts what runs in its background with Ctrl-C ignored, and children inherit that.
                    preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509 - no thread here
                    stdout=subprocess.DEVNULL,
                    stderr=stderr,
                )
            )
        return begun[-1]

    yield start
    for process in begun:
        kill_group(process)


def kill_group(process: subprocess.Popen) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait(PATIENCE_S)


def wait_for_shards(process: subprocess.Popen, out: Path, n: int) -> None:
    """Until so many shards are on disk; a run that ends before is a failure of the test."""
    poll_s = 0.01
    for _ in range(int(PATIENCE_S / poll_s)):
        if len(shard_files(out)) >= n:
            return
        try:
            process.wait(poll_s)
        except subprocess.TimeoutExpired:
            continue
        raise AssertionError(f"the run ended with {process.returncode}")
    raise AssertionError(f"not even {n} shards after {PATIENCE_S} s")


def test_interrupted_then_killed_then_resumed(begin, sumo_run, campaign, run_here, tmp_path):
    out, complaints = tmp_path / "run", tmp_path / "stderr"
    first = begin(out, complaints)
    wait_for_shards(first, out, 3)
    os.kill(first.pid, signal.SIGINT)
    assert first.wait(PATIENCE_S) == 130
    assert "--resume" in complaints.read_text()
    assert manifest(out)["status"] == "interrupted"

    n_stored = len(shard_files(out))
    assert 3 <= n_stored < N_SHARDS - 6
    second = begin(out, complaints, "--resume")
    wait_for_shards(second, out, n_stored + 3)
    kill_group(second)
    assert second.returncode == -signal.SIGKILL
    assert manifest(out)["status"] != "done"
    assert n_stored + 3 <= len(shard_files(out)) < N_SHARDS
    assert not (out / "estimates.json").exists()

    run_here(campaign("world.cells=64"), out, resume=True)
    assert manifest(out)["status"] == "done"
    assert unlike_columns(sumo_run, out) == []
    assert not list(out.rglob("*.part"))
