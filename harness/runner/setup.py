"""Compile what a first campaign needs, by running two small ones in the twin: once per version of the harness."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from harness import cache
from harness.campaign.files import load_campaign
from harness.compiled import KERNELS
from harness.progress import Progress
from harness.runner.run import run_campaign

_SMALL = [
    "world.engine=twin", "pool.relative_error=0.2", "pool.events_per_shell=100", "stop.rhw=null", "stop.episodes=200",
]  # fmt: skip
_CONTROLLER = """class Holds:
    def step(self, seen):
        return 0.0
"""


def compile_kernels(progress: Progress | None = None) -> bool:
    """Compile all kernels of the default method, for built-in vehicles and for controllers; False where it was done.

    The cache keeps them. Where it cannot be written this says nothing: the first run compiles them again.
    """
    done = f"{KERNELS}/all"
    if cache.has(done):
        return False
    with TemporaryDirectory() as folder:
        controller = Path(folder) / "holds.py"
        controller.write_text(_CONTROLLER)
        vehicles, progress = ("idm", f"{controller}:Holds"), progress or Progress()
        progress.stage("compiling", len(vehicles))
        for number, vehicle in enumerate(vehicles):
            run_campaign(load_campaign(vehicle, _SMALL), Path(folder) / str(number), workers=1)
            progress.advance(1)
    cache.keep(done, b"")
    return True
