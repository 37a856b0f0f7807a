"""Signals to a command: Ctrl-C, SIGTERM and SIGHUP end it in the same way, and what is finished is kept.

What the shell has set to be ignored stays ignored: SIGHUP under ``nohup``, SIGINT in the background of a script.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from types import FrameType
from typing import Any

from harness.progress import Progress

FROM_USER = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_LEFT_TO_US = (signal.SIG_DFL, signal.default_int_handler)
"""How Python begins: nobody else has asked for the signal."""


class Interruption:
    """The signal that has asked for the end, if any; it raises KeyboardInterrupt, so that every ``finally`` runs."""

    signal: signal.Signals | None = None

    @property
    def exit_code(self) -> int:
        """128 and the number of the signal, as shells have it: 130, 143 or 129."""
        return 128 + (self.signal or signal.SIGINT)

    def arrive(self, number: int, _frame: FrameType | None) -> None:
        """Handle the signal. A second Ctrl-C interrupts what is tidied up; other signals are ignored from now on."""
        for further in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(further, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.signal = signal.Signals(number)
        Progress.cancelled = True  # a library may lose what is raised here: then the next report raises it again
        raise KeyboardInterrupt(self.signal.name)


@contextmanager
def handlers_restored() -> Iterator[dict[signal.Signals, Any]]:
    """Restore the handlers of `FROM_USER` afterwards; yields them, or none outside of the main thread."""
    may_set = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in FROM_USER if may_set}
    try:
        yield before
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay signals until the block has ended: a file and the record of it are to be written together."""
    came: list[tuple[int, FrameType | None]] = []
    with handlers_restored() as before:
        for number, handler in before.items():
            if callable(handler):
                signal.signal(number, lambda number, frame: came.append((number, frame)))
        yield
    for arrived, frame in came[:1]:
        before[signal.Signals(arrived)](arrived, frame)


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Let signals interrupt what is inside."""
    interruption = Interruption()
    with handlers_restored() as before:
        for number, handler in before.items():
            if handler in _LEFT_TO_US:
                signal.signal(number, interruption.arrive)
        try:
            yield interruption
        finally:
            Progress.cancelled = False


def open_streams() -> None:
    """Open those of the three standard streams that the shell has closed: else a file would take their numbers."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115, PTH123
        elif name != "stdin" and isinstance(stream := getattr(sys, name), TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal may not have × and superscripts
