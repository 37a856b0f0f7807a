"""What worker processes print: it is no result, and may be much."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import wait
from typing import ClassVar

PRINTED = "printed.txt"
"""What processes have printed, in a run folder."""
PRINTED_BYTES = 65_536
"""Bytes of what a process prints first, and again of what it prints last, that are passed on."""
_LOOK_S = 0.5
"""Time between two looks at whether the process has ended."""


class Kept:
    """What processes have printed: the first and last 64 kB of each, and how many lines in all."""

    def __init__(self) -> None:
        self.text, self.n_lines, self._lock = bytearray(), 0, threading.Lock()

    def add(self, text: bytes, n_lines: int) -> None:
        """Add text of one process, which printed ``n_lines`` lines in all."""
        with self._lock:
            self.text += text
            self.n_lines += n_lines


class Printed:
    """What a process prints: passes on its first 64 kB at once, its last 64 kB at the end, and drops the rest.

    It goes to stderr, or into ``kept``. The process writes to the ``pipe``, to be closed here after it is handed over.
    """

    kept: ClassVar[Kept | None] = None
    """Where the output of processes goes that begin while it is set."""

    def __init__(self) -> None:
        self._to_others = _to_stderr if self.kept is None else self.kept.add
        self._read, self.pipe = Pipe(duplex=False)
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._pass_on, name="printed", daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Pass on the rest: the process has ended, if perhaps not all that it has started."""
        self._is_over.set()
        self._thread.join()

    def _pass_on(self) -> None:
        room = PRINTED_BYTES
        last, n_lost = bytearray(), 0
        while chunk := self._next():
            first, rest = chunk[:room], chunk[room:]
            room -= len(first)
            last += rest
            n_lost += max(0, len(last) - PRINTED_BYTES)
            del last[:-PRINTED_BYTES]
            self._to_others(first, chunk.count(b"\n"))
        self._read.close()
        self._to_others(f"\n[{n_lost:,} bytes more that a worker has printed]\n".encode() * bool(n_lost) + last, 0)

    def _next(self) -> bytes:
        """What the process has printed since the last call; empty at the end."""
        while not wait([self._read], _LOOK_S):
            if self._is_over.is_set():
                return b""
        return os.read(self._read.fileno(), PRINTED_BYTES)


def _to_stderr(text: bytes, _n_lines: int) -> None:
    with suppress(OSError), open(2, "wb", closefd=False) as stderr:
        stderr.write(text)
