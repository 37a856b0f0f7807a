"""Hosts: what stands between the episode loop and a user's controller, and turns its faults into failed episodes."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from harness.arrays import FloatArray, IntArray, read_only
from harness.campaign.models import Limits
from harness.controllers.black_box import (
    CLOSE,
    CONSTRUCTOR,
    OF_EPISODE,
    START,
    START_BATCH,
    STEP_BATCH,
    BlackBox,
    Death,
)
from harness.controllers.protocol import (
    BatchController,
    BatchObservation,
    EpisodeStart,
    Neighbour,
    Observation,
    VehicleController,
)
from harness.controllers.time_limit import TimeLimit
from harness.random_stream import AV_DRAWS
from harness.vehicles.kinematics import STEP_S

Failures = dict[int, str]
"""Cell → cause."""


class ControllerHost(Protocol):
    """What the episode loop calls: an AV controller outside of the kernels."""

    acts_before_cut_in: bool

    def start(self, cells: IntArray, episodes: IntArray) -> Failures:
        """Begin episodes; returns those that failed at once."""

    def act(self, observation: BatchObservation) -> tuple[FloatArray, Failures]:
        """Accelerations (m/s²), shape (n,), and the cells whose controller failed (their value is not used)."""

    def close(self) -> None:
        """Release all controllers."""


def require_fault(error: BaseException) -> None:
    """Let Ctrl-C pass. Workers and other children ignore it: there even KeyboardInterrupt is the controller's own."""
    if isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        raise error


def cause_of(error: BaseException) -> str:
    """One line for the record."""
    return f"{type(error).__name__}: {error}".splitlines()[0][:500]


def wrong_answer(value: Any, limits: Limits) -> str | None:
    """What is wrong with an acceleration, or None."""
    if not isinstance(value, int | float | np.floating | np.integer) or isinstance(value, bool):
        return f"returned {type(value).__name__}, expected an acceleration in m/s2 as a number"
    if not math.isfinite(value):
        return f"returned {value}, expected a finite acceleration in m/s2"
    if not limits.min_acceleration_mps2 <= value <= limits.max_acceleration_mps2:
        return (
            f"asked for {value:g} m/s2, outside of av.limits "
            f"({limits.min_acceleration_mps2:g} to {limits.max_acceleration_mps2:g})"
        )
    return None


