"""What a step is made in: its folder, what the study asks for, and the steps made before it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from harness.progress import Progress
from studies.work import kept_parts, worker_processes


class Made(NamedTuple):
    """A finished step: its folder, and the content of its ``result.json``."""

    folder: Path
    result: dict[str, Any]


@dataclass(frozen=True)
class Context:
    """Where and how a step is made.

    The folder is the step's own: what it finds there it has left itself when it was killed. Required numbers of tests
    are for ``rhw`` at a ``confidence``; ``made`` are the steps made before, by name. Without ``workers`` there is one
    for each core.
    """

    folder: Path
    rhw: float
    confidence: float
    made: Mapping[str, Made]
    workers: int | None
    progress: Progress

    @property
    def name(self) -> str:
        """The step's, which its folder's begins with."""
        return self.folder.name.rpartition("-")[0]

    @property
    def parts(self) -> Path:
        """Where what is finished is kept until the step is."""
        return self.folder / "parts"

    def by_workers(
        self, jobs: Sequence[Any], make: Callable[[Any], pa.Table], size: Callable[[Any], int] = lambda _job: 1
    ) -> list[pa.Table]:
        """Tables of all jobs, made by worker processes; see `kept_parts`."""
        with worker_processes(self.workers) as executor:
            return kept_parts(self.parts, self.name, jobs, make, self.progress, run=executor.map, size=size)
