"""The same campaign gives the same bits, however it was run: worlds, workers, cells, signals, deaths leave no trace."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from multiprocessing import forkserver
from pathlib import Path

import pytest

from harness.processes import CLOSED_PIPE_EXIT_CODE, Child, first_to_answer, start_server
from harness.resolved import resolve
from harness.runner import workers
from harness.runner.kept import Run
from tests.golden.campaigns import IN_BOTH_WORLDS, quick
from tests.in_process import run_here
from tests.runner import bad_workers
from tests.runner.conftest import campaign
from tests.stored_runs import ROOT, golden, manifest, part_files, sets, unlike_columns

PATIENCE_S, POLL_S = 300.0, 0.01
WRITES_OFTEN = """
import runpy
from harness.runner import kept
kept._INTERVAL_S = 0.5
runpy.run_module("harness", run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize("name", quick(IN_BOTH_WORLDS))
def test_sumo_and_the_twin(name, stored_run):
    assert unlike_columns(stored_run(f"{name}-sumo"), stored_run(f"{name}-twin")) == ["estimates.json"]


@pytest.mark.parametrize(
    ("name", "cells"),
    [
        *(("step-recursive-sumo", 64), ("forced-inattentive", 7), ("shells-lateral-twin", 5)),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in (("forced-acting-twin", 5), ("mixture-twin", 1))),
    ],
)
def test_any_number_of_cells(name, cells, stored_run, tmp_path):
    run_here(golden(name, f"world.cells={cells}"), tmp_path / "run")
    assert unlike_columns(stored_run(name), tmp_path / "run") == []


@pytest.mark.parametrize(("name", "size"), [("nde-twin", 7), ("mixture-twin", 101)])
def test_any_split_into_shards(name, size, stored_run, tmp_path):
    run_here(golden(name, f"run.shard_size={size}"), tmp_path / "run")
    assert set(unlike_columns(stored_run(name), tmp_path / "run")) <= {"estimates.json"}


# -- processes of their own: each costs seconds of imports --


def wait_for(process: subprocess.Popen, condition) -> None:
    for _ in range(int(PATIENCE_S / POLL_S)):
        if condition():
            return
        try:
            process.wait(POLL_S)
        except subprocess.TimeoutExpired:
            continue
        raise AssertionError(f"the run ended with {process.returncode}: {process.stderr.read()}")
    raise AssertionError("too late")


def finished(process: subprocess.Popen) -> tuple[int, str]:
    """Exit code and stderr; the pipe ends only when nobody is left that holds it."""
    try:
        _, complaints = process.communicate(timeout=PATIENCE_S)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, complaints


def as_under_nohup() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.default_int_handler)


def test_what_is_ignored_stays_ignored_and_ctrl_c_to_all_processes_ends_a_run_in_order(tmp_path):
    out, temporary = tmp_path / "run", tmp_path / ("t" * 100)  # longer than the path of a socket may be
    temporary.mkdir()
    settings = ("world.engine=twin", "stop.episodes=1000000000", "stop.rhw=null", "run.shard_size=500")
    asked = ["run", "scenarios/overtaking_forced.yaml", "--out", out, "--workers", "2", *sets(*settings)]
    process = subprocess.Popen(
        [sys.executable, "-c", WRITES_OFTEN, *asked],
        cwd=ROOT,
        env={**os.environ, "TMPDIR": str(temporary)},
        start_new_session=True,
        preexec_fn=as_under_nohup,  # noqa: PLW1509 - no thread here
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for(process, lambda: part_files(out))
    os.killpg(process.pid, signal.SIGHUP)
    n = manifest(out)["n_episodes"]
    wait_for(process, lambda: manifest(out)["n_episodes"] > n)
    os.killpg(process.pid, signal.SIGINT)
    code, complaints = finished(process)
    assert code == 128 + signal.SIGINT
    assert "the same command with --resume goes on" in complaints
    assert "Traceback" not in complaints
    assert manifest(out)["status"] == "interrupted"
    assert manifest(out)["n_episodes"] >= 500
    assert not [*out.rglob(".*"), *temporary.iterdir()]


def test_an_interruption_as_tests_are_written_loses_none_of_them(tmp_path, monkeypatch):
    add, out = Run.with_shard, tmp_path / "run"

    def add_and_interrupt(run, shard):
        run = add(run, shard).written()
        signal.raise_signal(signal.SIGINT)
        return run

    monkeypatch.setattr(Run, "with_shard", add_and_interrupt)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs are to ignore it
    with pytest.raises(KeyboardInterrupt):
        run_here(campaign("world.engine=twin", "stop.episodes=400", "run.shard_size=200"), out)
    assert (manifest(out)["status"], manifest(out)["n_episodes"]) == ("interrupted", 200)


ABANDONED = """
import os, signal, sys, time
from harness.processes import Child
from tests.runner.bad_workers import abandoned

child = Child(abandoned, sys.argv[1])
while not os.path.exists(sys.argv[1] + ".done"):
    time.sleep(0.01)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_busy_worker_does_not_outlive_a_killed_parent_nor_does_what_it_has_started(tmp_path):
    script, note = tmp_path / "parent.py", tmp_path / "pids"
    script.write_text(ABANDONED, encoding="utf-8")
    here = tmp_path / "here"
    here.mkdir()
    (here / "random.py").write_text("raise ImportError('not the library’s')", encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(script), str(note)]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, cwd=here)
    assert finished(process) == (-signal.SIGKILL, "")
    for pid in map(int, (tmp_path / "pids.done").read_text().split()):
        wait_until_gone(Path(f"/proc/{pid}/stat"))


@pytest.mark.slow
def test_workers_begin_where_the_process_was_killed_that_they_are_copies_of():
    for delay_s in (0.0, 0.3):
        start_server()
        time.sleep(delay_s)
        os.kill(forkserver._forkserver._forkserver_pid, signal.SIGKILL)
        child = Child(bad_workers.answering)
        assert first_to_answer([child]).answer() == child._process.pid
        child.kill()


def test_a_worker_that_sends_what_nobody_can_read_has_died():
    child = Child(bad_workers.garbled)
    assert first_to_answer([child]).answer().exit_code == CLOSED_PIPE_EXIT_CODE
    assert not child._process.is_alive()


def wait_until_gone(state: Path) -> None:
    """A process closes its files a moment before it is gone."""
    for _ in range(int(PATIENCE_S / POLL_S)):
        if not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            return
        time.sleep(POLL_S)
    raise AssertionError(f"{state} is still there")


@pytest.mark.parametrize(("asked", "n_workers"), [(None, 3), (64, 64)])
def test_workers_are_as_many_as_there_are_cpus_for_them(monkeypatch, asked, n_workers):
    monkeypatch.setattr(workers, "usable_cpus", lambda: 3)
    local = workers.LocalWorkers(resolve(golden("nde-twin")), asked)
    local.close()
    assert local.n_workers == n_workers
