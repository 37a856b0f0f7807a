"""A pool's probabilities are right, its shells divide all cut-ins, and every driver ends as it says."""

import dataclasses

import numpy as np
import pytest

from harness.campaign.files import load_campaign
from harness.campaign.sections import PoolSettings
from harness.families import family_named
from harness.families.cut_in.loading import load_environment
from harness.loop.loop import EpisodeLoop, RecordPolicy
from harness.pool.aim import NATURALISTIC_SHARE, Enumerator, aimed_points, fit_proposal
from harness.pool.build import build_pool, cached_pool, campaign_pool, campaign_pool_key, pool_name
from harness.pool.shells import Draw, PrescribedEpisodes, design_shells, pool_content, pool_from
from harness.resolved import resolve
from harness.vehicles.library import load_library
from harness.vocabulary import CRASH, PASSED
from harness.worlds.twin import TwinWorld
from tests.chains import SEED
from tests.golden.campaigns import LATERAL
from tests.pool.conftest import GOLDEN_POOL, MIXTURE_FILE, SMALL_POOL, enumerated

FORCED_RATE = 1.352e-7
"""Crash rate of the default vehicle, a_min -4 m/s², from tests/reference (relative error 0.42 %)."""


def test_surrogates_are_ordered_by_crash_rates_that_lie_around_the_reference(pool):
    """A vehicle between brakes-5 and brakes-3 was measured by another method, with other code and seeds."""
    ladder = ("brakes-8", "brakes-5", "brakes-3", "brakes-3-late-700ms", "fvdm-brakes-4", "brakes-2-late-1s")
    assert pool.names == (*ladder, "never-brakes", "full-throttle-2")
    assert np.all(np.diff(pool.mu) > 0.0)
    assert pool.mu[pool.names.index("brakes-5")] < FORCED_RATE < pool.mu[pool.names.index("brakes-3")]
    inside = pool.mu[: pool.names.index(pool.library.boundary) + 1]
    assert np.all(inside[1:] < 2.0 * inside[:-1])


def test_shells_divide_all_cut_ins(pool):
    assert pool.shell_p.sum() == pytest.approx(pool.p_event, rel=1e-12)
    assert pool.shell_p[0] == pytest.approx(pool.mu[0], rel=1e-12)
    assert np.all(np.cumsum(pool.shell_p[:-1]) >= pool.mu * (1.0 - 1e-12))  # crashes of one may lie in another's shell


def test_kept_cut_ins_stand_for_their_shell(pool):
    """Crash shares among the kept reproduce the crash rates: 1,500 of each shell, four standard errors."""
    c = pool.events
    for s in range(pool.shell_p.size - 1):
        assert c.crashes[pool.shell == s, s].all()
        assert not c.crashes[pool.shell == s, :s].any()
    assert not c.crashes[pool.shell == len(pool.names)].any()
    kept = np.bincount(pool.shell)
    for k in range(len(pool.names)):
        share = np.array([c.crashes[pool.shell == s, k].mean() for s in range(kept.size)])
        error = np.sqrt((pool.shell_p**2 * share * (1.0 - share) / kept).sum())
        assert abs(pool.shell_p @ share - pool.mu[k]) <= 4.0 * error + 1e-12 * pool.mu[k]


def test_what_changes_a_pool_changes_its_key():
    changes = ("seed=7", "environment.lane_change_level=2", "pool.library=ladder-lateral-1", "pool.seed=2")
    campaigns = (load_campaign(MIXTURE_FILE, [*SMALL_POOL, change]) for change in changes)
    assert len({campaign_pool_key(resolve(each)) for each in campaigns}) == len(changes)


