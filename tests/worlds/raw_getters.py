"""What SUMO itself says about every vehicle in every step, written down in a process of its own.

The recording is made by libsumo's getters alone, beside the world under test and after it has done its work, so that
nothing the world remembers, caches or expects can leak into it. Episodes are found again from the order in which cells
were filled: a shard's episodes are given to the placed cells one after another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from harness.episode.loop import Shard
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.vocabulary import BV_LV_CONTACT, CRASH, VEHICLES
from tests.worlds.running import smoke


class Job(NamedTuple):
    """Episodes of a campaign to run in SUMO and to record; ``states`` (n,) if not the campaign's own."""

    overrides: Sequence[str]
    n_episodes: int
    n_cells: int
    vanilla: bool = False
    shim: bool = True
    states: np.ndarray | None = None


class Motion(NamedTuple):
    """An episode as SUMO's getters or a world's traces show it.

    ``x``, ``v``, ``lane`` (steps + 1, 3) of LV, BV, AV; ``contact`` (steps + 1,): whether a collision was flagged;
    ``acceleration`` (steps, 3): what was commanded.
    """

    x: np.ndarray
    v: np.ndarray
    lane: np.ndarray
    contact: np.ndarray
    acceleration: np.ndarray


class Recording(NamedTuple):
    """Episodes in index order, with their outcomes (n,)."""

    motions: list[Motion]
    outcome: np.ndarray


def record_in_another_process(jobs: Mapping[str, Job]) -> dict[str, Recording]:
    """Run jobs in one spawned process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        return dict(zip(jobs, process.map(_record, jobs.values()), strict=True))


def _record(job: Job) -> Recording:
    import libsumo

    from harness.worlds.sumo import SumoWorld

    names = [f"{vehicle}{k}" for k in range(job.n_cells) for vehicle in VEHICLES]
    getters = (libsumo.vehicle.getLanePosition, libsumo.vehicle.getSpeed, libsumo.vehicle.getLaneIndex)
    seen: list[tuple[np.ndarray, ...]] = []
    filled: list[np.ndarray] = []

    def read(placed: np.ndarray) -> None:
        # A cell that is being filled again has not moved yet: what still collides belongs to the episode before.
        collisions = () if placed.any() else libsumo.simulation.getCollisions()
        colliding = {name for collision in collisions for name in (collision.collider, collision.victim)}
        contact = np.array([name in colliding for name in names]).reshape(-1, 3).any(axis=1)
        seen.append((*(np.array([getter(name) for name in names]).reshape(-1, 3) for getter in getters), contact))
        filled.append(placed)

    class RecordedWorld(SumoWorld):
        def place(self, cells, x, v):
            super().place(cells, x, v)
            read(np.isin(np.arange(job.n_cells), cells))

        def step(self, speed, cut_in):
            contact = super().step(speed, cut_in)
            read(np.zeros(job.n_cells, bool))
            return contact

    world = RecordedWorld(job.n_cells, vanilla=job.vanilla, shim=job.shim)
    try:
        shard = run_episodes(job, world)
    finally:
        world.close()
    quantities, placed = [np.stack(values) for values in zip(*seen, strict=True)], np.stack(filled)
    steps = np.flatnonzero(~placed.any(axis=1))
    motions = []
    for row, ((time, cell), n) in enumerate(zip(np.argwhere(placed), shard.results.episode["n_steps"], strict=True)):
        times = np.append(time, steps[steps > time][:n])
        motions.append(Motion(*(values[times, cell] for values in quantities), shard.traces[row][:-1, :, 2]))
    return Recording(motions, shard.results.episode["outcome"])


def run_episodes(job: Job, world) -> Shard:
    """Run the job's episodes in any world, all of them traced."""
    prepared = prepare(resolve(smoke(*job.overrides)))
    states = prepared.states(0, job.n_episodes) if job.states is None else job.states
    return prepared.loop(world, traces="all").run(0, states)


def motions_computed(shard: Shard) -> list[Motion]:
    """Episodes of a shard that was run without SUMO, in index order; contact by the formula's verdict."""
    motions = []
    for row, result in enumerate(shard.results.episode):
        x, v, acceleration = np.moveaxis(shard.traces[row], 2, 0)
        lane = np.tile([1, 1, 0], (len(x), 1))
        if result["cut_in_step"] >= 0:
            lane[result["cut_in_step"] + 1 :, 1] = 0
        ended_by_contact = result["outcome"] in (CRASH, BV_LV_CONTACT)
        contact = ended_by_contact & (np.arange(len(x)) == result["n_steps"])
        motions.append(Motion(x, v, lane, contact, acceleration[:-1]))
    return motions


def differences(seen: list[Motion], computed: list[Motion]) -> dict[int, set[str]]:
    """Episode → quantities in which two runs of it differ in any bit: 0.0 and -0.0 differ, NaN equals itself."""
    found = {}
    for episode, pair in enumerate(zip(seen, computed, strict=True)):
        if wrong := {
            name
            for name, a, b in zip(Motion._fields, *pair, strict=True)
            if (a.shape, a.dtype, a.tobytes()) != (b.shape, b.dtype, b.tobytes())
        }:
            found[episode] = wrong
    return found
