"""Run a range of tests in a world: refill → move → drive or ask → command → step → judge, until all have ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from harness.compiled import unboxed
from harness.controllers.hosts import ControllerHost, require_ours
from harness.controllers.protocol import BatchObservation
from harness.errors import CampaignError, WorldDisagreementError
from harness.loop.cells import EPISODE_DTYPE, KernelState, PrescribedEvents, idle_cells
from harness.loop.drive import Past, command, drive, empty_observation, first, hold_cruising, observe
from harness.loop.judge import fail, judge
from harness.loop.repeat import Traffic, refill
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import CRASH, FAILED, BoolArray, FloatArray, IntArray, RecordArray
from harness.worlds import AVLostError, World

STRAYED = (
    "the vehicle did something else than in its baseline run, given the same traffic and the same random stream: it "
    "draws random numbers of its own, remembers earlier tests, or depends on time"
)
"""Cause of a test that failed because its weight would have been wrong."""

BRAKES_MPS2 = -0.1
"""Acceleration below which an AV with nobody ahead brakes of its own accord; rounding is far smaller [assumed]."""


class Scenario(NamedTuple):
    """What the tests of a campaign have in common.

    ``vehicles`` are the names of the vehicles of a cell, the AV last; ``principal`` is the place of the one that events
    are about, ``ahead`` of the one ahead of it (-1: none). ``max_steps`` is the length of the longest test,
    ``sideways_m`` the way from a first lateral motion to overlap, ``shows`` whether events can be seen before they
    happen. ``driver`` is (1,) for a built-in AV, else (0,). ``columns`` are the facts of tests that records keep.
    """

    seed: int
    vehicles: tuple[str, ...]
    principal: int
    ahead: int
    max_steps: int
    sideways_m: float
    shows: bool
    driver: RecordArray
    columns: tuple[Any, ...]

    @property
    def shown(self) -> tuple[str, str]:
        """Names of the vehicles that controllers see as LV and BV; empty without one."""
        return self.vehicles[self.ahead] if self.ahead >= 0 else "", self.vehicles[self.principal]


class RecordPolicy(NamedTuple):
    """Which tests' motion is recorded: by the policy ``traces``, and a share by the hash of their index."""

    traces: str
    trace_share: float

    @property
    def any_trace(self) -> bool:
        """Whether motion has to be buffered at all."""
        return self.traces != "none" or self.trace_share > 0.0

    def wants(self, outcome: int, n_control_steps: int) -> bool:
        """Whether the policy keeps the motion of an episode with this end."""
        if self.traces in ("crash", "critical"):
            return outcome in (CRASH, FAILED) or (self.traces == "critical" and n_control_steps > 0)
        return self.traces == "all"


@dataclass
class Shard:
    """All results of a range of tests, by row.

    ``episode`` (n,) are `harness.loop.cells.EPISODE_DTYPE` records; ``traffic`` is what the others did, and ``events``
    are those of the pool that were prescribed, if any were. ``traced`` (n,) is whose motion is kept whatever the end.
    ``traces`` maps a test's row to its (steps + 1, V, 4: x, v, a, lane) motion, ``failures`` to the cause.
    """

    first_episode: int
    scenario: Scenario
    traffic: Traffic
    episode: RecordArray
    traced: BoolArray
    traces: dict[int, FloatArray] = field(default_factory=dict)
    failures: dict[int, str] = field(default_factory=dict)
    events: PrescribedEvents | None = None


