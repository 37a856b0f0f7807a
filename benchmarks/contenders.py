"""What is measured against what: the same episodes in the harness, one at a time, over TraCI, and in the twin.

(a), (b) and (c) run the same `EpisodeLoop`: the same compiled policies, the same rule for ending an episode, the same
rows and first nine control steps written to Parquet. They differ in the world alone, so their rows must be equal.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.one_at_a_time import OverTraci, in_libsumo
from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.families.cut_in.nade import in_loop
from harness.loop import loop
from harness.loop.loop import Shard
from harness.records.folder import write_part
from harness.records.schemas import shard_tables
from harness.resolved import resolve
from harness.runner.workers import LocalWorkers, ShardResult
from harness.sampling import prepare
from harness.sampling.protocol import ShardRequest, Source
from harness.worlds import World
from harness.worlds.sumo import SumoWorld, shim_library, sumo_program
from harness.worlds.twin import TwinWorld

SCENARIOS = Path(__file__).parents[1] / "scenarios"
TWIN_CELLS = 1024
FLOOR_STEPS = 200
SHARD = 2_500


class Work(NamedTuple):
    """What one measurement did, with wall time by part where the contender knows it.

    ``timed_s`` are wall and CPU time of what counts, where that is not everything.
    """

    episodes: int
    cell_steps: int
    bytes_written: int = 0
    part_s: dict[str, float] | None = None
    timed_s: tuple[float, float] | None = None


class Contender:
    """Something that runs episodes."""

    def run(self, first: int, n: int) -> Work:
        """Run episodes ``first … first + n − 1``."""
        raise NotImplementedError

    def rows(self, n: int) -> bytes | None:  # noqa: ARG002
        """Outcome, steps, cut-in step and weight of the first n episodes, to compare; None if there are none."""
        return None

    def close(self) -> None:
        """Close what was opened."""


NADE = "nade_epsilon_0.1"


def campaign(name: str, **settings: object) -> Campaign:
    """A shipped campaign; motion is not traced, so that only what estimates need is recorded."""
    fixed = {"records.traces": "none", "records.trace_share": 0, **settings}
    return load_campaign(SCENARIOS / f"overtaking_{name}.yaml", [f"{key}={value}" for key, value in fixed.items()])


class Recorded(Contender):
    """Episodes of a campaign in some world, written to disk as the runner writes them."""

    def __init__(self, settings: Campaign, world: Callable[[Campaign], World]) -> None:
        self.prepared: Source = prepare(resolve(settings))
        self.world = world(settings)
        self.loop = self.prepared.loop(self.world)
        self.folder = Path(tempfile.mkdtemp(prefix="harness-benchmark-"))

    def run(self, first: int, n: int) -> Work:
        shard = self.loop.run(first, self.prepared.tests(first, n))
        self.write(shard)
        files = list(self.folder.rglob("*.parquet"))
        written = sum(path.stat().st_size for path in files)
        for path in files:
            path.unlink()
        return Work(n, int(shard.episode["n_steps"].sum()), written)

    def write(self, shard: Shard) -> None:
        tables = shard_tables(shard, self.prepared.campaign.seed, keep_traces=False)
        write_part(self.folder, [tables], shard.first_episode, tables["episodes"].num_rows)

    def rows(self, n: int) -> bytes:
        episode = self.loop.run(0, self.prepared.tests(0, n)).episode
        return b"".join(episode[name].tobytes() for name in ("outcome", "n_steps", "event_step", "log_weight"))

    def close(self) -> None:
        self.world.close()
        shutil.rmtree(self.folder)


class WithParts(Recorded):
    """The harness in SUMO with a stopwatch around each of its parts."""

    def __init__(self, settings: Campaign, world: Callable[[Campaign], World]) -> None:
        super().__init__(settings, world)
        self._seconds: dict[str, float] = {}
        self._time(in_loop, "decide", "policy")
        for kernel in ("refill", "drive", "command", "judge"):
            self._time(loop, kernel, "dynamics of the AV, judge")
        self._time(self.world, "place", "refill")
        self._time(self.world, "_contacts", "collisions")
        self._time(self, "write", "recording")
        if shim := getattr(self.world, "_shim", None):
            self._time(shim, "step", "SUMO: set, step, get in one call")
        else:
            self._time(self.world, "_simulation_step", "SUMO step")
            self._time(self.world, "_tell", "set")
            self._time(self.world, "_require_equal", "get and compare")

    def _time(self, owner: object, method: str, part: str) -> None:
        setattr(owner, method, _timed(getattr(owner, method), part, self._seconds))

    def run(self, first: int, n: int) -> Work:
        self._seconds.clear()
        started = time.perf_counter()
        work = super().run(first, n)
        total = time.perf_counter() - started
        rest = total - sum(self._seconds.values())
        return work._replace(part_s={**self._seconds, "loop": rest})


def _timed(function: Callable[..., object], part: str, seconds: dict[str, float]) -> Callable[..., object]:
    def call(*args: object, **kwargs: object) -> object:
        nested = sum(seconds.values())
        started = time.perf_counter()
        result = function(*args, **kwargs)
        inner = sum(seconds.values()) - nested
        seconds[part] = seconds.get(part, 0.0) + time.perf_counter() - started - inner
        return result

    return call


LANES = np.array([[1, 1, 0]], np.int8)


class Floor(Contender):
    """SUMO's simulationStep alone: K cells whose vehicles keep an equal speed, nothing told, nothing read."""

    def __init__(self, settings: Campaign) -> None:
        self._prepared = prepare(resolve(settings))
        self._world = SumoWorld(settings.world.cells, shim=False)

    def run(self, first: int, n: int) -> Work:
        """As many full-length episodes as fit into whole rounds of K."""
        world, cells = self._world, self._world.n_cells
        rounds = max(1, n // cells)
        wall_s = cpu_s = 0.0
        for i in range(rounds):
            world.x[:] = [250.0, 200.0, 100.0]
            world.v[:] = self._prepared.paths(first + i * cells, cells).start["v_bv_mps"][:, None]
            world.place(np.arange(cells), world.x, world.v, np.tile(LANES, (cells, 1)))
            wall, cpu = time.perf_counter(), time.process_time()
            for _ in range(FLOOR_STEPS):
                world._api.simulationStep()
            wall_s += time.perf_counter() - wall
            cpu_s += time.process_time() - cpu
        return Work(rounds * cells, rounds * cells * FLOOR_STEPS, timed_s=(wall_s, cpu_s))

    def close(self) -> None:
        self._world.close()


class BareOneAtATime(Contender):
    """The usual way with no policy, no checks and no records: speeds told and values read, as fast as it can be."""

    def __init__(self, settings: Campaign) -> None:
        self._prepared = prepare(resolve(settings))
        self._world = in_libsumo()

    def run(self, first: int, n: int) -> Work:
        """Full-length episodes at constant speed."""
        cell = np.zeros(1, np.int64)
        for state in self._prepared.paths(first, n).start:
            x, v = np.array([[250.0, 200.0, 100.0]]), np.full((1, 3), state["v_bv_mps"])
            self._world.place(cell, x, v, LANES)
            for _ in range(FLOOR_STEPS):
                self._world.step(v, LANES)
        return Work(n, n * FLOOR_STEPS)

    def close(self) -> None:
        self._world.close()


class TwinAlone(Contender):
    """The twin without records."""

    def __init__(self, settings: Campaign) -> None:
        self._prepared = prepare(resolve(settings))
        self._loop = self._prepared.loop(TwinWorld(TWIN_CELLS))

    def run(self, first: int, n: int) -> Work:
        shard = self._loop.run(first, self._prepared.tests(first, n))
        return Work(n, int(shard.episode["n_steps"].sum()))


class Workers(Contender):
    """The runner's own worker processes, as `harness run` uses them."""

    def __init__(self, settings: Campaign, workers: int) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="harness-benchmark-"))
        self._pool = LocalWorkers(resolve(settings), workers)

    def run(self, first: int, n: int) -> Work:
        # As many shards of 2,500 episodes for every worker.
        n_shards = max(2, n // SHARD)
        specs = [ShardRequest(i, first + i * SHARD, SHARD) for i in range(n_shards)]
        results: Iterator[ShardResult] = self._pool.run(iter(specs), lambda _: None)
        for done in results:
            write_part(self._folder, [done.tables], done.request.first_episode, done.request.n_episodes)
        return Work(n_shards * SHARD, 0)

    def rows(self, n: int) -> None:  # starts the workers; their rows are on disk
        self.run(0, n)

    def close(self) -> None:
        self._pool.close()
        shutil.rmtree(self._folder)


def in_sumo(name: str, *, shim: bool, of: type[Recorded] = Recorded) -> Contender:
    """A campaign in the harness's SUMO world, with or without the compiled shim."""
    return of(campaign(name), lambda settings: SumoWorld(settings.world.cells, shim=shim))


def missing(name: str) -> str | None:
    """Why a contender cannot run here, in words; None if it can."""
    if name == "traci" and find_spec("sumo") is None:
        return "no sumo binary: pip install 'harness[sumo]'"
    if "shim" in name and shim_library() is None:
        return "no compiled shim: it is built at installation where there is a C++ compiler (pip install -e .)"
    return None


CONTENDERS: dict[str, tuple[Callable[[], Contender], int]] = {
    "harness": (lambda: in_sumo(NADE, shim=False), 5_000),
    "harness+shim": (lambda: in_sumo(NADE, shim=True), 5_000),
    "one-at-a-time": (lambda: Recorded(campaign(NADE), lambda _: in_libsumo()), 500),
    "bare one-at-a-time": (lambda: BareOneAtATime(campaign(NADE)), 1_000),
    "traci": (lambda: Recorded(campaign(NADE), lambda _: OverTraci(sumo_program("sumo", "traci"))), 50),
    "floor": (lambda: Floor(campaign(NADE)), 5_000),
    "recursive": (lambda: in_sumo("recursive", shim=False), 5_000),
    "recursive+shim": (lambda: in_sumo("recursive", shim=True), 5_000),
    "twin nade": (lambda: TwinAlone(campaign(NADE, **{"records.moments": "none"})), 50_000),
    "twin nde": (lambda: TwinAlone(campaign("nde")), 100_000),
    "twin recursive": (lambda: TwinAlone(campaign("recursive", **{"records.moments": "none"})), 40_000),
    "twin recorded": (
        lambda: Recorded(
            campaign(NADE, **{"world.engine": "twin", "world.cells": TWIN_CELLS}), lambda c: TwinWorld(c.world.cells)
        ),
        40_000,
    ),
    "1 worker": (lambda: Workers(campaign(NADE), 1), 5_000),
    "2 workers": (lambda: Workers(campaign(NADE), 2), 10_000),
    "parts": (lambda: in_sumo(NADE, shim=False, of=WithParts), 5_000),
    "parts+shim": (lambda: in_sumo(NADE, shim=True, of=WithParts), 5_000),
}
"""Name → how to build it, and episodes per measurement (about two seconds each)."""
