"""A worker process at the end of a pipe of its own."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from itertools import count
from multiprocessing.connection import Connection, wait
from pathlib import Path

from harness.controllers.apart import LOOK_S, end_process, fit_to_travel, start_process
from harness.controllers.black_box import Call, Death, last_call
from harness.resolved import Resolved
from harness.runner.worker import ShardDone, ShardRunner, ShardSpec
from harness.spawning import spawn_context

CLOSING_S = 10.0
"""Time that a worker gets to release its controllers once all is done."""
CLOSING_LOOK_S = 0.05
_numbers = count()


class WorkerProcess:
    """A process that runs one shard after another.

    Parameters
    ----------
    resolved : Resolved
    folder : Path
        Run folder; a file in it tells which call of a controller the process is in.
    """

    def __init__(self, resolved: Resolved, folder: Path) -> None:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        self._black_box = folder / f".black-box-{next(_numbers)}"
        self.connection, theirs = spawn_context().Pipe()
        self._process = start_process(serve, theirs, resolved, self._black_box)
        theirs.close()  # or its death would not end the pipe

    def give(self, spec: ShardSpec, doomed: Mapping[int, Death]) -> bool:
        """Give it a shard to run, with the episodes known to end a process; False if it is dead."""
        try:
            self.connection.send((spec, dict(doomed)))
        except OSError:
            return False
        return True

    def answer(self) -> ShardDone | None:
        """The finished shard, or None if the process has died on it.

        Raises
        ------
        Exception
            Whatever running the shard has raised.
        """
        try:
            answer = self.connection.recv() if self.connection.poll() else None
        except (EOFError, OSError):
            return None
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def kill(self) -> int | None:
        """End it at once, whatever it does; returns its exit code."""
        exit_code = end_process(self._process)
        self.connection.close()
        self._black_box.unlink(missing_ok=True)
        return exit_code

    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process.is_alive()

    def last_call(self) -> Call | None:
        """The controller's call that it is in, or has died in."""
        return last_call(self._black_box)

    def dismiss(self) -> None:
        """Tell an idle worker that nothing more comes: it releases its controllers."""
        self.connection.close()

    def wait(self) -> None:
        """Give a dismissed worker a little time; then end it."""
        until = time.monotonic() + CLOSING_S
        while self.is_alive() and time.monotonic() < until:  # a copy of it may keep open what join() waits for
            self._process.join(CLOSING_LOOK_S)
        self.kill()


def first_to_answer(workers: Sequence[WorkerProcess]) -> WorkerProcess:
    """Wait until one of the workers has answered or died."""
    while True:
        dead = [worker for worker in workers if not worker.is_alive()]
        ready = wait([worker.connection for worker in workers], 0.0 if dead else LOOK_S)
        found = [worker for worker in workers if worker.connection in ready] or dead
        if found:
            return found[0]


def serve(connection: Connection, resolved: Resolved, black_box: Path) -> None:
    """What the process does: prepare with the first shard, run shards until the parent is gone or has no more."""
    runner: ShardRunner | None = None
    while True:
        try:
            spec, doomed = connection.recv()
        except (EOFError, OSError):
            break
        try:
            runner = runner or ShardRunner(resolved, black_box)
            answer: ShardDone | Exception = runner.run(spec, doomed)
        except Exception as error:  # noqa: BLE001 - whatever goes wrong here is the parent's to judge
            answer = fit_to_travel(error)
        try:
            connection.send(answer)
        except OSError:  # the parent was killed: nobody is left to tell
            break
    if runner is not None:
        runner.close()