@pytest.mark.slow
def test_a_pool_that_is_damaged_is_built_again(campaign, pool, tmp_path, monkeypatch):
    monkeypatch.setenv("HARNESS_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("harness.pool.build.build_pool", lambda *_: pool)
    assert cached_pool(resolve(campaign)) is None
    assert campaign_pool(resolve(campaign)) is pool
    path = tmp_path / pool_name(campaign_pool_key(resolve(campaign)))
    sound = path.read_bytes()
    for at in np.random.default_rng(SEED).integers(0, len(sound), 60).tolist():
        path.write_bytes(sound[:at] + bytes([sound[at] ^ 16]) + sound[at + 1 :])
        assert cached_pool(resolve(campaign)) is None
    assert campaign_pool(resolve(campaign)) is pool
    again = cached_pool(resolve(campaign))
    assert (again.key, again.names, again.library) == (pool.key, pool.names, pool.library)
    for field in dataclasses.fields(pool.events):
        assert np.array_equal(getattr(again.events, field.name), getattr(pool.events, field.name))
    assert np.array_equal(again.mu_covariance, pool.mu_covariance)
    assert again.to_json() == pool.to_json()


def test_draws_are_a_permutation_within_a_shell_and_follow_probabilities_outside(campaign, pool):
    prescribed = PrescribedEpisodes(resolve(campaign), pool)
    within, outermost = np.flatnonzero(pool.shell == 0), prescribed.design.n_inside
    assert prescribed.available[0] == within.size
    rows, stratum = prescribed.rows((Draw(0, 0, within.size), Draw(outermost, 0, 500)))
    assert sorted(rows[: within.size]) == within.tolist()
    assert np.array_equal(np.unique(stratum), [0, outermost])
    outside = rows[within.size :]
    assert len(set(outside.tolist())) == 500
    first_beyond = pool.names.index(pool.library.boundary) + 1
    beyond = pool.shell_p[first_beyond:-1]
    share, p = (pool.shell[outside] == first_beyond).mean(), beyond[0] / beyond.sum()
    assert abs(share - p) < 4.0 * np.sqrt(p * (1.0 - p) / 500)  # misses with probability 6e-5
    with pytest.raises(IndexError):
        prescribed.rows((Draw(0, within.size, 1),))


@pytest.mark.slow
def test_how_many_paths_a_pool_has_does_not_depend_on_them(campaign, monkeypatch):
    """One that ends where its paths look alike has the rates of paths that look alike, which are too low."""
    settings, run = PoolSettings(relative_error=0.015, events_per_shell=100), Enumerator.run
    resolved = resolve(campaign.replaced(("pool",), settings))

    def alike(self, first, n, progress):
        paths = run(self, first, n, progress)
        same = {"mass": np.full_like(paths.mass, 1e-9), "crashes": np.full_like(paths.crashes, 1)}
        return dataclasses.replace(paths, **same) if first else paths

    n_paths = build_pool(resolved, "of the paths").n_paths
    monkeypatch.setattr(Enumerator, "run", alike)
    assert build_pool(resolved, "of equal ones").n_paths == n_paths > 1024


def test_weights_of_a_proposal_make_up_for_its_aim():
    rng = np.random.default_rng(SEED)
    u = rng.random((4000, 3))
    proposal = fit_proposal(u, np.exp(-8.0 * u[:, 0]))
    points, weights = aimed_points(proposal, rng.random((20_000, 3)), rng.random(20_000))
    assert weights.max() <= 1.0 / NATURALISTIC_SHARE
    for f, mean in ((np.ones(20_000), 1.0), (points[:, 0], 0.5), (np.exp(-8.0 * points[:, 0]), -np.expm1(-8.0) / 8.0)):
        assert abs((weights * f).mean() - mean) < 4.0 * (weights * f).std() / np.sqrt(20_000)
    unweighted = np.exp(-8.0 * points[:, 0])
    assert unweighted.mean() > 1.5 * -np.expm1(-8.0) / 8.0  # it does aim


STRIDE = family_named("cut_in").stride
LIBRARY = load_library("ladder-2")


def test_a_stride_asks_the_same_cut_ins_and_each_stands_for_as_many(environment):
    """Over all offsets every cut-in is asked once, with the same answer, so that any sum has the same mean."""
    probability, crashes = enumerated(LIBRARY, environment, 40)
    strided = [enumerated(LIBRARY, environment, 40, stride=STRIDE, offset=offset) for offset in range(STRIDE)]
    assert np.array_equal(np.sum([p for p, _ in strided], axis=0), STRIDE * probability)
    assert np.array_equal(np.sum([c for _, c in strided], axis=0), crashes)
    assert np.max([p > 0.0 for p, _ in strided], axis=0).sum() > 1000


def test_strata_of_a_vehicle_that_may_accelerate_harder_include_what_the_envelope_survives(pool):
    within = design_shells(pool, 2.0)
    beyond = design_shells(pool, 2.5)
    assert within.p_unreachable == pytest.approx(pool.shell_p[-1])
    assert beyond.p_unreachable == pytest.approx(0.0, abs=1e-17)
    assert beyond.p[-1] == pytest.approx(within.p[-1] + pool.shell_p[-1])


# -- where cut-ins take time --


LADDER = load_library("ladder-lateral-1")
NAMES = list(LADDER.surrogates)
ENVELOPE = NAMES.index(LADDER.envelope)


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
    probability, crashes = enumerated(LADDER, environment, 150, enclosed=False)
    someone = crashes != 0
    assert someone.sum() > 3_000
    assert np.any(~someone & (probability > 0.0))  # there are cut-ins that nobody can make a crash of
    # Asked as one among many it stops where it has passed; as envelope it does not, and leaves nobody out.
    if lead_s == 4.0:
        assert np.any((crashes[someone] >> ENVELOPE) & 1 == 0)
    _, enclosed = enumerated(LADDER, environment, 150)
    others = ~np.int64(1 << ENVELOPE)
    assert np.array_equal(enclosed & others, crashes & others)
    assert np.all((enclosed[someone] >> ENVELOPE) & 1 == 1)


@pytest.mark.parametrize("name", [*NAMES, *LADDER.references])
def test_a_prescribed_episode_ends_as_the_pool_says(lateral, lateral_pool, name):
    """Sixty cut-ins of each stratum."""
    resolved = resolve(lateral)
    prescribed = PrescribedEpisodes(resolved, lateral_pool)
    rows, stratum = prescribed.rows(tuple(Draw(s, 0, 60) for s in range(prescribed.design.p.size)))
    traffic, events = prescribed.of_rows(rows, stratum), prescribed.events(rows)
    environment, rows = resolved.environment, events.row
    driver = (
        LADDER.followers(environment.lateral.present).drivers[[*NAMES, *LADDER.references].index(name)][None].copy()
    )
    if name == LADDER.envelope:  # it acts from the onset
        driver["perceives_lateral_m"] = driver["cruises"] = 0
    scenario = resolved.scenario._replace(driver=driver)
    episode = EpisodeLoop(TwinWorld(16), scenario, RecordPolicy("none", 0.0)).run(0, traffic).episode
    reached = episode["outcome"] == CRASH
    if name == LADDER.envelope:
        reached |= episode["outcome"] == PASSED
    column = [*lateral_pool.names, *LADDER.references].index(name)
    assert np.array_equal(reached, lateral_pool.events.crashes[rows, column])
    assert np.array_equal(episode["lead_steps"], lateral_pool.events.lead[rows])
    assert np.array_equal(episode["onset_step"], lateral_pool.events.onset[rows])


def test_leads_are_kept_with_the_pool(lateral_pool, pool):
    assert np.unique(lateral_pool.events.lead).size > 15
    for of_pool in (lateral_pool, pool):
        kept = pool_from(pool_content(of_pool), of_pool.library)
        assert np.array_equal(kept.events.lead, of_pool.events.lead)
    assert not pool.events.lead.any()