def episode_random(seed: int, episode: int) -> np.random.Generator:
    """The controller's own random numbers: another stream of the same counter-based generator."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, episode, AV_DRAWS, 0]))


class EpisodeRandom(Sequence[np.random.Generator]):
    """`episode_random` of several episodes, made when they are asked for: most controllers want none."""

    def __init__(self, seed: int, episodes: list[int]) -> None:
        self._seed, self._episodes = seed, episodes
        self._made: dict[int, np.random.Generator] = {}

    def __len__(self) -> int:
        return len(self._episodes)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[j] for j in range(len(self))[i]]
        episode = self._episodes[i]
        if episode not in self._made:
            self._made[episode] = episode_random(self._seed, episode)
        return self._made[episode]


class VehicleHost:
    """One controller object per cell.

    Parameters
    ----------
    make : callable
        Makes a controller.
    n_cells, seed : int
    limits : Limits
    black_box : Path, optional
        File where the call that is under way is noted, so that the parent knows it should the process die.
    doomed : mapping, optional
        Episodes that are known to kill the process: they fail just before the call that did. It may grow.
    acts_before_cut_in : bool
    """

    def __init__(
        self,
        make: Callable[[], VehicleController],
        n_cells: int,
        seed: int,
        limits: Limits,
        *,
        black_box: Path | None = None,
        doomed: Mapping[int, Death] | None = None,
        acts_before_cut_in: bool = False,
    ) -> None:
        self.acts_before_cut_in = acts_before_cut_in
        self._make = make
        self._controllers: list[VehicleController | None] = [None] * n_cells
        self._seed = seed
        self._limits = limits
        self._black_box = BlackBox(black_box)
        self._time_limit = TimeLimit(limits.step_time_s, may_exit=black_box is not None)
        self._doomed = {} if doomed is None else doomed

    def start(self, cells: IntArray, episodes: IntArray) -> Failures:
        """See `ControllerHost`."""
        failures = {}
        with self._time_limit:
            for k, episode in zip(cells.tolist(), episodes.tolist(), strict=True):
                wrong = self._known_death(episode, START) or self._start(k, episode)
                if wrong is not None:
                    failures[k] = f"start: {wrong}"
                    self._forget(k)
        return failures

    def _start(self, k: int, episode: int) -> str | None:
        random = episode_random(self._seed, episode)
        self._black_box.enter(OF_EPISODE, episode, START)
        self._time_limit.begin()
        try:
            controller = self._controllers[k] or self._make()
            self._controllers[k] = controller
            controller.start(EpisodeStart(episode, STEP_S, random))
        except BaseException as error:  # noqa: BLE001 - whatever a user's code raises is its episode's end
            require_fault(error)
            return cause_of(error)
        finally:
            self._time_limit.end()
            self._black_box.leave()
        return self._black_box.misdeed()

    def act(self, observation: BatchObservation) -> tuple[FloatArray, Failures]:
        """See `ControllerHost`."""
        answer = np.zeros(observation.cell.size)
        failures = {}
        rows = zip(*(column.tolist() for column in observation), strict=True)
        with self._time_limit:
            for i, (k, episode, *seen) in enumerate(rows):
                controller = self._controllers[k]
                if controller is None:
                    continue  # its episode has failed in this turn's start
                wrong: str | None = self._known_death(episode, round(seen[0] / STEP_S))
                if wrong is None:
                    value, wrong = self._step(controller, episode, seen)
                if wrong is None:
                    answer[i] = value
                else:
                    failures[k] = f"step: {wrong}"
                    self._forget(k)
        return answer, failures

    def _step(self, controller: VehicleController, episode: int, seen: list[Any]) -> tuple[float, str | None]:
        """Answer of a controller, and what is wrong with it."""
        self._black_box.enter(OF_EPISODE, episode, round(seen[0] / STEP_S))
        self._time_limit.begin()
        try:
            value = controller.step(_observation(*seen))
            return value, self._black_box.misdeed() or wrong_answer(value, self._limits)
        except BaseException as error:  # noqa: BLE001 - as in _start
            require_fault(error)
            return 0.0, cause_of(error)
        finally:
            self._time_limit.end()
            self._black_box.leave()

    def _known_death(self, episode: int, step: int) -> str | None:
        death = self._doomed.get(episode)
        return death.cause if death is not None and step >= death.step else None

    def _forget(self, k: int) -> None:
        """A controller that failed is not used again: its next episode gets a new one."""
        controller, self._controllers[k] = self._controllers[k], None
        _close_quietly(controller, self._time_limit, self._black_box)

    def close(self) -> None:
        """See `ControllerHost`."""
        with self._time_limit:
            for k in range(len(self._controllers)):
                self._forget(k)
        self._time_limit.close()


def made(make: Callable[[], Any], black_box: BlackBox) -> Any:
    """A new controller.

    Raises
    ------
    Exception
        Whatever its constructor raises, as an `Exception`.
    """
    black_box.enter(CONSTRUCTOR)
    try:
        controller = make()
    except Exception:
        raise
    except BaseException as error:
        require_fault(error)
        raise RuntimeError(cause_of(error)) from error
    finally:
        black_box.leave()
    if (misdeed := black_box.misdeed()) is not None:
        raise RuntimeError(misdeed)
    return controller


def _close_quietly(
    controller: VehicleController | BatchController | None, limit: TimeLimit, black_box: BlackBox
) -> None:
    if controller is None:
        return
    black_box.enter(CLOSE)
    limit.begin()
    try:
        controller.close()
    except BaseException as error:  # noqa: BLE001 - it has already failed, or the run is over
        require_fault(error)
    finally:
        limit.end()
        black_box.leave()


def _observation(
    time_s: float,
    position_m: float,
    speed_mps: float,
    acceleration_mps2: float,
    gap_m: float,
    lead_speed_mps: float,
    bv_position_m: float,
    bv_speed_mps: float,
    bv_lane: int,
    lv_position_m: float,
    lv_speed_mps: float,
) -> Observation:
    return Observation(
        time_s,
        position_m,
        speed_mps,
        acceleration_mps2,
        gap_m,
        lead_speed_mps,
        Neighbour(bv_position_m, bv_speed_mps, bv_lane),
        Neighbour(lv_position_m, lv_speed_mps, 1),
    )


class BatchHost:
    """One controller object for all cells. A fault that cannot be laid at one cell's door fails all that were asked."""

    def __init__(
        self,
        controller: BatchController,
        seed: int,
        limits: Limits,
        *,
        black_box: Path | None = None,
        acts_before_cut_in: bool = False,
    ) -> None:
        self.acts_before_cut_in = acts_before_cut_in
        self._controller = controller
        self._seed = seed
        self._limits = limits
        self._black_box = BlackBox(black_box)
        self._time_limit = TimeLimit(limits.step_time_s, may_exit=black_box is not None)

    def start(self, cells: IntArray, episodes: IntArray) -> Failures:
        """See `ControllerHost`."""
        random = EpisodeRandom(self._seed, episodes.tolist())
        given = read_only(cells.copy()), read_only(episodes.copy())
        _, wrong = self._call(START_BATCH, lambda: self._controller.start_batch(*given, random))
        return {} if wrong is None else dict.fromkeys(cells.tolist(), f"start_batch: {wrong}")

    def act(self, observation: BatchObservation) -> tuple[FloatArray, Failures]:
        """See `ControllerHost`."""
        n, cells = observation.cell.size, observation.cell
        answer, wrong = self._call(
            STEP_BATCH, lambda: np.array(self._controller.step_batch(observation), dtype=np.float64)
        )
        if wrong is None and answer.shape != (n,):
            wrong = f"returned an array of shape {answer.shape}, expected ({n},)"
        if wrong is not None:
            return np.zeros(n), dict.fromkeys(cells.tolist(), f"step_batch: {wrong}")
        low, high = self._limits.min_acceleration_mps2, self._limits.max_acceleration_mps2
        if n == 0 or low <= answer.min() <= answer.max() <= high:  # false with NaN
            return answer, {}
        failures = {}
        for i in np.flatnonzero(~((answer >= low) & (answer <= high))):  # NaN is neither
            failures[int(cells[i])] = f"step_batch: {wrong_answer(float(answer[i]), self._limits)}"
        return answer, failures

    def _call(self, kind: int, call: Callable[[], Any]) -> tuple[Any, str | None]:
        """What a call of the controller returns, and what went wrong."""
        with self._time_limit:
            self._black_box.enter(kind)
            self._time_limit.begin()
            try:
                return call(), self._black_box.misdeed()
            except BaseException as error:  # noqa: BLE001 - as of a `VehicleHost`
                require_fault(error)
                return None, cause_of(error)
            finally:
                self._time_limit.end()
                self._black_box.leave()

    def close(self) -> None:
        """See `ControllerHost`."""
        with self._time_limit:
            _close_quietly(self._controller, self._time_limit, self._black_box)
        self._time_limit.close()
