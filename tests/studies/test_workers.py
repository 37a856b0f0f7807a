"""Workers of an experiment do not outlive it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool

import pytest

from harness.studies.run import worker_processes

PARENT = """
import os, time
from harness.studies.run import worker_processes

if __name__ == "__main__":
    with worker_processes(1) as executor:
        print(executor.submit(os.getpid).result(), flush=True)
        executor.submit(time.sleep, 60).result()
"""


@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="waits for the end of another's child: Linux only")
def test_a_worker_ends_when_the_experiment_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT, encoding="utf-8")
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        worker = os.pidfd_open(int(parent.stdout.readline()))  # can be read from when it ends
        assert select.select([worker], [], [], 0.0)[0] == []
        parent.send_signal(signal.SIGKILL)
    assert select.select([worker], [], [], 20.0)[0] == [worker]
    os.close(worker)


def interrupt(futures):
    with worker_processes(1) as executor:
        assert executor.submit(os.getpid).result() != os.getpid()
        futures.append(executor.submit(time.sleep, 60))
        raise KeyboardInterrupt


def test_an_interrupted_experiment_does_not_wait_for_its_workers():
    futures = []
    with pytest.raises(KeyboardInterrupt):
        interrupt(futures)
    assert isinstance(futures[0].exception(), BrokenProcessPool)  # not the minute of sleep
