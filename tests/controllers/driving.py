"""Episodes in the twin with a controller plugged in."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from harness.campaign.campaign import Campaign
from harness.episode.loop import Shard
from harness.resolved import resolve
from harness.sampling import prepare
from harness.worlds import World
from harness.worlds.twin import TwinWorld
from tests.worlds.running import smoke

LATERAL = "environment.parameters=ndd-overtaking-1-lateral"


def forced(*overrides: str) -> Campaign:
    """Forced cut-ins."""
    return smoke("testing={method: forced}", "world.engine=twin", *overrides)


def drive(*overrides: str, cells: int = 32, first: int = 0, n: int = 150, world: World | None = None) -> Shard:
    """Run episodes from the first on, all of them traced, in the twin or in another world."""
    ready = prepare(resolve(forced(*overrides)))
    with closing(ready.loop(world or TwinWorld(cells), traces="all")) as loop:
        return loop.run(first, ready.states(first, n))


def motion(*overrides: str, **options) -> tuple[bytes, list[bytes]]:
    """Every bit of episodes that do not fail, and of their traces."""
    shard = drive(*overrides, **options)
    assert shard.failures == {}
    return shard.results.episode.tobytes(), [shard.traces[row].tobytes() for row in sorted(shard.traces)]


def fmu_av(file: str | Path, more: str = "") -> str:
    """YAML of the FMU of the examples, with further keys."""
    inputs = "{speed_mps: v, lead_speed_mps: v_lead, gap_m: gap}"
    return f"{{fmu: {{file: '{file}', inputs: {inputs}, output: a}}{more}}}"
