"""Ctrl-C, SIGTERM and SIGHUP end a command in the same way: what is finished is kept, and workers end with it.

A signal raises `Interrupted` where the main thread is, so that every ``finally`` on the way does its work. What the
shell has set to be ignored stays ignored: SIGHUP under ``nohup``, SIGINT in the background of a script.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

FROM_USER = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
FROM_TERMINAL = (signal.SIGINT, signal.SIGHUP)
"""What a terminal sends to all processes of a command at once."""
_LEFT_TO_US = (signal.SIG_DFL, signal.default_int_handler)


class Interrupted(KeyboardInterrupt):
    """A signal asks for the end."""


class Interruption:
    """Which signal has asked for the end, if one has."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    @property
    def exit_code(self) -> int:
        """128 and the number of the signal, as shells have it: 130, 143 or 129."""
        return 128 + (self.signal or signal.SIGINT)

    def arrive(self, number: int, _frame: FrameType | None) -> None:
        """Handle the signal: only Ctrl-C may ask again, for somebody who cannot wait until all is tidied up."""
        for other in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(other, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.signal = signal.Signals(number)
        raise Interrupted(self.signal.name)


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Let signals interrupt what is inside; their handlers are put back after it."""
    interruption = Interruption()
    before = {}
    if threading.current_thread() is threading.main_thread():  # no other thread may set handlers
        before = {number: signal.getsignal(number) for number in FROM_USER}
    for number, handler in before.items():
        if handler in _LEFT_TO_US:
            signal.signal(number, interruption.arrive)
    try:
        yield interruption
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def leave_signals_to_parent() -> None:
    """Let this worker ignore what a terminal sends to all: its parent alone answers, and ends it."""
    for number in FROM_TERMINAL:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, FROM_TERMINAL)  # held back while the process started
