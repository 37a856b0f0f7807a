"""Worker processes that fail; put in the place of `harness.runner.workers.serve`."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path


def dying(connection, resolved, baseline) -> None:
    """Is killed by its first shard, every time."""
    connection.recv()
    os.kill(os.getpid(), signal.SIGKILL)


def disobedient(connection, resolved, baseline) -> None:
    """Finds SUMO disagreeing in its first shard."""
    from harness.errors import WorldDisagreementError

    connection.recv()
    connection.send(WorldDisagreementError("SUMO, BV3, m", found="0x1p0", expected="0x1p1", mend="Report it."))
    connection.recv()


def answering(connection) -> None:
    """Says who it is."""
    connection.send(os.getpid())


def garbled(connection) -> None:
    """Sends what nobody can read, and lives on."""
    connection.send_bytes(b"no pickle")
    time.sleep(600)


def abandoned(connection, note) -> None:
    """Starts a program, another in a session of its own, and writes down who they are; then it is busy."""
    assert "PYTHONSAFEPATH" not in os.environ  # which was the server's alone
    helpers = [subprocess.Popen(["/bin/sleep", "600"], start_new_session=apart).pid for apart in (False, True)]
    Path(note).write_text(" ".join(map(str, (os.getpid(), *helpers))), encoding="utf-8")
    Path(note).rename(note + ".done")
    time.sleep(600)
