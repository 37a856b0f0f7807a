"""Run a range of episodes in a world: decide → respond → step → judge, until all have ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from harness.arrays import BoolArray, FloatArray, IntArray, RecordArray
from harness.controllers.protocol import BatchObservation
from harness.environment.driving import Environment
from harness.episode.cells import (
    DISAGREEING,
    ENDED,
    GIVEN,
    PLACED,
    Cells,
    Exchange,
    Results,
    Scratch,
    Script,
    empty_exchange,
    empty_results,
    empty_scratch,
    idle_cells,
    max_draws,
    no_script,
    with_room_for_moments,
)
from harness.episode.kernels import PASSED_M, PASSED_UNDER_CONTROL_M, command, turn, turn_to_controller
from harness.episode.observe import empty_observation, fail, first
from harness.errors import WorldDisagreementError
from harness.importance.functions import Importance
from harness.outcomes import AV, CRASH, FAILED, OUTCOMES, RUNNING
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
    """Everything that a range of episodes left behind.

    ``cut_ins`` (n,) are the rows of the pool that were prescribed, if any were.
    ``traces`` maps an episode's row to its (steps + 1, 3 vehicles, 3: x, v, a) motion, ``failures`` to the cause.
    """

    first_episode: int
    states: FloatArray
    results: Results
    traces: dict[int, FloatArray] = field(default_factory=dict)
    failures: dict[int, str] = field(default_factory=dict)
    script: Script = field(default_factory=no_script)
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
        n = policy.environment.numbers[0]
        self._world = world
        self._policy = policy
        self._keep = keep
        self._av = av
        self._driving: DrivingWorld | None = world if isinstance(world, DrivingWorld) else None
        self._max_steps = int(n["max_steps"])
        self._hold_steps = int(n["hold_steps"])
        self._n_surrogates = int(policy.importance.settings["n_surrogates"][0])
        self._exchange: Exchange = empty_exchange(world.n_cells)
        self._observation: BatchObservation = empty_observation(world.n_cells)
        self._scratch: Scratch = empty_scratch(policy.importance.alpha.size, self._n_surrogates)
        self._cells: Cells = idle_cells(
            world.n_cells,
            n_importance=policy.importance.alpha.size,
            n_surrogates=self._n_surrogates,
            max_steps=self._max_steps,
            hold_steps=self._hold_steps,
            keep_traces=keep.any_trace,
        )

    def run(self, first_episode: int, states: FloatArray, script: Script | None = None) -> Shard:
        """Run episodes ``first_episode … first_episode + n − 1``.

        Parameters
        ----------
        first_episode : int
            Campaign index of the first episode.
        states : ndarray, shape (n, 5)
            Initial states.
        script : Script, optional
            What LV and BV do, where it is not drawn.

        Raises
        ------
        WorldDisagreementError
            The world did something else than it was told.
        """
        n_episodes = states.shape[0]
        shard = Shard(first_episode, states, self._empty_results(n_episodes), script=script or no_script())
        always = traced_by_index(self._policy.seed, first_episode + np.arange(n_episodes), self._keep.trace_share)
        exchange, world, cells = self._exchange, self._world, self._cells
        cells.cell["row"] = -1
        exchange.counts[GIVEN] = 0
        ended = 0
        while True:
            shard.results = with_room_for_moments(shard.results, world.n_cells)
            if self._av is None:
                self._turn(shard)
            else:
                self._controlled_turn(shard, self._av)
            if exchange.counts[ENDED]:
                ended += int(exchange.counts[ENDED])
                self._keep_traces(shard, always)
            if ended == n_episodes:
                return shard
            try:
                if exchange.counts[PLACED]:
                    self._place(exchange.placed[: exchange.counts[PLACED]])
                exchange.contact[:] = world.step(cells.speed, cells.cut_in)
            except AVLostError as lost:
                ended += self._lose(str(lost), shard, always)

    def beside(self, world: World) -> EpisodeLoop:
        """Another loop with the same AV, policy and records, in a world of no more cells."""
        return EpisodeLoop(world, self._policy, self._keep, self._av)

    def close(self) -> None:
        """Release what the AV's controllers hold; the loop runs no more."""
        if self._av is not None:
            self._av.close()

    def _place(self, placed: IntArray) -> None:
        if self._driving is not None:
            self._driving.announce(placed, self._cells.cell["episode"][placed])
        self._world.place(placed, self._world.x, self._world.v)

    def _lose(self, cause: str, shard: Shard, always: BoolArray) -> int:
        """Fail all running episodes and begin again; returns their number."""
        running = np.flatnonzero(self._cells.cell["row"] >= 0)
        self._exchange.counts[ENDED] = 0
        self._exchange.ended[:] = RUNNING
        self._exchange.contact[:] = False
        self._fail(dict.fromkeys(running.tolist(), cause), shard)
        self._keep_traces(shard, always)
        if self._driving is not None:
            self._driving.restart()
        return int(running.size)

    def _empty_results(self, n_episodes: int) -> Results:
        return empty_results(
            n_episodes,
            n_importance=self._policy.importance.alpha.size,
            n_surrogates=self._n_surrogates,
            draws=max_draws(self._max_steps, self._hold_steps),
            moment_limit=self._keep.moments,
            moment_capacity=16 * n_episodes,
        )

    def _turn(self, shard: Shard) -> None:
        policy, world, exchange = self._policy, self._world, self._exchange
        turn(
            policy.seed,
            shard.first_episode,
            shard.states,
            world.x,
            world.v,
            self._cells,
            shard.results,
            self._scratch,
            exchange,
            policy.environment,
            policy.importance,
            shard.script,
            policy.driver,
            PASSED_UNDER_CONTROL_M if self._driving is not None and self._driving.acts_before_cut_in else PASSED_M,
            self._keep.any_trace,
        )
        self._require_agreement(shard)

    def _controlled_turn(self, shard: Shard, av: ControlledAV) -> None:
        """`_turn` with the user's controller in it."""
        policy, world, exchange, cells = self._policy, self._world, self._exchange, self._cells
        n = turn_to_controller(
            policy.seed,
            shard.first_episode,
            shard.states,
            world.x,
            world.v,
            cells,
            shard.results,
            self._scratch,
            exchange,
            policy.environment,
            policy.importance,
            shard.script,
            PASSED_UNDER_CONTROL_M if av.acts_before_cut_in else PASSED_M,
            self._keep.any_trace,
            av.acts_before_cut_in,
            self._observation,
        )
        self._require_agreement(shard)
        failures: dict[int, str] = {}
        if exchange.counts[PLACED]:
            placed = exchange.placed[: exchange.counts[PLACED]]
            failures.update(av.start(placed, cells.cell["episode"][placed]))
        if n:
            cells.acceleration[self._observation.cell[:n], AV], failed = av.act(first(self._observation, n))
            failures.update({k: cause for k, cause in failed.items() if k not in failures})
        self._fail(failures, shard)
        command(world.x, world.v, cells, self._keep.any_trace)

    def _fail(self, failures: Mapping[int, str], shard: Shard) -> None:
        """End episodes whose controller failed; the campaign goes on."""
        if not failures:
            return
        world, exchange = self._world, self._exchange
        failed = np.array(sorted(failures), np.int64)
        rows = np.zeros_like(failed)
        fail(failed, world.x, world.v, self._cells, shard.results, self._policy.importance, self._keep.any_trace, rows)
        for k, row in zip(failed.tolist(), rows.tolist(), strict=True):
            shard.failures[row] = failures[k]
            exchange.ended[k], exchange.ended_row[k] = FAILED, row
        exchange.counts[ENDED] += failed.size

    def _require_agreement(self, shard: Shard) -> None:
        if self._exchange.counts[DISAGREEING] >= 0:
            self._refuse(int(self._exchange.counts[DISAGREEING]), shard)

    def _refuse(self, k: int, shard: Shard) -> None:
        """SUMO's own collision flag and the crash criterion must name the same cells."""
        episode, step = self._cells.cell[k][["episode", "step"]].tolist()
        if self._exchange.ended[k] >= 0:  # the cell may have been refilled since
            row = int(self._exchange.ended_row[k])
            episode, step = shard.first_episode + row, shard.results.episode["n_steps"][row]
        raise WorldDisagreementError(
            f"episode {episode}, step {step}",
            found="a collision that the positions do not show"
            if self._exchange.contact[k]
            else "no collision where the positions show one",
            expected="a collision exactly when bumpers overlap by more than 1 mm",
            mend="Please report this episode: its campaign.yaml and index reproduce it.",
        )

    def _keep_traces(self, shard: Shard, always: BoolArray) -> None:
        if not self._keep.any_trace:
            return
        cells, exchange = self._cells, self._exchange
        for k in np.flatnonzero(exchange.ended >= 0):
            row = int(exchange.ended_row[k])
            episode = shard.results.episode[row]
            if always[row] or _wanted(self._keep.traces, int(episode["outcome"]), int(episode["n_control_steps"])):
                buffer = 2 * k + 1 - cells.cell["buffer"][k]
                trace = shard.traces[row] = cells.trace[buffer, : int(episode["n_steps"]) + 1].copy()
                if self._driving is not None:  # nobody commanded what the AV did: its speeds say it
                    trace[:-1, AV, 2] = np.diff(trace[:, AV, 1]) / STEP_S


def _wanted(policy: str, outcome: int, n_control_steps: int) -> bool:
    if policy == "crash":
        return outcome in (CRASH, FAILED)
    if policy == "critical":
        return outcome in (CRASH, FAILED) or n_control_steps > 0
    return policy == "all"


__all__ = ["MOMENT_LIMITS", "OUTCOMES", "EpisodeLoop", "Keep", "Policy", "Shard", "traced_by_index"]
