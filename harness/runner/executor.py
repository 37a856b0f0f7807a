"""Where shards are run: a worker takes one after another, an executor makes workers.

Here they are processes of this machine, each at the end of a pipe of its own; `harness.runner.ray_executor` makes those
of a cluster. What is done with a worker that dies is the same for both, and stands in `harness.runner.shard_pool`.
"""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from multiprocessing.connection import wait
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Generic, Protocol, TypeVar

from harness.controllers.apart import LOOK_S, end_process, start_process
from harness.controllers.black_box import Call, Death, last_call
from harness.resolved import Resolved
from harness.runner.worker import Done, Spec, serve
from harness.spawning import spawn_context

CLOSING_S, CLOSING_LOOK_S = 10.0, 0.05
"""Time that a worker gets to release its controllers once all is done, and between two looks at it."""


@dataclass(frozen=True)
class Ended:
    """What is known of a worker that died on its shard.

    ``exit_code`` is None where it went with its machine; ``call`` is the controller's that it was in, if it was in one.
    """

    exit_code: int | None
    call: Call | None


class Worker(Protocol):
    """Runs one shard after another."""

    def give(self, spec: Spec, doomed: Mapping[int, Death]) -> bool:
        """Give it a shard to run, with the episodes known to end a process; False if it is dead."""
        ...

    def answer(self) -> Done | Ended:
        """The finished shard, of a worker that has answered; of one that has died, which needs no more care, why.

        Raises
        ------
        Exception
            Whatever running the shard has raised.
        """
        ...

    def kill(self) -> object:
        """End it at once, whatever it does."""
        ...

    def dismiss(self) -> None:
        """Tell an idle worker that nothing more comes: it releases its controllers."""
        ...

    def wait(self) -> None:
        """Give a dismissed worker a little time; then end it."""
        ...


AnyWorker = TypeVar("AnyWorker", bound=Worker)


class Executor(Protocol, Generic[AnyWorker]):
    """Makes workers, ``n_workers`` at most at a time."""

    n_workers: int
    where: str
    """Said of it where its work is shown; empty for this machine."""

    def cpus(self) -> set[str]:
        """Names of the processors of other machines that have worked: bits are promised for one family."""
        ...

    def new_worker(self, n_there: int) -> AnyWorker | None:
        """Another worker beside those that are there; None as long as none is ready."""
        ...

    def first_to_answer(self, busy: Sequence[AnyWorker]) -> AnyWorker | None:
        """Wait until one of the busy workers has answered or died; None when a new one has become ready instead."""
        ...

    def close(self) -> None:
        """Leave nothing behind, once all workers have ended."""
        ...


class WorkerProcess:
    """A process that runs one shard after another, at the end of a pipe of its own."""

    def __init__(self, resolved: Path, folder: Path, black_box: Path) -> None:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        self._black_box = black_box
        self.connection, theirs = spawn_context().Pipe()
        self._process = start_process(serve, theirs, resolved, folder, black_box)
        theirs.close()  # or its death would not end the pipe

    def give(self, spec: Spec, doomed: Mapping[int, Death]) -> bool:
        """See `Worker`."""
        try:
            self.connection.send((spec, dict(doomed)))
        except OSError:
            return False
        return True

    def answer(self) -> Done | Ended:
        """See `Worker`."""
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
        """See `Worker`."""
        self.connection.close()

    def wait(self) -> None:
        """See `Worker`."""
        until = time.monotonic() + CLOSING_S
        while self.is_alive() and time.monotonic() < until:  # a copy of it may keep open what join() waits for
            self._process.join(CLOSING_LOOK_S)
        self.kill()


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
        """See `Executor`: there are no other machines."""
        return set()

    def new_worker(self, n_there: int) -> WorkerProcess:  # noqa: ARG002 - as many as are asked for
        """See `Executor`."""
        return WorkerProcess(self._resolved, self._folder, Path(self._own.name) / str(next(self._numbers)))

    def first_to_answer(self, busy: Sequence[WorkerProcess]) -> WorkerProcess:
        """See `Executor`."""
        while True:
            dead = [worker for worker in busy if not worker.is_alive()]
            ready = wait([worker.connection for worker in busy], 0.0 if dead else LOOK_S)
            if found := [worker for worker in busy if worker.connection in ready] or dead:
                return found[0]

    def close(self) -> None:
        """See `Executor`."""
        self._own.cleanup()
