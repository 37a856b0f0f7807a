"""Workers of an experiment do not outlive it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from harness.studies.run import _executor

PARENT = """
import os, time
from harness.studies.run import _executor

if __name__ == "__main__":
    with _executor(1) as executor:
        print(executor.submit(os.getpid).result(), flush=True)
        executor.submit(time.sleep, 60).result()
"""


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii")
    return stat.rpartition(")")[2].split()[0] != "Z"  # nobody may be there to reap it


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="looks at processes in /proc")
def test_a_worker_ends_when_the_experiment_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT, encoding="utf-8")
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        worker = int(parent.stdout.readline())
        assert is_alive(worker)
        parent.send_signal(signal.SIGKILL)
    assert_ends(worker)


def assert_ends(worker):
    deadline = time.monotonic() + 20.0
    while is_alive(worker) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not is_alive(worker)


def interrupt(futures):
    with _executor(1) as executor:
        assert executor.submit(os.getpid).result() != os.getpid()
        futures.append(executor.submit(time.sleep, 60))
        raise KeyboardInterrupt


def test_an_interrupted_experiment_does_not_wait_for_its_workers():
    futures = []
    with pytest.raises(KeyboardInterrupt):
        interrupt(futures)
    assert isinstance(futures[0].exception(), BrokenProcessPool)  # not the minute of sleep
