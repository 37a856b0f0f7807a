"""Compile kernels by small campaigns in the twin, and build the default pool: once per version of the harness."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from harness import cache
from harness.campaign.files import load_campaign
from harness.compiled import KERNELS
from harness.families import R157
from harness.processes import Child, WorkerDeath, first_to_answer, tell
from harness.progress import Progress
from harness.runner.run import run_campaign

_SHORT = "world.engine=twin", "stop.rhw=null", "stop.episodes=200"
_SMALL = *_SHORT, "pool.relative_error=0.2", "pool.events_per_shell=100"
_CONTROLLER = """class Holds:
    def step(self, seen):
        return 0.0
"""
_OTHERS = [
    ("idm", *_SMALL, "testing.method=step_mixture", "environment.parameters=ndd-overtaking-1"),
    *(("idm", *_SMALL, f"scenario={name}", "testing.method=forced") for name in R157[1:]),
]


def compile_kernels(progress: Progress | None = None) -> bool:
    """Compile what campaigns of all methods and scenarios need, on two cores; False if that was done before.

    One process builds the pool that most first campaigns need once it has compiled, while the other still compiles. All
    is kept in the cache; where that cannot be written there is no error, and the first run compiles again.
    """
    done = f"{KERNELS}/all"
    if cache.has(done):
        return False
    progress = progress or Progress()
    with TemporaryDirectory() as folder:
        controller = Path(folder) / "holds.py"
        controller.write_text(_CONTROLLER)
        campaigns = [(f"{controller}:Holds", *_SMALL), ("idm", *_SHORT)]
        progress.stage("compiling, and building a pool of cut-ins", None)
        child = Child(tell, partial(_run_all, _OTHERS, Path(folder) / "others"))
        try:
            _run_all(campaigns, Path(folder))
            died = isinstance(first_to_answer([child]).answer(), WorkerDeath)
        finally:
            child.kill()
    if not died:  # as for want of memory: the next call tries again
        cache.keep(done, b"")
    return True


def _run_all(campaigns: Sequence[tuple[str, ...]], folder: Path) -> None:
    for number, (vehicle, *settings) in enumerate(campaigns):
        run_campaign(load_campaign(vehicle, settings), folder / str(number), workers=1)
