"""The pool where cut-ins take time: what it says of every driver is what the episode loop drives."""

import numpy as np
import pytest

from harness.campaign.files import load_campaign
from harness.families.cut_in.loading import load_environment
from harness.loop.loop import EpisodeLoop, RecordPolicy
from harness.pool.build import campaign_pool
from harness.pool.kept import pool_content, pool_from
from harness.pool.shells import Draw, PrescribedEpisodes
from harness.resolved import resolve
from harness.vehicles.library import load_library
from harness.vocabulary import CRASH, PASSED
from harness.worlds.twin import TwinWorld
from tests.golden.campaigns import LATERAL
from tests.pool.conftest import GOLDEN_POOL, MIXTURE_FILE, enumerated

LIBRARY = load_library("ladder-lateral-1")
NAMES = list(LIBRARY.surrogates)
ENVELOPE = NAMES.index(LIBRARY.envelope)


def of(*overrides: str):
    return load_campaign(
        MIXTURE_FILE, ["testing.method=shells", *GOLDEN_POOL, "pool.library=ladder-lateral-1", *overrides]
    )


@pytest.fixture(scope="module")
def lateral():
    return of(LATERAL)


@pytest.fixture(scope="module")
def lateral_pool(lateral):
    return campaign_pool(resolve(lateral))


@pytest.mark.parametrize("lead_s", [0.0, None, 4.0])
def test_full_throttle_contains_every_driver_also_where_it_passes(lateral, lead_s):
    settings = lateral.environment.model_copy(update={"cut_in_lead_s": lead_s})
    environment = load_environment(settings)
    probability, crashes = enumerated(LIBRARY, environment, 150, enclosed=False)
    someone = crashes != 0
    assert someone.sum() > 3_000
    assert np.any(~someone & (probability > 0.0))  # there are cut-ins that nobody can make a crash of
    # Asked as one among many it stops where it has passed; as envelope it does not, and leaves nobody out.
    if lead_s == 4.0:
        assert np.any((crashes[someone] >> ENVELOPE) & 1 == 0)
    _, enclosed = enumerated(LIBRARY, environment, 150)
    others = ~np.int64(1 << ENVELOPE)
    assert np.array_equal(enclosed & others, crashes & others)
    assert np.all((enclosed[someone] >> ENVELOPE) & 1 == 1)


@pytest.mark.parametrize("name", [*NAMES, *LIBRARY.references])
def test_a_prescribed_episode_ends_as_the_pool_says(lateral, lateral_pool, name):
    """Sixty cut-ins of each stratum."""
    resolved = resolve(lateral)
    prescribed = PrescribedEpisodes(resolved, lateral_pool)
    traffic, events = prescribed.tests(tuple(Draw(s, 0, 60) for s in range(prescribed.design.p.size)))
    environment, rows = resolved.environment, events.row
    driver = (
        LIBRARY.followers(environment.lateral.present).drivers[[*NAMES, *LIBRARY.references].index(name)][None].copy()
    )
    if name == LIBRARY.envelope:  # it acts from the onset
        driver["perceives_lateral_m"] = driver["cruises"] = 0
    scenario = resolved.scenario._replace(driver=driver)
    episode = EpisodeLoop(TwinWorld(16), scenario, RecordPolicy("none", 0.0)).run(0, traffic).episode
    reached = episode["outcome"] == CRASH
    if name == LIBRARY.envelope:
        reached |= episode["outcome"] == PASSED
    column = [*lateral_pool.names, *LIBRARY.references].index(name)
    assert np.array_equal(reached, lateral_pool.events.crashes[rows, column])
    assert np.array_equal(episode["lead_steps"], lateral_pool.events.lead[rows])
    assert np.array_equal(episode["onset_step"], lateral_pool.events.onset[rows])


def test_leads_are_kept_with_the_pool(lateral_pool, pool):
    assert np.unique(lateral_pool.events.lead).size > 15
    for of_pool in (lateral_pool, pool):
        kept = pool_from(pool_content(of_pool), of_pool.library)
        assert np.array_equal(kept.events.lead, of_pool.events.lead)
    assert not pool.events.lead.any()
