"""Signals end a run in order, with real processes: what is finished stays, and nobody works on."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from harness.processes import Child, ForkServer
from tests.runner import bad_workers
from tests.stored_runs import manifest, shard_files

SCENARIO = Path(__file__).parents[2] / "scenarios" / "overtaking_forced.yaml"
OPTIONS = ("world.engine=twin", "stop.episodes=1000000000", "stop.rhw=null", "run.shard_size=500", "world.cells=16")
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
PATIENCE_S, POLL_S = 300.0, 0.01


def begin(out: Path, *, ignored: tuple[int, ...] = ()) -> subprocess.Popen:
    """`harness run` in a session of its own, with signals as a terminal leaves them, or ignored."""

    def as_a_terminal() -> None:
        for number in CODES:
            signal.signal(number, signal.SIG_IGN if number in ignored else signal.SIG_DFL)

    command = [sys.executable, "-m", "harness", "run", str(SCENARIO), "--out", str(out), "--workers", "2"]
    for override in OPTIONS:
        command += ["--set", override]
    return subprocess.Popen(
        command,
        start_new_session=True,
        preexec_fn=as_a_terminal,  # noqa: PLW1509 - no thread here
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


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
    """Exit code and stderr; the pipe ends only when no worker is left that holds it."""
    try:
        _, complaints = process.communicate(timeout=PATIENCE_S)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, complaints


def require_order(process: subprocess.Popen, out: Path, number: signal.Signals) -> None:
    """A run ends as one that the signal has reached."""
    code, complaints = finished(process)
    assert code == CODES[number]
    assert "the same command with --resume goes on" in complaints
    assert "Traceback" not in complaints
    assert manifest(out)["status"] == "interrupted"
    assert manifest(out)["n_episodes"] >= 500
    assert not list(out.rglob(".*"))


def test_a_signal_of_the_terminal_to_all_processes_ends_a_run_in_order(tmp_path):
    out = tmp_path / "run"
    process = begin(out)
    wait_for(process, lambda: len(shard_files(out)) >= 2)  # the first has been counted then
    os.killpg(process.pid, signal.SIGHUP)
    require_order(process, out, signal.SIGHUP)


def test_what_is_ignored_stays_ignored(tmp_path):
    """As under nohup; SIGTERM, to the run alone, ends it in order."""
    out = tmp_path / "run"
    process = begin(out, ignored=(signal.SIGHUP, signal.SIGINT))
    wait_for(process, lambda: len(shard_files(out)) >= 2)
    os.killpg(process.pid, signal.SIGHUP)
    os.killpg(process.pid, signal.SIGINT)
    n = len(shard_files(out))
    wait_for(process, lambda: len(shard_files(out)) >= n + 2)
    process.send_signal(signal.SIGTERM)
    require_order(process, out, signal.SIGTERM)


ABANDONED = """
import os, signal, sys, time
from harness.processes import Child
from tests.runner.bad_workers import abandoned

Child(abandoned, sys.argv[1])
while not os.path.exists(sys.argv[1] + ".done"):
    time.sleep(0.01)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_busy_worker_does_not_outlive_a_killed_parent_nor_does_what_it_has_started(tmp_path):
    script, note = tmp_path / "parent.py", tmp_path / "pids"
    script.write_text(ABANDONED, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(SCENARIO.parents[1])}
    command = [sys.executable, str(script), str(note)]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    code, complaints = finished(process)  # the pipe ends only when nobody is left that holds it
    assert (code, complaints) == (-signal.SIGKILL, "")
    for pid in map(int, (tmp_path / "pids.done").read_text().split()):
        wait_until_gone(Path(f"/proc/{pid}/stat"))


def test_copies_of_a_fork_server_are_whole_and_end_with_it():
    """It has one thread at the fork, and is started again when it was killed."""
    server = ForkServer("harness.runner.workers", "libsumo")
    first, second = (Child(bad_workers.waiting, server=server) for _ in range(2))
    assert [first.connection.recv(), second.connection.recv()] == [1, 1]
    assert first.send("end")
    first.wait(PATIENCE_S)
    assert (first.is_alive(), second.is_alive()) == (False, True)
    os.killpg(server.start()._process.pid, signal.SIGKILL)
    wait_until_gone(Path(f"/proc/{second._process.pid}/stat"))
    assert (second.receive(), second.kill()) == (None, -signal.SIGKILL)
    third = Child(bad_workers.waiting, server=server)
    assert third.connection.recv() == 1
    assert third.kill() == -signal.SIGKILL
    server.close()


def wait_until_gone(state: Path) -> None:
    """A process closes its files a moment before it is gone."""
    for _ in range(int(PATIENCE_S / POLL_S)):
        if not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            return
        time.sleep(POLL_S)
    raise AssertionError(f"{state} is still there")
