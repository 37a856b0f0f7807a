"""Hosts: what stands between the episode loop and a user's controller, and turns its faults into failed episodes.

The cause stands in the row (docs/controllers.md). A controller that failed is dropped; of a batch only the cells fail.
"""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable, Coroutine, Generator, Iterable
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import parent_process
from pathlib import Path
from time import monotonic
from traceback import walk_tb
from types import FrameType
from typing import Any, ClassVar, Self

import numpy as np

from harness.campaign.python_files import NOT_THE_USERS
from harness.campaign.vehicle import AutomatedVehicle, Limits
from harness.controllers.process_state import (
    CHANGED_MODES,
    FloatingPointModes,
    LastResort,
    OtherModules,
    closed_to_files,
)
from harness.controllers.protocol import (
    BatchController,
    BatchObservation,
    EpisodeStart,
    Neighbour,
    Observation,
    VehicleController,
)
from harness.errors import CampaignError
from harness.problems import did_you_mean
from harness.processes import CLOSED_PIPE_EXIT_CODE
from harness.random_stream import controller_random
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import FloatArray, IntArray, read_only

HUNG_EXIT_CODES = 74, 75
"""Exit codes of a worker whose controller could not be interrupted, in its constructor the latter."""

Failures = dict[int, str]
"""Cell → cause."""
BeforeTest = Callable[[int], str | None]
"""Called with each episode in which controllers are about to be asked; returns why they must not be, or None."""


def time_limit(limits: Limits, *, makes: bool) -> tuple[float, str]:
    """Seconds that a constructor, or any other call, may take, and the cause of failure where they are over."""
    key = "construction_time_s" if makes else "step_time_s"
    seconds: float = getattr(limits, key)
    return seconds, f"no answer within {seconds:g} s (av.limits.{key})"


def death_cause(exit_code: int | None, limits: Limits) -> str:
    """Cause for the record of an episode whose controller took the process along."""
    if exit_code in HUNG_EXIT_CODES:
        _, late = time_limit(limits, makes=exit_code == HUNG_EXIT_CODES[True])
        return f"{late}, and the call could not be interrupted"
    if exit_code == CLOSED_PIPE_EXIT_CODE:
        return "the controller closed file descriptors that are not its own (os.close, os.closerange)"
    return f"the controller ended the worker process (exit code {exit_code})"


LONGEST_CAUSE = 240
"""Characters: a message cuts its parts at `LONGEST_PART`, and at their end is the place."""


def cause_of(error: BaseException) -> str:
    """What an error says, in one line of UTF-8 for the record, with the place in the user's code.

    If it asks for a name that is not there, a similar one is suggested. Making the text runs the user's code.
    """
    try:
        text = f"{type(error).__name__}: {error}".rstrip(": ")
        origin = error.name if isinstance(error, ImportError) else type(error).__module__
        if str(origin).partition(".")[0] in ("traci", "libsumo"):  # not what stands for it here
            text = f"{text.rstrip('.')}. Use the traci that is handed in (docs/controllers.md), not the module"
        kind = type(error.obj) if isinstance(error, AttributeError) else object
        if isinstance(error, TypeError) and "tuple indices must be" in text:
            text += ". What is seen has fields: seen.gap_m, not seen['gap_m']"
        if isinstance(error, AttributeError) and str(kind.__module__).startswith("harness."):
            text += f". {did_you_mean(error.name, [name for name in dir(kind) if name[0] != '_'])}".rstrip(". ")
    except BaseException as again:  # noqa: BLE001 - whatever a user's code raises
        text = f"{type(error).__name__}, whose text raised {type(again).__name__}"
    line = text.encode("utf-8", "backslashreplace").decode().splitlines()[0]
    return (line if len(line) <= LONGEST_CAUSE else f"{line[:LONGEST_CAUSE]} …") + _place_of(error)


def _place_of(error: BaseException, *, own_files_alone: bool = False) -> str:
    """`` (my_av.py:12)``: the last line of the user's code on the way to an error; empty where there is none."""
    places = [(frame.f_code.co_filename, line) for frame, line in walk_tb(error.__traceback__)]
    theirs = [place for place in places if not place[0].startswith((*NOT_THE_USERS, "<"))]
    own_files = [place for place in theirs if place[0].endswith(".py") and "site-packages" not in place[0]]
    own_files = own_files or ([] if own_files_alone else theirs)
    return f" ({Path(own_files[-1][0]).name}:{own_files[-1][1]})" if own_files else ""


