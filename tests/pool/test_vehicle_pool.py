"""The pool of a vehicle that acts before the cut-in: its own hazard, and surrogates that take over from it."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from harness.campaign.files import load_campaign
from harness.errors import HarnessError
from harness.estimators.tally import CrashedTests, OnRuns, Tally
from harness.families.cut_in.events import enumerate_cut_ins
from harness.families.protocol import Paths, Recorded
from harness.loop.judge import motion_hashes
from harness.pool.shells import CANDIDATES
from harness.pool.vehicle_pool import EVENLY, chances, vehicle_pool
from harness.records.folder import SHADOW
from harness.resolved import resolve
from harness.sampling import prepare
from harness.sampling.paths import as_recorded, requests_before, run_baseline, without_event
from harness.strata import weight_of_a_test
from harness.vehicles.drivers import Followers, driver_records
from harness.vocabulary import CRASH
from harness.worlds.twin import TwinWorld
from tests.kernels import cut_in_terms
from tests.pool.conftest import GOLDEN_POOL, MIXTURE_FILE

ACTING = "{{controller: 'tests.controllers.early:{}', before_event: controller, limits: {{max_acceleration_mps2: 2}}}}"


def acting(name: str, *more: str):
    av = ACTING.format(name)
    overrides = ["testing.method=shells", f"av={av}", "world.engine=twin", "pool.shadow_paths=120", *GOLDEN_POOL]
    return load_campaign(MIXTURE_FILE, [*overrides, *more])


def prepared_after(campaign):
    """The campaign after its baseline runs, its loop, and what the runs left."""
    ready = prepare(resolve(campaign))
    loop = ready.loop(TwinWorld(32))
    specs = requests_before(SHADOW, len(ready.baseline_paths))
    tables = [run_baseline(loop, ready.baseline_paths, ready.resolved, spec).table for spec in specs]
    runs = as_recorded(pa.concat_tables(tables), ready.scenario.max_steps)
    ready.begin_after(runs)
    return ready, loop, runs


@pytest.fixture(scope="module")
def speeds():
    return prepared_after(acting("Speeds"))


def test_probabilities_are_those_of_the_states_that_were_driven(speeds):
    """Against the hazard at the states of a trace, worked out one by one."""
    ready, loop, runs = speeds
    rows, seed = slice(0, 10), ready.baseline_paths.seed
    paths = Paths(*(column[rows] for column in ready.baseline_paths.paths))
    shard = without_event(loop, ready.resolved, seed, paths, 0)
    some = Recorded._make(values[rows] for values in runs)
    nobody = Followers(driver_records([]))
    probability = enumerate_cut_ins(ready.resolved.environment, seed, paths, nobody, some).probability
    for row in range(10):
        trace, stays = shard.traces[row], 1.0
        for step in range(len(trace) - 1):
            (lv, bv, av), (v_lv, v_bv, v_av) = trace[step, :, 0], trace[step, :, 1]
            state = (v_bv, lv - 5.0 - bv, v_lv - v_bv, bv - 5.0 - av, v_bv - v_av)
            cut = -np.expm1(-cut_in_terms(state)[0, 2])
            assert probability[row, step] == pytest.approx(stays * cut, rel=1e-9)
            stays *= 1.0 - cut
        assert np.all(probability[row, len(trace) - 1 :] == 0.0)


@pytest.mark.slow
def test_a_vehicle_that_is_a_surrogate_from_the_cut_in_on_crashes_where_that_one_does(speeds):
    """The loop drives what the pool has worked out: script, motion and hash agree, and every outcome."""
    ready, _, _ = speeds
    pool = vehicle_pool(ready.resolved, ready.baseline_paths, speeds[2])
    brakes = "av.parameters={min_acceleration_mps2: -3.0}"
    loop = prepare(resolve(acting("Speeds", brakes))).loop(TwinWorld(64))
    rows = np.unique(np.linspace(0, len(pool.events.path) - 1, 1500).astype(np.int64))
    rows = rows[pool.shell[rows] < pool.shell_p.size - 1]
    shard = loop.run(10**6, ready.prescribed.of_rows(rows, np.zeros(rows.size, np.int64)))
    assert shard.failures == {}
    crashed = shard.episode["outcome"] == CRASH
    expected = pool.events.crashes[rows, pool.names.index("brakes-3")]
    assert 300 < expected.sum() < rows.size - 300
    np.testing.assert_array_equal(crashed, expected)


def test_weights_of_the_chosen_paths_keep_every_mean():
    """Sum over candidates of chance times weight is the candidates' mean, whatever is averaged; no weight above 10."""
    rng = np.random.default_rng(1)
    rates = rng.exponential(size=(4000, 3)) * (rng.random((4000, 1)) < 0.01)
    chance = chances(rates, np.ones(3))
    weight = 1.0 / (len(rates) * chance)
    assert chance.sum() == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose((chance * weight) @ rates, rates.mean(0), rtol=1e-12)
    assert weight.max() <= 1.0 / EVENLY + 1e-9
    assert CANDIDATES % 1024 == 0
    np.testing.assert_allclose(chances(np.zeros((10, 2)), np.ones(2)), 0.1)


