"""A call of a user's code: what becomes of an exception, NaN, or an answer too late; a black box and a time limit.

Whatever goes wrong, also an answer outside of av.limits, ends the episode (`harness.episode.loop`) with the outcome
``failed``, these words in the column ``failure`` of its row, and the weight that it has so far. Its controller is
dropped (of a batch only the cells fail), and the run goes on until failed tests exceed run.max_failed_share
(`harness.runner.manifest.require_few_failed`). Rate and lower limit count it as no crash, upper limits as a crash
(`harness.estimators.estimate.FailureBounds`). A call that takes too long meets an exception where Python runs, else
the end of the process.
"""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections.abc import Callable
from operator import methodcaller
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from harness.campaign.vehicle import Limits
from harness.processes import CLOSE, START, BlackBox

HUNG_EXIT_CODE = 75
"""Exit code of a worker whose controller could not be interrupted."""


class Death(NamedTuple):
    """A call that is known to end the process: its step, or `START`, and the cause for the record."""

    step: int
    cause: str


def require_fault(error: BaseException) -> None:
    """Let Ctrl-C pass. Workers and other children ignore it: there even KeyboardInterrupt is the controller's own."""
    if isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        raise error


def cause_of(error: BaseException) -> str:
    """One line for the record."""
    return f"{type(error).__name__}: {error}".splitlines()[0][:500]


class Guard:
    """Makes the calls of a host's controllers, inside of ``with guard.time_limit``.

    The call under way is noted in the file ``black_box``, if any, so that the parent knows it should the process die.
    """

    def __init__(self, limits: Limits, black_box: Path | None) -> None:
        self.time_limit = TimeLimit(limits.step_time_s, may_exit=black_box is not None)
        self.limits = limits
        self._black_box = BlackBox(black_box)

    def call(
        self,
        kind: int,
        function: Callable[..., Any],
        *arguments: Any,
        episode: int = 0,
        step: int = START,
        check: Callable[[Any], str | None] | None = None,
    ) -> tuple[Any, str | None]:
        """What a call returns, and what went wrong; ``check`` looks at an answer under the same protection."""
        self._black_box.enter(kind, episode, step)
        self.time_limit.begin()
        try:
            answer = function(*arguments)
            return answer, self._black_box.misdeed() or (check(answer) if check else None)
        except BaseException as error:  # noqa: BLE001 - whatever a user's code raises is its episode's end
            require_fault(error)
            return None, cause_of(error)
        finally:
            self.time_limit.end()
            self._black_box.leave()

    def close(self, controller: Any) -> None:
        """Close a controller; what it raises is nobody's concern: it has failed before, or the run is over."""
        if controller is not None:
            self.call(CLOSE, methodcaller("close"), controller)

    def wrong_answer(self, value: Any) -> str | None:
        """What is wrong with an acceleration, or None."""
        if not isinstance(value, int | float | np.floating | np.integer) or isinstance(value, bool):
            return f"returned {type(value).__name__}, expected an acceleration in m/s2 as a number"
        if not math.isfinite(value):
            return f"returned {value}, expected a finite acceleration in m/s2"
        low, high = self.limits.min_acceleration_mps2, self.limits.max_acceleration_mps2
        if not low <= value <= high:
            return f"asked for {value:g} m/s2, outside of av.limits ({low:g} to {high:g})"
        return None


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
        self._since: float | None = None
        """When the call under way began, None between calls: the harness itself may take its time."""
        if may_exit:
            threading.Thread(target=self._watch, name="controller watchdog", daemon=True).start()

    def __enter__(self) -> Self:
        if TimeLimit._current is not self:  # the handler stays: installing it costs more than a controller's step
            signal.signal(signal.SIGALRM, self._interrupt)
            TimeLimit._current = self
        return self

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)

    def close(self) -> None:
        """Leave SIGALRM as it is by default."""
        if TimeLimit._current is self:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            TimeLimit._current = None

    def begin(self) -> None:
        """A call begins: its time starts to run."""
        self._since = time.monotonic()
        signal.setitimer(signal.ITIMER_REAL, self._seconds)

    def end(self) -> None:
        """The call is over; the timer itself is set again by the next one."""
        self._since = None

    def _interrupt(self, _signal: int, _frame: FrameType | None) -> None:
        if self._since is not None:
            raise StepTimeoutError(f"no answer within {self._seconds:g} s (av.limits.step_time_s)")

    def _watch(self) -> None:
        """End the process when a call outlasts the exception that should have ended it."""
        while True:
            time.sleep(0.5)
            since = self._since
            if since is not None and time.monotonic() - since > 2.0 * self._seconds + 1.0:
                os._exit(HUNG_EXIT_CODE)


def death_cause(exit_code: int | None, seconds: float) -> str:
    """Cause for the record of an episode whose controller took the worker process along."""
    if exit_code == HUNG_EXIT_CODE:
        return f"no answer within {seconds:g} s (av.limits.step_time_s), and the call could not be interrupted"
    return f"the controller ended the worker process (exit code {exit_code})"
