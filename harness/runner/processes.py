"""A worker process at the end of a pipe of its own."""

from __future__ import annotations

import os
import pickle
import traceback
from collections.abc import Mapping, Sequence
from itertools import count
from multiprocessing.connection import Connection, wait
from pathlib import Path

from harness.campaign.models import Campaign
from harness.controllers.black_box import Call, Death, last_call
from harness.interruption import leave_signals_to_parent
from harness.runner.worker import ShardDone, ShardRunner, ShardSpec
from harness.spawning import spawn_context

CLOSING_S = 10.0
"""Time that a worker gets to release its controllers once all is done."""
_numbers = count()


class WorkerProcess:
    """A process that runs one shard after another.

    Parameters
    ----------
    campaign : Campaign
    folder : Path
        Run folder, where it writes.
    """

    def __init__(self, campaign: Campaign, folder: Path) -> None:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        context = spawn_context()
        self._black_box = folder / f".black-box-{next(_numbers)}"
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, campaign, folder, self._black_box), daemon=True)
        self._process.start()
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
            answer = self.connection.recv()
        except (EOFError, OSError):
            return None
        if isinstance(answer, BaseException):
            raise answer
        return answer  # type: ignore[no-any-return]

    def kill(self) -> int | None:
        """End it at once, whatever it does (files are written atomically); returns its exit code."""
        self._process.kill()
        self._process.join()
        self.connection.close()
        self._black_box.unlink(missing_ok=True)
        return self._process.exitcode

    def last_call(self) -> Call | None:
        """The controller's call that it is in, or has died in."""
        return last_call(self._black_box)

    def dismiss(self) -> None:
        """Tell an idle worker that nothing more comes: it releases its controllers."""
        self.connection.close()

    def wait(self) -> None:
        """Give a dismissed worker a little time; then end it."""
        self._process.join(CLOSING_S)
        self.kill()


def first_to_answer(workers: Sequence[WorkerProcess]) -> WorkerProcess:
    """Wait until one of the workers has answered or died."""
    ready = wait([worker.connection for worker in workers])[0]
    return next(worker for worker in workers if worker.connection is ready)


def serve(connection: Connection, campaign: Campaign, folder: Path, black_box: Path) -> None:
    """What the process does: prepare with the first shard, run shards until the parent is gone or has no more.

    The parent alone answers to Ctrl-C and to the end of the terminal.
    """
    leave_signals_to_parent()
    runner: ShardRunner | None = None
    while True:
        try:
            spec, doomed = connection.recv()
        except (EOFError, OSError):
            break
        try:
            runner = runner or ShardRunner(campaign, folder, black_box)
            answer: ShardDone | Exception = runner.run(spec, doomed)
        except Exception as error:  # noqa: BLE001 - whatever goes wrong here is the parent's to judge
            answer = fit_to_travel(error)
        try:
            connection.send(answer)
        except OSError:  # the parent was killed: nobody is left to tell
            break
    if runner is not None:
        runner.close()


def fit_to_travel(error: Exception) -> Exception:
    """The error with its traceback as a note; in words where it cannot be pickled."""
    text = "".join(traceback.format_exception(error))
    error.add_note(f"In a worker process:\n{text}")
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    except Exception:  # noqa: BLE001 - exceptions fail to be pickled in many ways
        return RuntimeError(text)
    return error
