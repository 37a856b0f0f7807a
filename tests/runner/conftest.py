"""Small campaigns with the real policies, run once and looked at by many tests."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.pool import moved
from tests.in_process import run_here
from tests.pool.conftest import SMALL_POOL
from tests.stored_runs import MIXTURE_FILE

SMALL = ("stop.episodes=1600", "stop.rhw=null", "run.shard_size=80", "records.trace_share=0.05")
TWIN = ("world.engine=twin", "stop.episodes=400")
SHELLS = ("testing.method=shells", "stop.rhw=0.5", "stop.episodes=3000", "stop.min_crashes=null", *SMALL_POOL)


def campaign(*overrides: str) -> Campaign:
    """The smoke campaign in small, with overrides."""
    return load_campaign(MIXTURE_FILE, [*SMALL, *overrides])


@pytest.fixture(scope="session")
def sumo_run(stored_run) -> Path:
    """560 tests. Never written to: damage a copy."""
    return stored_run("mixture-seven")


@pytest.fixture(scope="session")
def twin_run(made_once) -> Path:
    """Its first 400 episodes in the twin. Never written to: damage a copy."""
    return made_once("twin", lambda out: run_here(campaign(*TWIN), out))


@pytest.fixture
def few_paths(monkeypatch) -> None:
    """Paths of other traffic enough for tests, kept where no other test finds them."""
    kept: dict[str, bytes] = {}
    monkeypatch.setattr(moved, "N_PATHS", 512)
    monkeypatch.setattr(moved, "cache", SimpleNamespace(read=kept.get, keep=kept.__setitem__))