def require_ours(error: Exception) -> None:
    """Refuse (`CampaignError`) a vehicle whose code has raised an error between its calls, as by a signal's handler."""
    if _place_of(error, own_files_alone=True):
        found = f"a vehicle that raises between its calls: {cause_of(error)}"
        mend = "Leave no timer, handler of a signal or replaced function behind when a call returns."
        raise CampaignError("av.controller", found, "code that runs in its own calls alone", mend) from error


class StepTimeoutError(BaseException):
    """A controller took too long; no `Exception`, which an ``except Exception`` in the user's code would swallow."""


class Guard:
    """Makes the calls of a host's controllers, inside of ``with guard``, and limits the time of each.

    The limit is a signal, for the main thread. In a worker, a call that outlasts it (compiled code) ends the process.
    """

    _current: ClassVar[Guard | None] = None
    _last_resort: ClassVar[LastResort | None] = None
    n_calls: ClassVar[int] = 0
    """Of all controllers of this process."""

    def __init__(self, limits: Limits) -> None:
        self.low, self.high = limits.min_acceleration_mps2, limits.max_acceleration_mps2
        self._limits = [time_limit(limits, makes=makes) for makes in (False, True)]
        self._pid = os.getpid()
        self.modes, self._others = FloatingPointModes(), OtherModules()
        self.construction_s: list[float] = []
        """Time that each constructor took."""
        self._makes, self._since = False, math.nan
        """Of the call under way, and when it began; NaN between calls: the harness itself may take its time."""
        if parent_process() is not None and not Guard._last_resort:
            Guard._last_resort = LastResort(*HUNG_EXIT_CODES)

    def __enter__(self) -> Self:
        if Guard._current is not self:  # the handler stays: installing it costs more than a controller's step
            signal.signal(signal.SIGALRM, self._interrupt)
            Guard._current = self
        return self

    def __exit__(self, *_: object) -> None:
        self._since = math.nan
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        if self._last_resort:
            self._last_resort.end()

    def limit(self, *, makes: bool) -> None:
        """From now to the end of ``with guard``, or of the next call: `StepTimeoutError` when the time is over."""
        self._makes, self._since = makes, monotonic()
        signal.setitimer(signal.ITIMER_REAL, self._limits[makes][0])
        if self._last_resort:
            self._last_resort.begin(makes, 2.0 * self._limits[makes][0] + 1.0, self._since)

    def call(
        self,
        function: Callable[..., Any],
        *arguments: Any,
        check: Callable[[Any], tuple[Any, str | None]] | None = None,
        makes: bool = False,
    ) -> tuple[Any, str | None]:
        """What a call returns, and what went wrong, also in a ``check`` of it; one that ``makes`` may take longer."""
        Guard.n_calls += 1
        try:
            self.limit(makes=makes)
            answer = function(*arguments)
            if self.modes.restored():
                return answer, CHANGED_MODES
            return check(answer) if check else (answer, None)
        except BaseException as error:
            # Ctrl-C passes. Workers and other children ignore it: there even KeyboardInterrupt is the controller's own.
            if isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
                raise
            self.modes.restored()
            return None, cause_of(error)
        finally:
            if makes:
                self.construction_s.append(monotonic() - self._since)
            self._since = math.nan  # the timer itself is set again by the next call
            if os.getpid() != self._pid:  # a copy that the controller has made of the process
                os._exit(0)

    def require_untouched(self) -> None:
        """End timers; refuse (`CampaignError`) a vehicle that has replaced what the harness calls, or opens no file."""
        for timer in (signal.ITIMER_REAL, signal.ITIMER_VIRTUAL, signal.ITIMER_PROF):
            signal.setitimer(timer, 0.0)
        if replaced := self._others.restored():
            more = f" and {len(replaced) - 3} more" if len(replaced) > 3 else ""
            found = f"a vehicle that has replaced {', '.join(replaced[:3])}{more}, which the harness calls, too"
            mend = "Give your own function a name of its own, in your own module."
            raise CampaignError("av.controller", found, "modules of Python and numpy left as they are", mend)
        if why := closed_to_files():
            found, mend = f"a vehicle after which nobody can open a file ({why})", "Close what a step or a test opens."
            raise CampaignError("av.controller", found, "files that are closed again", mend)

    def close(self, controllers: Iterable[Any]) -> None:
        """Close controllers; what they raise is nobody's concern: they have failed before, or the run is over."""
        for controller in controllers:
            if controller is not None:
                self.call(optional("close"), controller)

    def end(self, controllers: Iterable[Any]) -> None:
        """Close the last controllers, and leave SIGALRM as it is by default."""
        with self:
            self.close(controllers)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        Guard._current = None

    def acceleration(self, answer: Any) -> tuple[float, str | None]:
        """An answer, or an array of one, as a number, and what is wrong with it: a subclass may compare as it likes."""
        if not isinstance(answer, float) and hasattr(answer, "__array__") and not np.ma.is_masked(answer):
            array = np.asarray(answer)
            answer = array.item() if array.size == 1 and array.dtype.kind in "iufO" else answer
        if not isinstance(answer, int | float | np.floating) or isinstance(answer, bool):
            what = "None (is a return missing?)" if answer is None else type(answer).__name__
            return math.nan, f"returned {what}, expected an acceleration in m/s2 as a number"
        value = float(answer)
        if not math.isfinite(value):
            return value, f"returned {value}, expected a finite acceleration in m/s2"
        if not self.low <= value <= self.high:
            return value, f"asked for {value:g} m/s2, outside of av.limits ({self.low:g} to {self.high:g})"
        return value, None

    def not_judged(self, answer: Any) -> tuple[float, None]:
        """An answer of the warm-up as a number, 0 if it is none; it serves only to say whether the AV brakes."""
        try:
            value = self.acceleration(answer)[0]
        except OverflowError:
            return 0.0, None
        return (value if -1e9 < value < 1e9 else 0.0), None

    def _interrupt(self, _signal: int, _frame: FrameType | None) -> None:
        if not math.isnan(self._since):
            raise StepTimeoutError(self._limits[self._makes][1])


