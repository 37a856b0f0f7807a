"""A small pool of the default environment, built once (about five seconds) and looked at by many tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.pool.build import campaign_pool
from harness.pool.cut_ins import Pool
from harness.resolved import resolve
from harness.traffic.laws import Environment
from harness.traffic.loading import load_environment

MIXTURE_FILE = Path(__file__).parents[2] / "scenarios" / "overtaking_mixture.yaml"
SMALL_POOL = ("pool.relative_error=0.03", "pool.cut_ins_per_shell=1500")


@pytest.fixture(scope="session")
def campaign() -> Campaign:
    return load_campaign(MIXTURE_FILE, ["testing.method=shells", *SMALL_POOL])


@pytest.fixture(scope="session")
def environment(campaign) -> Environment:
    return load_environment(campaign.environment)


@pytest.fixture(scope="session")
def pool(campaign) -> Pool:
    return campaign_pool(resolve(campaign))
