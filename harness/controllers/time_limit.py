"""Time limits for calls into a user's code: an exception where Python runs, else the end of the process."""

from __future__ import annotations

import os
import signal
import threading
import time
from types import FrameType, TracebackType
from typing import ClassVar, Self

HUNG_EXIT_CODE = 75
"""Exit code of a worker whose controller could not be interrupted."""


class StepTimeoutError(BaseException):
    """A controller took longer than ``av.limits.step_time_s``.

    Not an `Exception`, so that ``except Exception`` in the user's code does not swallow it.
    """


class TimeLimit:
    """Limits each of the calls made inside the block; signals need the main thread, where workers run controllers.

    With ``may_exit`` a call that the exception does not end (compiled code, a bare ``except``) ends the process.

    Examples
    --------
    >>> with limit:
    ...     for controller in controllers:
    ...         limit.begin()
    ...         try:
    ...             controller.step(observation)
    ...         finally:
    ...             limit.end()
    """

    _current: ClassVar[TimeLimit | None] = None

    def __init__(self, seconds: float, *, may_exit: bool = False) -> None:
        self._seconds = seconds
        self._inside = False
        self._watchdog = _Watchdog(2.0 * seconds + 1.0) if may_exit else None

    def __enter__(self) -> Self:
        if TimeLimit._current is not self:  # the handler stays: installing it costs more than a controller's step
            signal.signal(signal.SIGALRM, self._interrupt)
            TimeLimit._current = self
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)

    def close(self) -> None:
        """Leave SIGALRM as it is by default."""
        if TimeLimit._current is self:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            TimeLimit._current = None

    def begin(self) -> None:
        """A call begins: its time starts to run."""
        if self._watchdog is not None:
            self._watchdog.since = time.monotonic()
        self._inside = True
        signal.setitimer(signal.ITIMER_REAL, self._seconds)

    def end(self) -> None:
        """The call is over; the timer itself is set again by the next one."""
        self._inside = False
        if self._watchdog is not None:
            self._watchdog.since = None

    def _interrupt(self, _signal: int, _frame: FrameType | None) -> None:
        if self._inside:  # the harness itself may take its time
            raise StepTimeoutError(f"no answer within {self._seconds:g} s (av.limits.step_time_s)")


class _Watchdog(threading.Thread):
    """Ends the process when a call outlasts the exception that should have ended it."""

    def __init__(self, seconds: float) -> None:
        super().__init__(name="controller watchdog", daemon=True)
        self.since: float | None = None
        self._seconds = seconds
        self.start()

    def run(self) -> None:
        while True:
            time.sleep(0.5)
            since = self.since
            if since is not None and time.monotonic() - since > self._seconds:
                os._exit(HUNG_EXIT_CODE)


def death_cause(exit_code: int | None, seconds: float) -> str:
    """Cause for the record of an episode whose controller took the worker process along."""
    if exit_code == HUNG_EXIT_CODE:
        return f"no answer within {seconds:g} s (av.limits.step_time_s), and the call could not be interrupted"
    return f"the controller ended the worker process (exit code {exit_code})"
