"""Run a range of episodes in a world: refill → decide → respond → command → step → judge, until all have ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from harness.arrays import BoolArray, FloatArray, IntArray, RecordArray
from harness.controllers.protocol import BatchObservation
from harness.environment.driving import Environment
from harness.episode.begin import refill
from harness.episode.cells import (
    Bench,
    Cells,
    PrescribedTraffic,
    Results,
    drawn_traffic,
    empty_results,
    empty_scratch,
    idle_cells,
    with_room_for_moments,
)
from harness.episode.kernels import PASSED_M, PASSED_UNDER_CONTROL_M, command, decide, judge, respond
from harness.episode.observe import empty_observation, fail, first, observe
from harness.errors import WorldDisagreementError
from harness.importance.functions import Importance
from harness.maneuvers import max_draws
from harness.outcomes import AV, CRASH, FAILED, OUTCOMES
from harness.unboxed import unboxed
from harness.vehicles.kinematics import STEP_S
from harness.world import AVLostError, DrivingWorld, World

MOMENT_LIMITS = {"all": 32767, "first_9": 9, "none": 0}


class Policy(NamedTuple):
    """What decides the motion of LV, BV and AV."""

    seed: int
    environment: Environment
    importance: Importance
    driver: RecordArray


class Keep(NamedTuple):
    """What is recorded: at most ``moments`` control steps per episode, and the motion of the ``traces`` episodes."""

    moments: int
    traces: str
    trace_share: float

    @property
    def any_trace(self) -> bool:
        """Whether motion has to be buffered at all."""
        return self.traces != "none" or self.trace_share > 0.0


@dataclass
class Shard:
    """Everything that a range of episodes left behind, row by row; ``states`` (n,) are where they began.

    ``cut_ins`` (n,) are the rows of the pool that were prescribed, if any were.
    ``traces`` maps an episode's row to its (steps + 1, 3 vehicles, 3: x, v, a) motion, ``failures`` to the cause.
    """

    first_episode: int
    states: RecordArray
    results: Results
    traced: BoolArray
    traffic: PrescribedTraffic = field(default_factory=drawn_traffic)
    traces: dict[int, FloatArray] = field(default_factory=dict)
    failures: dict[int, str] = field(default_factory=dict)
    cut_ins: IntArray | None = None


def hash_of_index(seed: int, episodes: IntArray) -> FloatArray:
    """A number in [0, 1) for each episode, which cannot depend on its outcome."""
    mixed = (episodes.astype(np.uint64) + np.uint64(seed)) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    hashed: FloatArray = (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53
    return hashed


def traced_by_index(seed: int, episodes: IntArray, share: float) -> BoolArray:
    """Which episodes are traced whatever their outcome."""
    chosen: BoolArray = hash_of_index(seed, episodes) < share
    return chosen


class ControlledAV(Protocol):
    """An AV controller outside of the kernels (see `harness.controllers.hosts`)."""

    @property
    def acts_before_cut_in(self) -> bool:
        """Whether it acts from the start of an episode, or from the step after the cut-in."""
        ...

    def start(self, cells: IntArray, episodes: IntArray) -> Mapping[int, str]:
        """Begin episodes; returns the cells that failed, with the cause."""
        ...

    def act(self, observation: BatchObservation) -> tuple[FloatArray, Mapping[int, str]]:
        """Accelerations (m/s²) of the observed AVs, and the cells that failed, with the cause."""
        ...

    def close(self) -> None:
        """Release all controllers."""


class EpisodeLoop:
    """K cells of a world, fed with episodes of one campaign.

    Parameters
    ----------
    world : World
        Where vehicles move; its cells are all idle.
    policy : Policy
    keep : Keep
    av : ControlledAV, optional
        A controller outside of the kernels.
    """

    def __init__(self, world: World, policy: Policy, keep: Keep, av: ControlledAV | None = None) -> None:
        numbers, importance = policy.environment.numbers, policy.importance
        self._world = world
        self._policy = policy
        self._keep = keep
        self._av = av
        self._driving: DrivingWorld | None = world if isinstance(world, DrivingWorld) else None
        self._scratch = empty_scratch(policy.environment, importance.alpha.size, importance.n_surrogates)
        self._observation: BatchObservation = empty_observation(world.n_cells)
        self._cells: Cells = idle_cells(
            world.n_cells,
            n_importance=importance.alpha.size,
            n_surrogates=importance.n_surrogates,
            max_steps=int(numbers["max_steps"]),
            hold_steps=int(numbers["hold_steps"]),
            keep_traces=keep.any_trace,
        )

    def run(self, first_episode: int, states: RecordArray, traffic: PrescribedTraffic | None = None) -> Shard:
        """Run episodes ``first_episode … first_episode + n − 1``.

        Parameters
        ----------
        first_episode : int
            Campaign index of the first episode.
        states : structured ndarray, shape (n,)
            Initial states.
        traffic : PrescribedTraffic, optional
            What LV and BV do, where it is not drawn.

        Raises
        ------
        WorldDisagreementError
            The world did something else than it was told.
        """
        episodes = first_episode + np.arange(states.size)
        traced = traced_by_index(self._policy.seed, episodes, self._keep.trace_share)
        shard = Shard(first_episode, states, self._empty_results(states.size), traced, traffic or drawn_traffic())
        self._cells.cell["row"] = -1
        bench = self._bench(shard)
        given = ended = 0
        while True:
            bench = self._with_room(bench, shard)
            placed = refill(bench, given)
            decide(bench)
            ended += self._respond(bench, shard, placed)
            if ended == states.size:
                return shard
            command(bench)
            ended += self._step_and_judge(bench, shard, placed)
            given += placed

    def beside(self, world: World) -> EpisodeLoop:
        """Another loop with the same AV, policy and records, in a world of no more cells."""
        return EpisodeLoop(world, self._policy, self._keep, self._av)

    def close(self) -> None:
        """Release what the AV's controllers hold; the loop runs no more."""
        if self._av is not None:
            self._av.close()

    def _empty_results(self, n_episodes: int) -> Results:
        numbers, importance = self._policy.environment.numbers, self._policy.importance
        return empty_results(
            n_episodes,
            n_importance=importance.alpha.size,
            n_surrogates=importance.n_surrogates,
            draws=max_draws(int(numbers["max_steps"]), int(numbers["hold_steps"])),
            moment_limit=self._keep.moments,
            moment_capacity=16 * n_episodes,
        )

    def _bench(self, shard: Shard) -> Bench:
        """All that kernels need for a shard, in the form that they need it in."""
        policy, controlled = self._policy, self._av or self._driving
        early = controlled is not None and controlled.acts_before_cut_in
        return unboxed(
            Bench(
                policy.seed,
                shard.first_episode,
                shard.states,
                shard.traffic,
                self._world.x,
                self._world.v,
                self._cells,
                shard.results,
                self._scratch,
                policy.environment,
                policy.importance,
                policy.driver,
                PASSED_UNDER_CONTROL_M if early else PASSED_M,
                self._keep.any_trace,
                self._observation,
                early,
            )
        )

    def _with_room(self, bench: Bench, shard: Shard) -> Bench:
        """The same, with room for the control steps that the coming step may bring."""
        results = with_room_for_moments(shard.results, self._world.n_cells)
        if results is shard.results:
            return bench
        shard.results = results
        return self._bench(shard)

    def _respond(self, bench: Bench, shard: Shard, placed: int) -> int:
        """What the AVs do, the user's controller or a built-in one; returns how many controllers failed."""
        if self._av is None:
            if self._policy.driver.size:
                respond(bench)
            return 0
        cells, failures = self._cells, dict[int, str]()
        if placed:
            refilled = cells.placed[:placed]
            failures.update(self._av.start(refilled, cells.cell["episode"][refilled]))
        if n := observe(bench):
            acting = self._observation.cell[:n]
            cells.acceleration[acting, AV], failed = self._av.act(first(self._observation, n))
            failures.update({k: cause for k, cause in failed.items() if k not in failures})
        return self._fail(failures, bench, shard)

    def _step_and_judge(self, bench: Bench, shard: Shard, placed: int) -> int:
        """Let the world take the step, and end what is over; returns how many episodes that are."""
        cells = self._cells
        try:
            if placed:
                self._place(cells.placed[:placed])
            contact = self._world.step(cells.speed, cells.cut_in)
        except AVLostError as lost:
            return self._lose(str(lost), bench, shard)
        ended = judge(bench, contact)
        if ended < 0:
            raise _disagreement(cells.cell[-1 - ended], bool(contact[-1 - ended]))
        if ended:
            self._keep_traces(ended, shard)
        return ended

    def _place(self, refilled: IntArray) -> None:
        if self._driving is not None:
            self._driving.announce(refilled, self._cells.cell["episode"][refilled])
        self._world.place(refilled, self._world.x, self._world.v)

    def _lose(self, cause: str, bench: Bench, shard: Shard) -> int:
        """Fail all running episodes and begin again; returns their number."""
        running = np.flatnonzero(self._cells.cell["row"] >= 0)
        lost = self._fail(dict.fromkeys(running.tolist(), cause), bench, shard)
        if self._driving is not None:
            self._driving.restart()
        return lost

    def _fail(self, failures: Mapping[int, str], bench: Bench, shard: Shard) -> int:
        """End episodes whose controller failed, and go on; returns their number."""
        if failures:
            fail(bench, np.array(sorted(failures), np.int64))
            for k, row in self._ended(len(failures)):
                shard.failures[row] = failures[k]
            self._keep_traces(len(failures), shard)
        return len(failures)

    def _ended(self, n: int) -> list[tuple[int, int]]:
        """Cells whose episode has just ended, and its rows."""
        return list(zip(self._cells.ended[:n].tolist(), self._cells.ended_row[:n].tolist(), strict=True))

    def _keep_traces(self, n: int, shard: Shard) -> None:
        """Copy the motion of those of the ``n`` episodes that have just ended which is to be kept."""
        if not self._keep.any_trace:
            return
        for k, row in self._ended(n):
            episode = shard.results.episode[row]
            if shard.traced[row] or _wanted(
                self._keep.traces, int(episode["outcome"]), int(episode["n_control_steps"])
            ):
                trace = shard.traces[row] = self._cells.trace[k, : int(episode["n_steps"]) + 1].copy()
                if self._driving is not None:  # nobody commanded what the AV did: its speeds say it
                    trace[:-1, AV, 2] = np.diff(trace[:, AV, 1]) / STEP_S


def _disagreement(cell: np.void, contact: bool) -> WorldDisagreementError:
    """SUMO's own collision flag and the crash criterion must name the same cells."""
    return WorldDisagreementError(
        f"episode {cell['episode']}, step {cell['step']}",
        found="a collision that the positions do not show" if contact else "no collision where the positions show one",
        expected="a collision exactly when bumpers overlap by more than 1 mm",
        mend="Please report this episode: its campaign.yaml and index reproduce it.",
    )


def _wanted(policy: str, outcome: int, n_control_steps: int) -> bool:
    if policy == "crash":
        return outcome in (CRASH, FAILED)
    if policy == "critical":
        return outcome in (CRASH, FAILED) or n_control_steps > 0
    return policy == "all"


__all__ = ["MOMENT_LIMITS", "OUTCOMES", "EpisodeLoop", "Keep", "Policy", "Shard", "traced_by_index"]
