"""A few hundred episodes in the twin, as a shard and as tables; settings differ by test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.episode.loop import Shard
from harness.records.schemas import ShardTables, shard_tables
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.worlds.twin import TwinWorld

MIXTURE_FILE = Path(__file__).parents[2] / "scenarios" / "overtaking_mixture.yaml"


class Recorded(NamedTuple):
    campaign: Campaign
    shard: Shard
    tables: ShardTables


@pytest.fixture(scope="session")
def record() -> Callable[..., Recorded]:
    """Run episodes ``first`` … of the smoke campaign with overrides, in the twin."""

    def recorded(*overrides: str, first: int = 0, n: int = 300, n_cells: int = 32) -> Recorded:
        campaign = load_campaign(MIXTURE_FILE, ["stop.rhw=null", *overrides])
        prepared = prepare(resolve(campaign))
        shard = prepared.loop(TwinWorld(n_cells)).run(first, prepared.states(first, n))
        keep = campaign.records.traces != "none" or campaign.records.trace_share > 0.0
        return Recorded(campaign, shard, shard_tables(shard, campaign.seed, keep_traces=keep))

    return recorded
