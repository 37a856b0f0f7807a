"""Episodes in the twin with a controller plugged in."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.episode.loop import Shard
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.worlds import World
from harness.worlds.twin import TwinWorld

ROOT = Path(__file__).parents[2]
LATERAL = "environment.parameters=ndd-overtaking-1-lateral"


def forced(*overrides: str) -> Campaign:
    """Forced cut-ins."""
    changes = ["testing={method: forced}", "world.engine=twin", "stop.rhw=null", *overrides]
    return load_campaign(ROOT / "scenarios/overtaking_mixture.yaml", changes)


def drive(*overrides: str, cells: int = 32, first: int = 0, n: int = 150, world: World | None = None) -> Shard:
    """Run episodes from the first on, all of them traced, in the twin or in another world."""
    ready = prepare(resolve(forced(*overrides)))
    with closing(ready.loop(world or TwinWorld(cells), traces="all")) as loop:
        return loop.run(first, ready.states(first, n))


def fmu_av(file: str | Path, more: str = "") -> str:
    """YAML of the FMU of the examples, with further keys."""
    inputs = "{speed_mps: v, lead_speed_mps: v_lead, gap_m: gap}"
    return f"{{fmu: {{file: '{file}', inputs: {inputs}, output: a}}{more}}}"
