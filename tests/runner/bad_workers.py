"""Worker processes that fail; put in the place of `harness.runner.processes.serve`."""

from __future__ import annotations

import errno
import os
import signal
from pathlib import Path

SHARDS_BEFORE_FAILURE = 3
TABLES_PER_SHARD = 3


def dying(connection, campaign, folder, black_box) -> None:
    """Is killed by its first shard, every time."""
    connection.recv()
    os.kill(os.getpid(), signal.SIGKILL)


def disobedient(connection, campaign, folder, black_box) -> None:
    """Finds SUMO disagreeing in its first shard."""
    from harness.errors import WorldDisagreementError

    connection.recv()
    connection.send(WorldDisagreementError("SUMO, BV3, m", found="0x1p0", expected="0x1p1", mend="Report it."))
    connection.recv()


def without_room(connection, campaign, folder, black_box) -> None:
    """Runs out of disk in the middle of the second file of the fourth shard that it is given."""
    from harness.records import folder as records_folder
    from harness.runner import processes

    write, written = records_folder.pq.write_table, []

    def write_or_fail(table, path, **options) -> None:
        written.append(path)
        if len(written) == SHARDS_BEFORE_FAILURE * TABLES_PER_SHARD + 2:
            Path(path).write_bytes(b"PAR1, and then the disk was full")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write(table, path, **options)

    records_folder.pq.write_table = write_or_fail
    processes.serve(connection, campaign, folder, black_box)
