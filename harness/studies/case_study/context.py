"""What a step is made in: its folder, what the study asks for, and the steps made before it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from harness.progress import Progress


class Made(NamedTuple):
    """A finished step: its folder, and the content of its ``result.json``."""

    folder: Path
    result: dict[str, Any]


@dataclass(frozen=True)
class Context:
    """Where and how a step is made.

    Attributes
    ----------
    folder : Path
        The step's own; what it finds there it has left itself when it was killed.
    rhw, confidence : float
        What required numbers of tests are for.
    made : mapping
        Steps made before, by name.
    workers : int or None
        Processes; None for one per core.
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