@pytest.mark.slow
def test_shells_of_a_holder_on_few_chosen_paths_are_those_of_the_large_pool(campaign, pool):
    """Each within four standard errors (false alarm for 9 numbers below 1e-3), which are 13 % at most, mostly 3 %."""
    ready, _, runs = prepared_after(acting("HoldsBatch", "pool.shadow_paths=1000"))
    own = vehicle_pool(ready.resolved, ready.baseline_paths, runs)
    order = [own.names.index(name) for name in pool.names]
    error = np.sqrt(np.diag(own.mu_covariance)[order] + np.diag(pool.mu_covariance))
    assert np.all(error < 0.13 * pool.mu)
    assert np.median(error / pool.mu) < 0.05
    assert np.all(np.abs(own.mu[order] - pool.mu) < 4.0 * error)
    assert abs(own.p_event - pool.p_event) < 4.0 * np.hypot(own.p_event_se, pool.p_event_se)
    assert abs(own.p_held - pool.p_event) < 4.0 * np.hypot(own.p_held_se, pool.p_event_se)


@pytest.mark.parametrize("kept", [500, 5_000])
def test_kept_cut_ins_know_the_error_of_the_runs_they_are_of(speeds, kept):
    """All of them tested, on which surrogates crash: the pool knows E[G²] of those. Own masses alone, without what a
    kept one stands for, would be up to 9 % too small at 500 a shell: more than the whole variance."""
    ready, _, runs = speeds
    settings = ready.campaign.pool.model_copy(update={"events_per_shell": kept})
    asked = replace(ready.resolved, campaign=ready.campaign.model_copy(update={"pool": settings}))
    pool = vehicle_pool(asked, ready.baseline_paths, runs)
    c, none, n = pool.events, np.zeros((0, 0)), np.bincount(pool.shell, minlength=pool.shell_p.size)
    for d, name in enumerate(pool.names):
        crash = c.crashes[:, d]
        tests = CrashedTests(c.row[crash], c.step[crash], c.mass[crash], pool.shell[crash])
        crashes = np.bincount(pool.shell[crash], minlength=n.size)
        of_all = Tally(n, crashes, 0 * n, none, none, OnRuns.of(pool.n_paths, n.size, tests))
        square = pool.mu_covariance[d, d] * pool.n_paths + pool.mu[d] ** 2
        assert of_all.runs.square(weight_of_a_test(pool.shell_p, of_all.tests), of_all) == pytest.approx(
            square, rel=0.025
        ), name


def test_hashes_tell_motions_apart_from_the_first_step_that_differs_on():
    x, v = np.linspace(100.0, 500.0, 201)[None, :].repeat(3, 0), np.full((3, 201), 30.0)
    x[1, 77] = np.nextafter(x[1, 77], 1e9)
    v[2, 200] = -0.0
    hashes = motion_hashes(x, v)
    assert hashes.shape == (3, 200)
    assert np.all((hashes[0] == hashes[1]) == (np.arange(200) < 76))
    assert np.all((hashes[0] == hashes[2]) == (np.arange(200) < 199))
    assert np.unique(hashes[0]).size == 200


def test_a_vehicle_that_never_moves_is_refused(speeds):
    ready, _, runs = speeds
    parked = runs._replace(n_steps=np.zeros_like(runs.n_steps), failed=np.ones_like(runs.failed))
    with pytest.raises(HarnessError, match="no event on 120 paths"):
        vehicle_pool(ready.resolved, ready.baseline_paths, parked)
