"""A call of a user's code: noted in the black box, limited in time, and its faults put in words.

Whatever goes wrong, an exception, NaN, an answer outside of av.limits or one too late, ends the episode as failed, with
these words in its row; its controller is dropped (of a batch only the cells fail), and the run goes on until failed
tests exceed run.max_failed_share.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np

from harness.campaign.models import Limits
from harness.controllers.black_box import CLOSE, START, BlackBox
from harness.controllers.time_limit import TimeLimit


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
        self._limits = limits
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
        low, high = self._limits.min_acceleration_mps2, self._limits.max_acceleration_mps2
        if not low <= value <= high:
            return f"asked for {value:g} m/s2, outside of av.limits ({low:g} to {high:g})"
        return None