def hash_of_index(seed: int, episodes: IntArray) -> FloatArray:
    """A pseudo-random number in [0, 1) for each episode, by its index: it cannot depend on the outcome."""
    mixed = (episodes.astype(np.uint64) + np.uint64(seed)) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    hashed: FloatArray = (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53
    return hashed


class EpisodeLoop:
    """K idle cells of a world, fed with tests of one campaign; ``av`` is a controller outside of the kernels."""

    def __init__(self, world: World, scenario: Scenario, keep: RecordPolicy, av: ControllerHost | None = None) -> None:
        self._world, self._scenario, self._keep, self._av = world, scenario, keep, av
        self._observation = empty_observation(world.n_cells)
        warm_up = 0 if av is None else av.warm_up_steps
        self._past = Past(warm_up, world.x.shape, scenario.principal, scenario.ahead)
        self._cells = idle_cells(world.n_cells, len(scenario.vehicles), scenario.max_steps, keep_traces=keep.any_trace)

    def run(self, first_episode: int, traffic: Traffic) -> Shard:
        """Run the campaign's tests ``first_episode … first_episode + n − 1`` with this traffic (n tests).

        Raises `WorldDisagreementError`: the world did something else than it was told. Raises `CampaignError`: the
        vehicle has replaced functions that the harness calls, has changed the simulation, or raises between its calls.
        """
        n = len(traffic)
        traced = hash_of_index(self._scenario.seed, first_episode + np.arange(n)) < self._keep.trace_share
        shard = Shard(first_episode, self._scenario, traffic, np.zeros(n, EPISODE_DTYPE), traced)
        self._cells.cell["row"] = -1
        kernel = self._kernel_state(shard)
        given = ended = turn = 0
        traffic.begin(self._world.n_cells)
        try:
            while True:
                turn += 1
                if self._av is not None and turn % self._scenario.max_steps == 0:
                    self._av.require_untouched()  # if it has changed the simulation, tests may never end
                placed = refill(kernel, given)
                traffic.move(kernel, placed)
                if self._av is not None:
                    ended += self._ask(self._av, kernel, shard, placed)
                elif not self._world.drives_av:
                    drive(kernel)
                command(kernel)
                if ended == n:
                    return shard
                ended += self._step_and_judge(kernel, shard, placed)
                given += placed
        except Exception as error:
            lent = sorted(self._world.lent) if isinstance(error, WorldDisagreementError | RuntimeError) else []
            if self._av is None:
                raise
            if not (lent or type(error).__module__ == "libsumo.libsumo"):
                require_ours(error)
                raise
            found = f"a vehicle that has changed the simulation that it is tested in ({', '.join(lent) or error})"
            mend = "Use the traci that is handed in (docs/controllers.md), not the module."
            raise CampaignError("av.controller", found, "libsumo left as it is", mend) from error
        finally:
            if self._av is not None:
                self._av.require_untouched()

    def beside(self, keep: RecordPolicy | None = None) -> EpisodeLoop:
        """Another loop with the same AV and world, or one with other records."""
        return EpisodeLoop(self._world, self._scenario, keep or self._keep, self._av)

    @property
    def construction_s(self) -> list[float]:
        """Time (s) that each constructor of a controller has taken."""
        return [] if self._av is None else self._av.construction_s

    def close(self) -> None:
        """Release what the AV's controllers hold; the loop runs no more."""
        if self._av is not None:
            self._av.close()

    def _kernel_state(self, shard: Shard) -> KernelState:
        """What kernels need for a shard, in the form that they take."""
        scenario = self._scenario
        acts_early = (self._av or self._world).acts_before_event
        cruises = scenario.driver["cruises"].all() if self._av is None else self._av.cruises
        return unboxed(
            KernelState(
                seed=scenario.seed,
                first_episode=shard.first_episode,
                script=shard.traffic.script,
                x=self._world.x,
                v=self._world.v,
                cells=self._cells,
                episode=shard.episode,
                principal=scenario.principal,
                ahead=scenario.ahead,
                sideways_m=scenario.sideways_m,
                driver=scenario.driver,
                keep_traces=int(self._keep.any_trace),
                observation=self._observation,
                acts_early=int(acts_early),
                av_cruises=int(cruises),
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
                failures = {**self._warm_up(av, seen, shard), **failures}
            cells.acceleration[seen.cell], failed = av.act(seen)
            hold_cruising(kernel, n)
            failures = {**failed, **failures}
        self._past.note(self._world.x, self._world.v)
        return self._fail(failures, kernel, shard)

    def _warm_up(self, av: ControllerHost, seen: BatchObservation, shard: Shard) -> dict[int, str]:
        """Show the past to controllers that are about to act for the first time in their episode; returns failures."""
        cell, failures = self._cells.cell[seen.cell], dict[int, str]()
        new = (cell["step"] == cell["acts_from"]) & (cell["acts_from"] > 0)  # those that act from the start get none
        if new.any():
            for before in self._past.before(BatchObservation._make(column[new] for column in seen)):
                asked, failed = av.act(before, warms_up=True)
                failures = {**failed, **failures}
            shard.episode["braked_before"][cell["row"][new]] = asked < BRAKES_MPS2
        return failures

    def _step_and_judge(self, kernel: KernelState, shard: Shard, placed: int) -> int:
        """Let the world take the step, and end the tests that are over; returns their number."""
        cells, world = self._cells, self._world
        try:
            if placed:
                refilled = cells.placed[:placed]
                if world.drives_av:
                    world.announce(refilled, cells.cell["announced_index"][refilled])
                world.place(refilled, world.x, world.v, cells.lane_before)
            contact = world.step(cells.speed, cells.lane)
        except AVLostError as lost:  # all running episodes fail
            running = np.flatnonzero(cells.cell["row"] >= 0)
            failed = self._fail(dict.fromkeys(running.tolist(), str(lost)), kernel, shard)
            world.restart()
            return failed
        ended = judge(kernel, contact)
        if ended < 0:
            raise _disagreement(cells.cell[-1 - ended], bool(contact[-1 - ended]))
        if ended:
            shard.traffic.finish(kernel, ended)
            self._keep_traces(ended, shard)
            outcome = shard.episode["outcome"]
            shard.failures.update((row, STRAYED) for _, row in self._ended(ended) if outcome[row] == FAILED)
        return ended

    def _fail(self, failures: Mapping[int, str], kernel: KernelState, shard: Shard) -> int:
        """End episodes whose controller failed (cell → cause), and go on; returns their number."""
        if failures:
            fail(kernel, np.array(sorted(failures), np.int64))
            shard.traffic.finish(kernel, len(failures))
            for k, row in self._ended(len(failures)):
                shard.failures[row] = failures[k]
            self._keep_traces(len(failures), shard)
        return len(failures)

    def _ended(self, n: int) -> list[tuple[int, int]]:
        """Cells of the ``n`` episodes that have just ended, and their rows."""
        return list(zip(self._cells.ended[:n].tolist(), self._cells.ended_row[:n].tolist(), strict=True))

    def _keep_traces(self, n: int, shard: Shard) -> None:
        """Copy the motion that is to be kept of the ``n`` episodes that have just ended."""
        if not self._keep.any_trace:
            return
        for k, row in self._ended(n):
            episode = shard.episode[row]
            if shard.traced[row] or self._keep.wants(int(episode["outcome"]), int(episode["n_control_steps"])):
                trace = shard.traces[row] = self._cells.trace[k, : int(episode["n_steps"]) + 1].copy()
                if self._world.drives_av:  # the AV's acceleration was not commanded here: it follows from its speeds
                    trace[:-1, -1, 2] = np.diff(trace[:, -1, 1]) / STEP_S


def _disagreement(cell: np.void, contact: bool) -> WorldDisagreementError:
    """SUMO's own collision flag and the crash criterion must name the same cells."""
    found = "a collision that the positions do not show" if contact else "no collision where the positions show one"
    expected = "a collision exactly when bumpers overlap by more than 1 mm"
    mend = "Please report this test: its campaign.yaml and number reproduce it."
    return WorldDisagreementError(f"test {cell['episode']}, step {cell['step']}", found, expected, mend)
