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
"""Of what a process prints first, and of what it prints last, that is passed on."""
_LOOK_S = 0.5
"""Time between two looks at whether the process has ended."""


class Kept:
    """What processes have printed: the first and last 64 kB of each, and how many lines in all."""

    def __init__(self) -> None:
        self.text, self.n_lines, self._lock = bytearray(), 0, threading.Lock()

    def add(self, text: bytes, n_lines: int) -> None:
        """Text of one of them, which stands for so many lines."""
        with self._lock:
            self.text += text
            self.n_lines += n_lines


class Printed:
    """What a process prints: its first 64 kB pass on at once, its last 64 kB in the end, no more of it.

    They go to stderr, or are ``kept``. The process writes to the ``pipe``, which is to be closed here once it has it.
    """

    kept: ClassVar[Kept | None] = None
    """By what begins meanwhile."""

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
        left, last, n_lost = PRINTED_BYTES, bytearray(), 0
        while chunk := self._next():
            first, rest = chunk[:left], chunk[left:]
            left -= len(first)
            last += rest
            n_lost += max(0, len(last) - PRINTED_BYTES)
            del last[:-PRINTED_BYTES]
            self._to_others(first, chunk.count(b"\n"))
        self._read.close()
        self._to_others(f"\n[{n_lost:,} bytes more that a worker has printed]\n".encode() * bool(n_lost) + last, 0)

    def _next(self) -> bytes:
        """What it has printed since; nothing once all is told."""
        while not wait([self._read], _LOOK_S):
            if self._is_over.is_set():
                return b""
        return os.read(self._read.fileno(), PRINTED_BYTES)


def _to_stderr(text: bytes, _n_lines: int) -> None:
    with suppress(OSError), open(2, "wb", closefd=False) as stderr:
        stderr.write(text)
