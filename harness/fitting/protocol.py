"""What a family brings that is fitted to trajectories: it observes recordings one by one, then says what it found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from harness.files import content_hash
from harness.fitting.recording import Recording
from harness.fitting.table import Mapping as Columns
from harness.progress import Progress


class FitRequest(NamedTuple):
    """What is fitted: ``files`` read by a mapping, to a file ``out`` and ``n_replicates`` drawn by the ``seed``."""

    files: Sequence[Path]
    mapping: str | None
    read: Columns
    out: Path
    n_replicates: int
    seed: int
    progress: Progress

    def provenance(self) -> list[str]:
        """What was read, and how: lines of a file's head."""
        return [
            f"mapping: {self.mapping or 'that of the input table'}{', mirrored' if self.read.mirror else ''}",
            *(f"left out: {name}" for name in self.read.leave_out),
            *(f"sha256 {content_hash(file.read_bytes())} {file.name}" for file in self.files),
        ]


class Fitted(NamedTuple):
    """What a family has found: ``files`` to write, the environment's first, and what a terminal and JSON say of it."""

    files: Mapping[Path, bytes]
    told: tuple[str, ...]
    facts: Mapping[str, Any]


class Fitter(Protocol):
    """A fit that is under way; `fitter` of a family makes one, if its traffic can be fitted."""

    def marks(self, out: Path) -> Mapping[Path, bytes]:
        """Files that it will write beside ``out``, each with what marks one that a fit has written."""

    def observe(self, recording: Recording) -> None:
        """Keep what it needs of a recording."""

    def fitted(self, request: FitRequest, others: Mapping[str, Fitted]) -> Fitted:
        """What was found, or a `TrajectoryError`; ``others`` are families that come after it, for its page."""
