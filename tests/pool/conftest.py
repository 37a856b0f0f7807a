"""A small pool of the default environment, built once (about five seconds) and looked at by many tests."""

import numpy as np
import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.families.cut_in.events import enumerate_cut_ins
from harness.families.cut_in.laws import Environment, InitialStates
from harness.families.cut_in.loading import load_environment
from harness.families.protocol import Paths
from harness.pool.build import campaign_pool
from harness.pool.shells import Pool
from harness.resolved import resolve
from harness.vehicles.drivers import Followers
from tests.chains import SEED
from tests.stored_runs import MIXTURE_FILE

SMALL_POOL = ("pool.relative_error=0.03", "pool.events_per_shell=1500")
GOLDEN_POOL = ("pool.relative_error=0.05", "pool.events_per_shell=400")
"""That of golden runs: paths for baseline runs, whose candidates take ten seconds, are those which there are."""


@pytest.fixture(scope="session")
def campaign() -> Campaign:
    return load_campaign(MIXTURE_FILE, ["testing.method=shells", *SMALL_POOL])


@pytest.fixture(scope="session")
def environment(campaign) -> Environment:
    return load_environment(campaign.environment)


@pytest.fixture(scope="session")
def pool(campaign) -> Pool:
    return campaign_pool(resolve(campaign))


def enumerated(library, environment: Environment, n: int, *, enclosed=True, stride=1, offset=0):
    """Probability of each cut-in of n paths, and who crashes on it; with or without an envelope that is asked first."""
    states, offsets = InitialStates(environment.numbers).draw(SEED, 0, n), np.full(n, offset)
    followers = library.followers(environment.lateral.present)
    if not enclosed:  # the envelope is one among many then, which takes over at the onset as before
        followers.drivers["cruises"][followers.envelope] = 0
        followers = Followers(followers.drivers)
    paths = Paths(np.arange(n), states)
    found = enumerate_cut_ins(environment, SEED, paths, followers, stride=stride, offset=offsets)
    return found.probability, found.crashes