def optional(name: str, *arguments: Any) -> Callable[[Any], None]:
    """Calls a controller's method of this name, if it has one."""

    def call(controller: Any) -> None:
        if isinstance(getattr(controller, name, lambda *_: None)(*arguments), Coroutine | Generator):
            raise TypeError(f"{name} is async, or yields: nothing of it was run")

    return call


@dataclass
class Host:
    """What both hosts have; ``names`` are those of the vehicles that controllers see as LV and BV."""

    av: AutomatedVehicle
    seed: int
    guard: Guard
    before_test: BeforeTest
    names: tuple[str, str] = field(default=("LV", "BV"), kw_only=True)

    def __post_init__(self) -> None:
        self.acts_before_event, self.warm_up_steps = self.av.acts_before_event, self.av.warm_up_steps
        self.cruises = self.av.takes_over == "first_braking"
        self.require_untouched, self.construction_s = self.guard.require_untouched, self.guard.construction_s


@dataclass
class VehicleHost(Host):
    """One controller object per cell, made by ``make``; the ``first``, if there is one already, is that of cell 0.

    ``told_at`` gives the place in the user's code where a controller's last answer comes from.
    """

    make: Callable[[], VehicleController]
    n_cells: int
    first: VehicleController | None = None
    told_at: Callable[[Any], str] = lambda _: ""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._controllers: list[VehicleController | None] = [self.first, *[None] * (self.n_cells - 1)]

    def start(self, cells: IntArray, episodes: IntArray, announced: IntArray, set_speed_mps: FloatArray) -> Failures:
        """Begin episodes, ``announced`` to their controllers under these indices; returns those that failed at once."""
        failures = {}
        begun = cells.tolist(), episodes.tolist(), announced.tolist(), set_speed_mps.tolist()
        for k, episode, index, set_speed in zip(*begun, strict=True):
            wrong = self.before_test(episode)  # may wait
            with self.guard:
                if wrong is None and self._controllers[k] is None:
                    self._controllers[k], wrong = self.guard.call(self.make, makes=True)
                if wrong is None:
                    start = EpisodeStart(index, STEP_S, controller_random(self.seed, index), set_speed, *self.names)
                    _, wrong = self.guard.call(optional("start", start), self._controllers[k])
                if wrong is not None:
                    failures[k] = f"start: {wrong}"
                    self._drop(k)
        return failures

    def act(self, observation: BatchObservation, *, warms_up: bool = False) -> tuple[FloatArray, Failures]:
        """Accelerations (m/s²), shape (n,), and the cells whose controller failed (their value is not used).

        One that ``warms_up`` is shown the past: what it answers is not used nor judged, what it raises counts.
        """
        answer, failures = np.zeros(observation.cell.size), dict[int, str]()
        call, check = self.guard.call, self.guard.not_judged if warms_up else self.guard.acceleration
        with self.guard:
            for i, (k, _, *seen) in enumerate(zip(*(column.tolist() for column in observation), strict=True)):
                if (controller := self._controllers[k]) is None:
                    continue  # its episode has failed in this turn's start
                value, wrong = call(_step, controller, seen, check=check)
                if wrong is not None:
                    place = "" if value is None else self.told_at(controller)  # of what is raised it is known
                    failures[k] = f"{'step, warming up' if warms_up else 'step'}: {wrong}{place}"
                    self._drop(k)
                else:
                    answer[i] = value
        return answer, failures

    def _drop(self, k: int) -> None:
        """A controller that failed is not used again: its next episode gets a new one."""
        controller, self._controllers[k] = self._controllers[k], None
        self.guard.close([controller])

    def close(self) -> None:
        """Release all controllers."""
        self.guard.end(self._controllers)
        self._controllers[:] = [None] * len(self._controllers)


