"""Hosts: what stands between the episode loop and a user's controller, and turns its faults into failed episodes.

The episode loop calls `start`, `act` and `close`, and knows nothing else of a controller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from harness.controllers.guard import Death, Guard
from harness.controllers.protocol import (
    BatchController,
    BatchObservation,
    EpisodeStart,
    Neighbour,
    Observation,
    VehicleController,
)
from harness.processes import OF_EPISODE, START, START_BATCH, STEP_BATCH
from harness.random_stream import AV_DRAWS
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import FloatArray, IntArray, read_only

Failures = dict[int, str]
"""Cell → cause."""


def episode_random(seed: int, episode: int) -> np.random.Generator:
    """The controller's own random numbers: another stream of the same counter-based generator."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, episode, AV_DRAWS, 0]))


class EpisodeRandom(Sequence[np.random.Generator]):
    """`episode_random` of several episodes, made when they are asked for: most controllers want none.

    Each place has a generator of its own: tests of one shadow run, which are told the same index, may begin together.
    """

    def __init__(self, seed: int, episodes: list[int]) -> None:
        self._seed, self._episodes = seed, episodes
        self._made: dict[int, np.random.Generator] = {}

    def __len__(self) -> int:
        return len(self._episodes)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[j] for j in range(len(self))[i]]
        place = range(len(self))[i]
        if place not in self._made:
            self._made[place] = episode_random(self._seed, self._episodes[place])
        return self._made[place]


class VehicleHost:
    """One controller object per cell, made by ``make``.

    ``fatal_episodes`` are known to kill the process: they fail just before the call that did. They may become more.
    """

    def __init__(
        self,
        make: Callable[[], VehicleController],
        n_cells: int,
        seed: int,
        guard: Guard,
        *,
        fatal_episodes: Mapping[int, Death] | None = None,
        acts_before_cut_in: bool = False,
    ) -> None:
        self.acts_before_cut_in = acts_before_cut_in
        self._make = make
        self._controllers: list[VehicleController | None] = [None] * n_cells
        self._episodes = [-1] * n_cells
        self._seed = seed
        self._guard = guard
        self._fatal_episodes = {} if fatal_episodes is None else fatal_episodes

    def start(self, cells: IntArray, episodes: IntArray, told: IntArray) -> Failures:
        """Begin episodes, each under the index that its controller is ``told``; returns those that failed at once."""
        failures = {}
        with self._guard.time_limit:
            for k, episode, index in zip(cells.tolist(), episodes.tolist(), told.tolist(), strict=True):
                self._episodes[k] = episode
                wrong = self._known_death(episode, START)
                if wrong is None:
                    start = EpisodeStart(index, STEP_S, episode_random(self._seed, index))
                    _, wrong = self._guard.call(OF_EPISODE, self._start, k, start, episode=episode)
                if wrong is not None:
                    failures[k] = f"start: {wrong}"
                    self._forget(k)
        return failures

    def _start(self, k: int, start: EpisodeStart) -> None:
        controller = self._controllers[k] or self._make()
        self._controllers[k] = controller
        controller.start(start)

    def act(self, observation: BatchObservation) -> tuple[FloatArray, Failures]:
        """Accelerations (m/s²), shape (n,), and the cells whose controller failed (their value is not used)."""
        answer = np.zeros(observation.cell.size)
        failures = {}
        rows = zip(*(column.tolist() for column in observation), strict=True)
        call, check = self._guard.call, self._guard.wrong_answer
        with self._guard.time_limit:
            for i, (k, _, *seen) in enumerate(rows):
                controller, episode = self._controllers[k], self._episodes[k]
                if controller is None:
                    continue  # its episode has failed in this turn's start
                step = round(seen[0] / STEP_S)
                wrong = self._known_death(episode, step)
                if wrong is None:
                    value, wrong = call(OF_EPISODE, _step, controller, seen, episode=episode, step=step, check=check)
                if wrong is None:
                    answer[i] = value
                else:
                    failures[k] = f"step: {wrong}"
                    self._forget(k)
        return answer, failures

    def _known_death(self, episode: int, step: int) -> str | None:
        death = self._fatal_episodes.get(episode)
        return death.cause if death is not None and step >= death.step else None

    def _forget(self, k: int) -> None:
        """A controller that failed is not used again: its next episode gets a new one."""
        controller, self._controllers[k] = self._controllers[k], None
        self._guard.close(controller)

    def close(self) -> None:
        """Release all controllers."""
        with self._guard.time_limit:
            for k in range(len(self._controllers)):
                self._forget(k)
        self._guard.time_limit.close()


def _step(controller: VehicleController, seen: list[Any]) -> Any:
    """Answer to a row of a `BatchObservation`, without cell and episode."""
    *row, bv_position_m, bv_speed_mps, bv_lane, lv_position_m, lv_speed_mps, lateral_m, lateral_mps, overlaps = seen
    row += [Neighbour(bv_position_m, bv_speed_mps, bv_lane), Neighbour(lv_position_m, lv_speed_mps, 1)]
    row += [lateral_m, lateral_mps, bool(overlaps)]
    return controller.step(Observation(*row))


class BatchHost:
    """One controller object for all cells. A fault that cannot be laid at one cell's door fails all that were asked."""

    def __init__(
        self, controller: BatchController, seed: int, guard: Guard, *, acts_before_cut_in: bool = False
    ) -> None:
        self.acts_before_cut_in = acts_before_cut_in
        self._controller = controller
        self._seed = seed
        self._guard = guard

    def start(self, cells: IntArray, episodes: IntArray, told: IntArray) -> Failures:  # noqa: ARG002 - see there
        """As `VehicleHost.start`."""
        random = EpisodeRandom(self._seed, told.tolist())
        given = read_only(cells.copy()), read_only(told.copy())
        with self._guard.time_limit:
            _, wrong = self._guard.call(START_BATCH, lambda: self._controller.start_batch(*given, random))
        return {} if wrong is None else dict.fromkeys(cells.tolist(), f"start_batch: {wrong}")

    def act(self, observation: BatchObservation) -> tuple[FloatArray, Failures]:
        """As `VehicleHost.act`."""
        n, cells = observation.cell.size, observation.cell
        with self._guard.time_limit:
            answer, wrong = self._guard.call(
                STEP_BATCH, lambda: np.array(self._controller.step_batch(observation), dtype=np.float64)
            )
        if wrong is None and answer.shape != (n,):
            wrong = f"returned an array of shape {answer.shape}, expected ({n},)"
        if wrong is not None:
            return np.zeros(n), dict.fromkeys(cells.tolist(), f"step_batch: {wrong}")
        low, high = self._guard.limits.min_acceleration_mps2, self._guard.limits.max_acceleration_mps2
        outside = np.flatnonzero(~((answer >= low) & (answer <= high)))  # NaN is neither
        return answer, {
            int(cells[i]): f"step_batch: {self._guard.wrong_answer(float(answer[i]))}" for i in outside.tolist()
        }

    def close(self) -> None:
        """As `VehicleHost.close`."""
        with self._guard.time_limit:
            self._guard.close(self._controller)
        self._guard.time_limit.close()


ControllerHost = VehicleHost | BatchHost
