"""Workers that are processes of this machine, each at the end of a pipe of its own."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Mapping, Sequence
from itertools import count
from multiprocessing.connection import wait
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.controllers.apart import LOOK_S, end_process, start_process
from harness.controllers.black_box import Death, last_call
from harness.resolved import Resolved
from harness.runner.executor import CLOSING_S, Ended
from harness.runner.worker import Done, Spec, serve
from harness.spawning import spawn_context

CLOSING_LOOK_S = 0.05


class WorkerProcess:
    """A process that runs one shard after another, at the end of a pipe of its own."""

    def __init__(self, resolved: Path, folder: Path, black_box: Path) -> None:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        self._black_box = black_box
        self.connection, theirs = spawn_context().Pipe()
        self._process = start_process(serve, theirs, resolved, folder, black_box)
        theirs.close()  # or its death would not end the pipe

    def give(self, spec: Spec, doomed: Mapping[int, Death]) -> bool:
        """See `harness.runner.executor.Worker`."""
        try:
            self.connection.send((spec, dict(doomed)))
        except OSError:
            return False
        return True

    def answer(self) -> Done | Ended:
        """See `harness.runner.executor.Worker`."""
        try:
            answer = self.connection.recv() if self.connection.poll() else None
        except (EOFError, OSError):
            answer = None
        if answer is None:
            return Ended(self.kill(), last_call(self._black_box))
        if isinstance(answer, BaseException):
            raise answer
        return answer  # type: ignore[no-any-return]

    def kill(self) -> int | None:
        """End it at once, whatever it does; returns its exit code."""
        exit_code = end_process(self._process)
        self.connection.close()
        return exit_code

    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process.is_alive()

    def dismiss(self) -> None:
        """See `harness.runner.executor.Worker`."""
        self.connection.close()

    def wait(self) -> None:
        """See `harness.runner.executor.Worker`."""
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


class LocalExecutor:
    """Starts a process for each worker, when it is first needed."""

    where = ""

    def __init__(self, resolved: Resolved, folder: Path, n_workers: int) -> None:
        self._folder, self.n_workers = folder, n_workers
        self._own = TemporaryDirectory(prefix="harness-workers-")
        # As a file: what a pipe cannot hold is waited for until the new process has imported all that it needs.
        self._resolved = Path(self._own.name) / "resolved"
        self._resolved.write_bytes(pickle.dumps(resolved))
        self._numbers = count()

    def cpus(self) -> set[str]:
        """See `harness.runner.executor.Executor`: there are no other machines."""
        return set()

    def new_worker(self, n_there: int) -> WorkerProcess:  # noqa: ARG002 - as many as are asked for
        """See `harness.runner.executor.Executor`."""
        return WorkerProcess(self._resolved, self._folder, Path(self._own.name) / str(next(self._numbers)))

    def first_to_answer(self, busy: Sequence[WorkerProcess]) -> WorkerProcess:
        """See `harness.runner.executor.Executor`."""
        return first_to_answer(busy)

    def close(self) -> None:
        """See `harness.runner.executor.Executor`."""
        self._own.cleanup()
