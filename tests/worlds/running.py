"""Campaigns and episodes in worlds of SUMO and in the twin: AVs that others drive, and controllers plugged in."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.campaign.vehicle import AutomatedVehicle, Limits, TraciProcess
from harness.loop.loop import Shard
from harness.resolved import resolve
from harness.sampling import prepare
from harness.worlds import World, build_world
from harness.worlds.twin import TwinWorld
from tests.stored_runs import ROOT

EXAMPLE = ROOT / "examples" / "traci_client" / "idm_client.py"
MISBEHAVING = Path(__file__).parent / "misbehaving_client.py"
SMALL = ("testing.method=forced", "records={moments: none, traces: all}")


def smoke(*overrides: str) -> Campaign:
    """The episode mixture with overrides."""
    return load_campaign(ROOT / "scenarios/overtaking_mixture.yaml", ["stop.rhw=null", *overrides])


def campaign(av: AutomatedVehicle, *, cells: int = 4, episodes: int = 100) -> Campaign:
    sizes = (f"world.cells={cells}", f"stop.episodes={episodes}", f"run.shard_size={episodes}")
    return smoke(*SMALL, *sizes).model_copy(update={"av": av})


def sumo_av(**attributes) -> AutomatedVehicle:
    return AutomatedVehicle(sumo=attributes)


def program(*words: str | Path, connect_time_s: float = 60.0, restarts: int = 3, step_time_s: float = 60.0):
    command = " ".join([sys.executable, *map(str, words), "--port {port} --cells {cells}"])
    traci = TraciProcess(command=command, connect_time_s=connect_time_s, restarts=restarts)
    return AutomatedVehicle(traci=traci, limits=Limits(step_time_s=step_time_s))


def run_in(world, av: AutomatedVehicle, ranges: Sequence[tuple[int, int]]) -> list[Shard]:
    """Run ranges (first episode, number) one after another in a world, which is then closed."""
    prepared = prepare(resolve(campaign(av)))
    with closing(world):
        loop = prepared.loop(world, traces="all")
        return [loop.run(first, prepared.tests(first, n)) for first, n in ranges]


def run(av: AutomatedVehicle, first: int, n: int, *, cells: int = 4) -> Shard:
    """Episodes in a world of their own, as a campaign would have it."""
    return run_in(build_world(campaign(av, cells=cells)), av, [(first, n)])[0]


def run_idm(first: int, n: int) -> Shard:
    return run_in(TwinWorld(8), AutomatedVehicle(), [(first, n)])[0]


def bits(shard: Shard, row: int) -> bytes:
    record = shard.episode[row].copy()
    record["took_over_step"] = 0  # nobody knows that of one whom others drive
    return record.tobytes() + shard.traces[row].tobytes()


def forced(*overrides: str) -> Campaign:
    """Forced cut-ins."""
    return smoke("testing={method: forced}", "world.engine=twin", *overrides)


def drive(*overrides: str, cells: int = 32, first: int = 0, n: int = 150, world: World | None = None) -> Shard:
    """Run episodes from the first on, all of them traced, in the twin or in another world."""
    ready = prepare(resolve(forced(*overrides)))
    with closing(ready.loop(world or TwinWorld(cells), traces="all")) as loop:
        return loop.run(first, ready.tests(first, n))


def motion(*overrides: str, **options) -> tuple[bytes, list[bytes]]:
    """Every bit of episodes that do not fail, and of their traces."""
    shard = drive(*overrides, **options)
    assert shard.failures == {}
    return shard.episode.tobytes(), [shard.traces[row].tobytes() for row in sorted(shard.traces)]


def fmu_av(file: str | Path, more: str = "") -> str:
    """YAML of the FMU of the examples, with further keys."""
    inputs = "{speed_mps: v, lead_speed_mps: v_lead, gap_m: gap, set_speed_mps: v_set}"
    return f"{{fmu: {{file: '{file}', inputs: {inputs}, output: a}}{more}}}"
