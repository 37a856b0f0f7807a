"""SUMO allows one simulation per process: whoever opens a world here gets it closed again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign

MIXTURE_FILE = Path(__file__).parents[2] / "scenarios" / "overtaking_mixture.yaml"


@pytest.fixture
def open_world() -> Iterator[Callable]:
    """Make SUMO worlds that are closed after the test, whatever happens in it."""
    from harness.worlds.sumo import SumoWorld

    worlds: list[SumoWorld] = []

    def make(*arguments, **options) -> SumoWorld:
        worlds.append(SumoWorld(*arguments, **options))
        return worlds[-1]

    yield make
    for world in reversed(worlds):
        world.close()


@pytest.fixture(scope="session")
def smoke() -> Callable[..., Campaign]:
    """The smoke campaign, with overrides."""
    return lambda *overrides: load_campaign(MIXTURE_FILE, ["stop.rhw=null", *overrides])
