"""Ctrl-C that cannot get lost."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def remembered_interrupt() -> Iterator[Callable[[], None]]:
    """Remember Ctrl-C; yields a function that raises KeyboardInterrupt if there has been one.

    Python raises KeyboardInterrupt wherever the main thread happens to be. In a finaliser or in the callback of a weak
    reference, which imports in another thread bring about, it is printed and forgotten, and the run would go on.
    """
    seen = threading.Event()
    before = signal.getsignal(signal.SIGINT)

    def note(signal_number: int, frame: FrameType | None) -> None:
        seen.set()
        if callable(before):
            before(signal_number, frame)

    def check() -> None:
        if seen.is_set():
            raise KeyboardInterrupt

    # Only the main thread may set handlers, and what ignores the signal is to go on doing so.
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield check
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
