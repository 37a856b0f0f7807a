"""Runs that pages are made of: golden campaigns, somewhat longer, with what would change from day to day set."""

from __future__ import annotations

from pathlib import Path

from harness.campaign.files import load_campaign
from tests.golden.campaigns import BASE, FAILING, FORCED, MIXTURE, RUNS, SHELLS
from tests.in_process import run_here
from tests.stored_runs import edit, of_before

TWIN = "world.engine=twin"
SHARDS = (TWIN, "run.shard_size=1000", "records.moments=first_9", "records.traces=crash", "stop.rhw=0.1")
UNTRACED = (TWIN, "records.traces=none", "records.moments=none", "stop.rhw=0.1")
PAGES = {
    "weighted": (MIXTURE, *SHARDS, "stop.episodes=3000"),
    "no_crash": (
        FORCED,
        *SHARDS,
        "run.shard_size=20",
        "stop.episodes=40",
        "seed=11",
        "av.parameters.min_acceleration_mps2=-8",
    ),
    "nde": RUNS["nde-twin"],
    "failed": (MIXTURE, *UNTRACED, FAILING, "stop.episodes=300"),
    "shells": (*SHELLS, *UNTRACED, FAILING, "stop.episodes=300"),
    "shells_refuted": RUNS["shells-refuted"],
    "shells_inside_only": (*SHELLS, *UNTRACED, "testing.shells.statement=library", "stop.episodes=240"),
}
FIXED = {
    "created": "2025-01-02T03:04:05Z",
    "versions": {"harness": "0.1.0", "python": "3.11.9", "numpy": "2.1.0", "libsumo": "1.28.0"},
    "cpu": "Some CPU @ 3.0 GHz",
    "wall_time_s": 71.3,
    "workers": 2,
}
"""Of the manifest."""


def write_run(folder: Path, name: str) -> Path:
    """Run it into the folder, and return that: without checksums, so that a test may change files."""
    run_here(load_campaign(BASE, PAGES[name]), folder)
    edit(folder, **FIXED)
    return of_before(folder)
