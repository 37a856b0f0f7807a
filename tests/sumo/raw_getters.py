"""What SUMO itself says about every vehicle in every step, written down in a process of its own.

The recording is made by libsumo's getters alone, beside the world under test and after it has done its work, so that
nothing the world remembers, caches or expects can leak into it. Episodes are found again from the order in which cells
were filled: a shard's episodes are given to the placed cells one after another.
"""

from __future__ import annotations

from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness.campaign.campaign import Campaign
from harness.episode.loop import Shard
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.vocabulary import BV_LV_CONTACT, CRASH, VEHICLES


class Job(NamedTuple):
    """A range of episodes to run in SUMO and to record: ``states`` (n,), or the campaign's own when None."""

    campaign: Campaign
    n_episodes: int
    n_cells: int
    vanilla: bool = False
    shim: bool = True
    states: np.ndarray | None = None


class Motion(NamedTuple):
    """An episode as SUMO's getters or a world's traces show it.

    ``x``, ``v`` (steps + 1, 3) of LV, BV, AV; ``lane`` (steps + 1, 3); ``contact_steps`` are those in which a collision
    was flagged; ``acceleration`` (steps, 3) is what was commanded.
    """

    x: np.ndarray
    v: np.ndarray
    lane: np.ndarray
    contact_steps: tuple[int, ...]
    acceleration: np.ndarray


def record_in_another_process(jobs: dict[str, Job], folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Run jobs in one spawned process; name → arrays that the getters gave."""
    child = get_context("spawn").Process(target=_record_all, args=(jobs, folder))
    child.start()
    child.join(600)
    if child.exitcode != 0:
        child.kill()
        raise AssertionError(f"the recording process ended with {child.exitcode}")
    recordings = {}
    for name in jobs:
        with np.load(folder / f"{name}.npz") as arrays:
            recordings[name] = dict(arrays)
    return recordings


def _record_all(jobs: dict[str, Job], folder: Path) -> None:
    for name, job in jobs.items():
        np.savez(folder / f"{name}.npz", **_record(job))


def _record(job: Job) -> dict[str, np.ndarray]:
    import libsumo

    from harness.worlds.sumo import SumoWorld

    names = [f"{vehicle}{k}" for k in range(job.n_cells) for vehicle in VEHICLES]
    seen: dict[str, list[np.ndarray]] = {"x": [], "v": [], "lane": [], "contact": [], "placed": []}

    def read(placed: np.ndarray) -> None:
        for quantity, getter in (
            ("x", libsumo.vehicle.getLanePosition),
            ("v", libsumo.vehicle.getSpeed),
            ("lane", libsumo.vehicle.getLaneIndex),
        ):
            seen[quantity].append(np.array([getter(name) for name in names]).reshape(-1, 3))
        # A cell that is being filled again has not moved yet: what still collides belongs to the episode before.
        collisions = () if placed.any() else libsumo.simulation.getCollisions()
        colliding = {name for collision in collisions for name in (collision.collider, collision.victim)}
        seen["contact"].append(np.array([name in colliding for name in names]).reshape(-1, 3).any(axis=1))
        seen["placed"].append(placed)

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
    arrays = {name: np.stack(values) for name, values in seen.items()}
    arrays["acceleration"] = np.concatenate([shard.traces[row][:-1, :, 2] for row in sorted(shard.traces)])
    return {**arrays, "outcome": shard.results.episode["outcome"], "n_steps": shard.results.episode["n_steps"]}


def run_episodes(job: Job, world) -> Shard:
    """Run the job's episodes in any world, all of them traced."""
    prepared = prepare(resolve(job.campaign))
    states = prepared.states(0, job.n_episodes) if job.states is None else job.states
    return prepared.loop(world, traces="all").run(0, states)


def motions_seen(recording: dict[str, np.ndarray]) -> list[Motion]:
    """Episodes of a recording, in index order."""
    placed = recording["placed"]
    is_step = ~placed.any(axis=1)
    accelerations = np.split(recording["acceleration"], np.cumsum(recording["n_steps"])[:-1])
    motions = []
    for (time, cell), n_steps in zip(np.argwhere(placed), recording["n_steps"], strict=True):
        steps = np.concatenate([[time], time + 1 + np.flatnonzero(is_step[time + 1 :])[:n_steps]])
        flagged = tuple(np.flatnonzero(recording["contact"][steps, cell]).tolist())
        x, v, lane = (recording[name][steps, cell] for name in ("x", "v", "lane"))
        motions.append(Motion(x, v, lane, flagged, accelerations[len(motions)]))
    return motions


def motions_computed(shard: Shard) -> list[Motion]:
    """Episodes of a shard that was run without SUMO, in index order; contact by the formula's verdict."""
    motions = []
    for row, result in enumerate(shard.results.episode):
        trace = shard.traces[row]
        lane = np.tile([1, 1, 0], (trace.shape[0], 1))
        if result["cut_in_step"] >= 0:
            lane[result["cut_in_step"] + 1 :, 1] = 0
        contact = (int(result["n_steps"]),) if result["outcome"] in (CRASH, BV_LV_CONTACT) else ()
        motions.append(Motion(trace[..., 0], trace[..., 1], lane, contact, trace[:-1, :, 2]))
    return motions


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two float arrays hold the same bits: 0.0 and -0.0 differ, NaN equals itself."""
    a, b = (np.ascontiguousarray(values, dtype=np.float64).view(np.uint64) for values in (a, b))
    return a.shape == b.shape and bool((a == b).all())


def differences(seen: list[Motion], computed: list[Motion]) -> dict[int, set[str]]:
    """Episode → quantities in which two runs of it differ; empty when they agree in every bit."""
    assert len(seen) == len(computed)
    found = {}
    for episode, (a, b) in enumerate(zip(seen, computed, strict=True)):
        wrong = {name for name in ("x", "v", "acceleration") if not same_bits(getattr(a, name), getattr(b, name))}
        wrong |= {"lane"} if not np.array_equal(a.lane, b.lane) else set()
        wrong |= {"contact"} if a.contact_steps != b.contact_steps else set()
        if wrong:
            found[episode] = wrong
    return found
