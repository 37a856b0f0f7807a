"""Run a range of episodes in a world: decide → ask the controller → command → step → judge, until all have ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from harness.compiled import unboxed
from harness.controllers.hosts import ControllerHost
from harness.controllers.protocol import BatchObservation
from harness.errors import WorldDisagreementError
from harness.families.cut_in.lateral import LateralMotion, constant_lead
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.nade.decide import decide
from harness.families.cut_in.nade.functions import Importance
from harness.loop.cells import (
    KernelState,
    PrescribedCutIns,
    PrescribedTraffic,
    Results,
    drawn_traffic,
    empty_results,
    empty_scratch,
    idle_cells,
    with_more_room,
)
from harness.loop.drive import Past, command, empty_observation, first, hold_cruising, observe
from harness.loop.judge import PASSED_M, PASSED_UNDER_CONTROL_M, fail, judge
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import AV, CRASH, FAILED, BoolArray, FloatArray, IntArray, RecordArray
from harness.worlds import AVLostError, World

MOMENT_LIMITS = {"all": 32767, "first_9": 9, "none": 0}
STRAYED = (
    "the vehicle did something else than in its baseline run, given the same traffic and the same random stream: it "
    "draws random numbers of its own, remembers earlier episodes, or depends on time"
)
"""Cause of a test that failed because its weight would have been wrong."""
CONTROL_STEPS = 16
"""Of an episode, for which a shard has room at first; more is made where they are more."""


class Drawing(NamedTuple):
    """What decides the motion of LV, BV and AV."""

    seed: int
    environment: Environment
    importance: Importance
    driver: RecordArray


class RecordPolicy(NamedTuple):
    """What is recorded: at most ``moments`` control steps per episode, and the motion of the ``traces`` episodes."""

    moments: int
    traces: str
    trace_share: float

    @property
    def any_trace(self) -> bool:
        """Whether motion has to be buffered at all."""
        return self.traces != "none" or self.trace_share > 0.0

    def wants(self, outcome: int, n_control_steps: int) -> bool:
        """Whether to keep the motion of an episode that ended so."""
        if self.traces in ("crash", "critical"):
            return outcome in (CRASH, FAILED) or (self.traces == "critical" and n_control_steps > 0)
        return self.traces == "all"


@dataclass
class Shard:
    """Everything that a range of episodes left behind, row by row; ``states`` (n,) are where they began.

    ``cut_ins`` are those of the pool that were prescribed, if any were; ``lateral`` says how cut-ins show themselves.
    ``traces`` maps an episode's row to its (steps + 1, 3 vehicles, 3: x, v, a) motion, ``failures`` to the cause.
    """

    first_episode: int
    states: RecordArray
    results: Results
    traced: BoolArray
    traffic: PrescribedTraffic = field(default_factory=drawn_traffic)
    traces: dict[int, FloatArray] = field(default_factory=dict)
    failures: dict[int, str] = field(default_factory=dict)
    cut_ins: PrescribedCutIns | None = None
    lateral: LateralMotion = field(default_factory=constant_lead)


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


class EpisodeLoop:
    """K idle cells of a world, fed with episodes of one campaign; ``av`` is a controller outside of the kernels."""

    def __init__(self, world: World, policy: Drawing, keep: RecordPolicy, av: ControllerHost | None = None) -> None:
        environment, importance = policy.environment, policy.importance
        self._world = world
        self._policy = policy
        self._keep = keep
        self._av = av
        self._scratch = empty_scratch(environment, importance)
        self._observation = empty_observation(world.n_cells)
        self._past = Past(0 if av is None else av.warm_up_steps, world.n_cells)
        self._cells = idle_cells(world.n_cells, environment, importance, keep_traces=keep.any_trace)

    def run(self, first_episode: int, states: RecordArray, traffic: PrescribedTraffic | None = None) -> Shard:
        """Run episodes ``first_episode … first_episode + n − 1`` of the campaign, from initial ``states`` (n,).

        ``traffic`` is what LV and BV do, where it is not drawn.

        Raises `WorldDisagreementError`: the world did something else than it was told. Raises `CampaignError`: the
        vehicle has replaced what the harness calls, whatever came of that.
        """
        try:
            return self._run(first_episode, states, traffic)
        finally:
            if self._av is not None:
                self._av.require_untouched()

    def _run(self, first_episode: int, states: RecordArray, traffic: PrescribedTraffic | None) -> Shard:
        shard = self._empty_shard(first_episode, states, traffic or drawn_traffic())
        kernel = self._kernel_state(shard)
        given = ended = 0
        while True:
            placed = decide(kernel, given)
            if self._av is not None:
                ended += self._ask(self._av, kernel, shard, placed)
                command(kernel)
            if ended == states.size:
                return shard
            ended += self._step_and_judge(kernel, shard, placed)
            given += placed
            if shard.results.moment_count[0] > shard.results.moment.size - self._world.n_cells:
                shard.results = with_more_room(shard.results)
                kernel = self._kernel_state(shard)

    def beside(
        self, world: World | None = None, keep: RecordPolicy | None = None, drawing: Drawing | None = None
    ) -> EpisodeLoop:
        """Another loop with the same AV, in a world of no more cells, with other records, or another drawing."""
        return EpisodeLoop(world or self._world, drawing or self._policy, keep or self._keep, self._av)

    @property
    def construction_s(self) -> list[float]:
        """Time (s) that each constructor of a controller has taken."""
        return [] if self._av is None else self._av.construction_s

    def close(self) -> None:
        """Release what the AV's controllers hold; the loop runs no more."""
        if self._av is not None:
            self._av.close()

    def _empty_shard(self, first_episode: int, states: RecordArray, traffic: PrescribedTraffic) -> Shard:
        policy, keep = self._policy, self._keep
        self._cells.cell["row"] = -1
        room = CONTROL_STEPS * states.size + self._world.n_cells
        results = empty_results(
            states.size, policy.environment, policy.importance, moment_limit=keep.moments, capacity=room
        )
        traced = traced_by_index(policy.seed, first_episode + np.arange(states.size), keep.trace_share)
        return Shard(first_episode, states, results, traced, traffic, lateral=policy.environment.lateral)

    def _kernel_state(self, shard: Shard) -> KernelState:
        """All that kernels need for a shard, in the form that they need it in."""
        policy, early = self._policy, (self._av or self._world).acts_before_cut_in
        cruises = policy.driver["cruises"].all() if self._av is None else self._av.cruises
        return unboxed(
            KernelState(
                seed=policy.seed,
                first_episode=shard.first_episode,
                states=shard.states,
                traffic=shard.traffic,
                x=self._world.x,
                v=self._world.v,
                cells=self._cells,
                results=shard.results,
                scratch=self._scratch,
                environment=policy.environment,
                importance=policy.importance,
                driver=policy.driver,
                passed_m=PASSED_UNDER_CONTROL_M if early else PASSED_M,
                keep_traces=int(self._keep.any_trace),
                asks_controller=int(self._av is not None),
                observation=self._observation,
                acts_before_cut_in=int(early),
                av_cruises=int(cruises and not early),
            )
        )

    def _ask(self, av: ControllerHost, kernel: KernelState, shard: Shard, placed: int) -> int:
        """Let the user's controllers drive the AVs; returns how many failed."""
        cells, failures = self._cells, dict[int, str]()
        if placed:
            refilled = cells.placed[:placed]
            begun = cells.cell[refilled]
            failures.update(av.start(refilled, begun["episode"], begun["announced_index"], begun["set_speed"]))
        if n := observe(kernel):
            seen = first(self._observation, n)
            if av.warm_up_steps:
                failures = {**self._warm_up(av, seen), **failures}
            cells.acceleration[seen.cell, AV], failed = av.act(seen)
            hold_cruising(kernel, n)
            failures = {**failed, **failures}
        self._past.note(self._world.x, self._world.v)
        return self._fail(failures, kernel, shard)

    def _warm_up(self, av: ControllerHost, seen: BatchObservation) -> dict[int, str]:
        """Show controllers that are asked for the first time in their episode what was before; returns who failed."""
        cell, failures = self._cells.cell[seen.cell], dict[int, str]()
        new = cell["step"] == cell["onset_step"] + 1
        if new.any():
            for before in self._past.before(BatchObservation._make(column[new] for column in seen)):
                failures = {**av.act(before, warms_up=True)[1], **failures}
        return failures

    def _step_and_judge(self, kernel: KernelState, shard: Shard, placed: int) -> int:
        """Let the world take the step, and end what is over; returns how many episodes that are."""
        cells, world = self._cells, self._world
        try:
            if placed:
                refilled = cells.placed[:placed]
                if world.drives_av:
                    world.announce(refilled, cells.cell["announced_index"][refilled])
                world.place(refilled, world.x, world.v)
            contact = world.step(cells.speed, cells.cut_in)
        except AVLostError as lost:
            return self._lose(str(lost), kernel, shard)
        ended = judge(kernel, contact)
        if ended < 0:
            raise _disagreement(cells.cell[-1 - ended], bool(contact[-1 - ended]))
        if ended:
            self._keep_traces(ended, shard)
            outcome = shard.results.episode["outcome"]
            shard.failures.update((row, STRAYED) for _, row in self._ended(ended) if outcome[row] == FAILED)
        return ended

    def _lose(self, cause: str, kernel: KernelState, shard: Shard) -> int:
        """Fail all running episodes and begin again; returns their number."""
        running = np.flatnonzero(self._cells.cell["row"] >= 0)
        lost = self._fail(dict.fromkeys(running.tolist(), cause), kernel, shard)
        self._world.restart()
        return lost

    def _fail(self, failures: Mapping[int, str], kernel: KernelState, shard: Shard) -> int:
        """End episodes whose controller failed (cell → cause), and go on; returns their number."""
        if failures:
            fail(kernel, np.array(sorted(failures), np.int64))
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
            if shard.traced[row] or self._keep.wants(int(episode["outcome"]), int(episode["n_control_steps"])):
                trace = shard.traces[row] = self._cells.trace[k, : int(episode["n_steps"]) + 1].copy()
                if self._world.drives_av:  # nobody commanded what the AV did: its speeds say it
                    trace[:-1, AV, 2] = np.diff(trace[:, AV, 1]) / STEP_S


def _disagreement(cell: np.void, contact: bool) -> WorldDisagreementError:
    """SUMO's own collision flag and the crash criterion must name the same cells."""
    found = "a collision that the positions do not show" if contact else "no collision where the positions show one"
    expected = "a collision exactly when bumpers overlap by more than 1 mm"
    mend = "Please report this episode: its campaign.yaml and index reproduce it."
    return WorldDisagreementError(f"episode {cell['episode']}, step {cell['step']}", found, expected, mend)
