"""Where shards are run: a worker takes one after another, an executor makes workers.

`harness.runner.local_executor` makes processes of this machine, `harness.runner.ray_executor` those of a cluster. What
is done with a worker that dies is the same for both, and stands in `harness.runner.shard_pool`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from harness.controllers.black_box import Call, Death
from harness.runner.worker import Done, Spec

CLOSING_S = 10.0
"""Time that a worker gets to release its controllers once all is done."""


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
