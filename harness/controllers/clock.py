"""Another clock in the place of that of Python: what hangs on the time of day shows itself, and where it reads it.

A test must not depend on when it runs, or on how fast. A vehicle that asks a clock does, yet does the same again if
that is a moment later: a controller that computes nothing within 10 ms of its last answer keeps its first answer in
every test. So tests are repeated by a clock that is a day later at every call. Modules may have kept Python's own
functions (``from time import monotonic``): the clock is there before the vehicle's are imported, in a fresh process.
"""

from __future__ import annotations

import datetime
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self, TypeAlias

from harness.campaign.python_files import NOT_THE_USERS
from harness.controllers.hosts import Guard

LATER_S = 90061.001001
"""A day and one each of its parts, down to a microsecond: all that a time is shown by changes, also its parity."""
HELD_S, LOOK_S = 1e9, 1e-6
_TRUE_DATETIME: TypeAlias = datetime.datetime
_READ = ("time", "monotonic", "perf_counter", "process_time", "thread_time")
_SHOWN = ("localtime", "gmtime", "ctime")
_LOADS = ("create_module", "exec_module")


class Clock:
    """Later by `LATER_S` at each call of a controller; or ``held``, but for 1 µs a look: two runs see the same."""

    def __init__(self, *, held: bool) -> None:
        self._held, self._n_calls, self._n_looks = held, Guard.n_calls, 0
        self.read_at: list[str] = []  # places in the user's code

    def function(self, name: str, read: Callable[[], float]) -> Callable[[], float]:
        """What stands for the function of this name, which is ``read``."""

        def now() -> float:
            self._note(name)
            if self._held:
                return HELD_S + LOOK_S * self._n_looks
            return read() + LATER_S * (Guard.n_calls - self._n_calls)

        return now

    def _note(self, name: str) -> None:
        self._n_looks += 1
        frame = sys._getframe(2)
        while frame.f_code.co_filename == __file__ and frame.f_back is not None:
            frame = frame.f_back
        file = frame.f_code.co_filename
        place = f"{name}, {Path(file).name}:{frame.f_lineno}"
        if not file.startswith((*NOT_THE_USERS, "<")) and place not in self.read_at:
            self.read_at.append(place)

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Put this clock in the place of what tells it in ``time``, ``datetime``, ``os`` and ``resource``."""
        true = SimpleNamespace(**vars(time))
        now = {name: self.function(f"time.{name}", getattr(true, name)) for name in _READ}
        gettime, times, usage = time.clock_gettime, os.times, resource.getrusage
        instead: dict[tuple[Any, str], Any] = {(time, name): function for name, function in now.items()}
        for name, function in now.items():
            instead[time, f"{name}_ns"] = lambda function=function: round(1e9 * function())
        for name in _SHOWN:
            show = getattr(true, name)
            instead[time, name] = lambda secs=None, show=show: show(now["time"]() if secs is None else secs)
        for name in _LOADS:
            instead[ExtensionFileLoader, name] = _by_true_datetime(getattr(ExtensionFileLoader, name))
        instead |= {
            (time, "clock_gettime"): lambda clock: self.function("time.clock_gettime", lambda: gettime(clock))(),
            (time, "clock_gettime_ns"): lambda clock: round(1e9 * time.clock_gettime(clock)),
            (time, "strftime"): lambda form, at=None: true.strftime(form, time.localtime() if at is None else at),
            (time, "asctime"): lambda at=None: true.asctime(time.localtime() if at is None else at),
            (os, "times"): lambda: os.times_result(self.function("os.times", each.__float__)() for each in times()),
            (resource, "getrusage"): lambda who: resource.struct_rusage(
                [*(self.function("resource.getrusage", each.__float__)() for each in usage(who)[:2]), *usage(who)[2:]]
            ),
            (datetime, "datetime"): _datetime(now["time"]),
        }
        replaced = {(place, name): getattr(place, name) for place, name in instead}
        try:
            for (place, name), function in instead.items():
                setattr(place, name, function)
            yield
        finally:
            for (place, name), function in replaced.items():
                setattr(place, name, function)


def _by_true_datetime(load: Callable[..., Any]) -> Callable[..., Any]:
    """Loads a compiled module (of pandas, say), which keeps Python's own class and how its objects lie in memory."""

    @wraps(load)
    def loaded(*arguments: Any) -> Any:
        shown, datetime.datetime = datetime.datetime, _TRUE_DATETIME  # type: ignore[misc]
        try:
            return load(*arguments)
        finally:
            datetime.datetime = shown  # type: ignore[misc]

    return loaded


def _datetime(now: Callable[[], float]) -> type[datetime.datetime]:
    """A `datetime.datetime` by another clock; every datetime counts as one of its kind, and every such class."""

    class Kind(type):
        def __instancecheck__(cls, instance: object) -> bool:
            return isinstance(instance, _TRUE_DATETIME)

        def __subclasscheck__(cls, subclass: type) -> bool:
            return issubclass(subclass, _TRUE_DATETIME)

    class Datetime(_TRUE_DATETIME, metaclass=Kind):
        @classmethod
        def now(cls, tz: datetime.tzinfo | None = None) -> Self:
            return cls.fromtimestamp(now(), tz)

        @classmethod
        def today(cls) -> Self:
            return cls.now()

        @classmethod
        def utcnow(cls) -> Self:
            return cls.now(datetime.UTC).replace(tzinfo=None)

    return Datetime