def _step(controller: VehicleController, seen: list[Any]) -> Any:
    """Answer to a row of a `BatchObservation`, without cell and episode."""
    bv, lv = Neighbour._make(seen[6:9]), Neighbour._make(seen[9:12])
    return controller.step(Observation._make((*seen[:6], bv, lv, *seen[12:14], bool(seen[14]), *seen[15:])))


def _numbers(n: int, answer: Any) -> tuple[FloatArray | None, str | None]:
    """An answer as (n,) float64, also from (n, 1), and what is wrong with it: a cast would take texts, too."""
    array = np.ma.array(answer, object).filled(np.nan) if np.ma.is_masked(answer) else np.array(answer)
    array = array[:, 0] if array.shape == (n, 1) else array
    if array.shape != (n,):
        what = "None (is a return missing?)" if answer is None else f"{type(answer).__name__} of shape {array.shape}"
        return None, f"returned {what}, expected ({n},)"
    are_no_numbers = array.dtype == object and any(isinstance(value, str | bytes | np.timedelta64) for value in array)
    if array.dtype.kind not in "iufO" or are_no_numbers:
        return None, f"returned an array of {array.dtype}, expected accelerations in m/s2 as numbers"
    return array.astype(np.float64), None


@dataclass
class BatchHost(Host):
    """One controller object for all cells. A fault that is not one cell's alone fails all that were asked."""

    controller: BatchController

    def start(self, cells: IntArray, episodes: IntArray, announced: IntArray, _set_speed_mps: FloatArray) -> Failures:
        """As `VehicleHost.start`."""
        causes = [self.before_test(episode) for episode in episodes.tolist()]
        failures = {k: f"start: {cause}" for k, cause in zip(cells.tolist(), causes, strict=True) if cause is not None}
        to_start = np.array([cause is None for cause in causes])
        cells, announced = cells[to_start], announced[to_start]
        if not cells.size:
            return failures
        random = [controller_random(self.seed, i) for i in announced.tolist()]
        begin = optional("start_batch", read_only(cells), read_only(announced), random)
        with self.guard:
            _, wrong = self.guard.call(begin, self.controller)
        return failures if wrong is None else failures | dict.fromkeys(cells.tolist(), f"start_batch: {wrong}")

    def act(self, observation: BatchObservation, *, warms_up: bool = False) -> tuple[FloatArray, Failures]:
        """As `VehicleHost.act`."""
        n, cells = observation.cell.size, observation.cell

        def ask() -> Any:
            answer = self.controller.step_batch(observation)
            return np.zeros(n) if warms_up and _numbers(n, answer)[1] is not None else answer

        with self.guard:
            answer, wrong = self.guard.call(ask, check=partial(_numbers, n))
        if wrong is not None:
            call = "step_batch, warming up" if warms_up else "step_batch"
            return np.zeros(n), dict.fromkeys(cells.tolist(), f"{call}: {wrong}")
        if warms_up:
            return answer, {}
        outside = np.flatnonzero(~((answer >= self.guard.low) & (answer <= self.guard.high))).tolist()  # NaN is neither
        return answer, {int(cells[i]): f"step_batch: {self.guard.acceleration(answer[i])[1]}" for i in outside}

    def close(self) -> None:
        """As `VehicleHost.close`."""
        self.guard.end([self.controller])


ControllerHost = VehicleHost | BatchHost
