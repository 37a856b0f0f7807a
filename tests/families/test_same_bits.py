"""Tests of a pool: the same bits in twin, SUMO and `drive`, crashes where it says so; ways of drawing agree."""

from __future__ import annotations

import json
from contextlib import closing
from functools import cache

import numpy as np
import pytest

import harness
from harness.campaign.drivers import Reaction
from harness.campaign.files import load_campaign
from harness.errors import CampaignError
from harness.loop.loop import EpisodeLoop, RecordPolicy
from harness.records.schemas import chosen_from, episodes_table
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vehicles.library import load_library
from harness.vocabulary import CRASH, TIMEOUT
from harness.worlds.sumo import SumoWorld
from harness.worlds.twin import TwinWorld
from tests.in_process import run_here
from tests.kernels import steps_late

SMALL = ("pool.relative_error=0.2", "pool.events_per_shell=200")
LADDERS = {"lead_brakes": load_library("ladder-lead-1"), "cut_out": load_library("ladder-cut-out-1")}
DRIVERS = [(name, who) for name, one in LADDERS.items() for who in (*one.surrogates, *one.references)]
CARELESS = {"lead_brakes": "1-5s-brakes-4", "cut_out": "0-5s-blind-late-1s"}
"""Drivers who crash in some third of the pool's events."""


def resolved_of(name: str, driver: str | None = None, *more: str):
    """A campaign of a small pool; a driver of the family's ladder is the AV."""
    given = []
    if driver is not None:
        who = (LADDERS[name].surrogates | LADDERS[name].references)[driver]
        given = [f"av={json.dumps(who.model_dump())}"]
    return resolve(load_campaign("idm", [f"scenario={name}", *SMALL, *given, *more]))


@cache
def source_of(name: str):
    """What tests of a family are drawn from."""
    return prepare(resolved_of(name))


def some(name: str, n: int):
    """Rows of the pool, evenly from all shells."""
    kept = source_of(name).pool.events
    return kept, np.unique(np.linspace(0, len(kept.at) - 1, n).astype(np.int64))


def run(world, resolved, traffic, keep="none"):
    """Tests in 16 cells, which are used again."""
    with closing(world(16, resolved.scenario.vehicles)) as opened:
        return EpisodeLoop(opened, resolved.scenario, RecordPolicy(keep, 0.0)).run(0, traffic)


def of_rows(name, rows):
    return source_of(name).prescribed.of_rows(rows, np.zeros(len(rows), np.int64))


def require_same(one, other):
    """Equal in every bit of records and motion."""
    assert one.episode.tobytes() == other.episode.tobytes()
    first, second = (repr(episodes_table(each, 1).to_pydict()) for each in (one, other))
    assert first == second
    assert one.traces.keys() == other.traces.keys()
    for row, trace in one.traces.items():
        assert np.array_equal(trace.view(np.int64), other.traces[row].view(np.int64))


@pytest.mark.parametrize("name", LADDERS)
def test_sumo_and_the_twin_have_the_same_bits(name):
    """Also where cells are used again after a crash, in which vehicles run through each other."""
    resolved, (_, rows) = resolved_of(name, CARELESS[name]), some(name, 100)
    rows = np.random.default_rng(1).permutation(rows)
    sumo, twin = (run(world, resolved, of_rows(name, rows), "all") for world in (SumoWorld, TwinWorld))
    require_same(sumo, twin)
    outcome = twin.episode["outcome"]
    assert set(outcome) == {CRASH, TIMEOUT}
    assert 0.2 < (outcome == CRASH).mean() < 0.9


@pytest.mark.parametrize(("name", "driver"), DRIVERS)
def test_a_driver_crashes_as_the_av_where_the_pool_says_that_it_does(name, driver):
    """And `drive`, by which replays show it, says the same, step for step."""
    resolved, (kept, rows) = resolved_of(name, driver), some(name, 300)
    library, pool_names = LADDERS[name], [*source_of(name).pool.names, *LADDERS[name].references]
    shard = run(TwinWorld, resolved, of_rows(name, rows), "all")
    crashed = shard.episode["outcome"] == CRASH
    said = kept.crashes[rows, pool_names.index(driver)]
    assert np.array_equal(crashed, said)
    followers = library.followers(False).drivers
    place = [*library.surrogates, *library.references].index(driver)
    chosen = chosen_from(episodes_table(shard, 1), resolved.family)
    start = np.full((len(rows), 2), np.nan)
    end = resolved.family.drive(resolved.environment, chosen, start, followers[[place]]).end[:, 0]
    assert np.array_equal(end, np.where(crashed, shard.episode["n_steps"], -1))
    for row in (*np.flatnonzero(crashed)[:3], *np.flatnonzero(~crashed)[:3]):
        one = type(chosen)._make(column[[row]] for column in chosen)
        driven = resolved.family.drive(resolved.environment, one, start[:1], followers[[place]], last=True)
        steps, trace = int(shard.episode["n_steps"][row]), shard.traces[row]
        assert trace[:, -1, :2].tobytes() == np.ascontiguousarray(driven.motion[0, : steps + 1]).tobytes()
        principal = trace[:, resolved.family.principal, :2]
        assert principal.tobytes() == np.ascontiguousarray(driven.ahead[: steps + 1]).tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("name", LADDERS)
def test_sumo_and_the_twin_have_the_same_bits_in_many_tests(name):
    """Of all events of other paths, a tenth of them in which nothing happens."""
    resolved, n = resolved_of(name, CARELESS[name], "testing.method=forced", "world.cells=64"), 2000
    source, crashes = prepare(resolved), 0
    for first in range(0, 200_000, n):
        shards = [run(world, resolved, source.tests(first, n)) for world in (SumoWorld, TwinWorld)]
        assert shards[0].episode.tobytes() == shards[1].episode.tobytes()
        crashes += (shards[0].episode["outcome"] == CRASH).sum()
    assert crashes > 20


# -- ways of drawing --


OFTEN = {"lead_brakes": "brakes-2-late-1s", "cut_out": "never-brakes"}
"""Drivers who crash in some hundredths, and some thousandths, of all tests without a choice of events."""


def campaign_of(name: str, method: str, *more: str):
    who = LADDERS[name].surrogates[OFTEN[name]]
    av = f"av={json.dumps(who.model_dump())}"
    small = (*SMALL, f"testing.method={method}", "world.engine=twin", "records.traces=none", "run.shard_size=1000")
    return load_campaign("idm", [f"scenario={name}", av, *small, *more])


@pytest.mark.parametrize("name", LADDERS)
@pytest.mark.slow
def test_naturalistic_forced_and_shells_have_the_rate_of_the_pool(name, tmp_path):
    """Within four standard errors of both; a false alarm in 16,000."""
    pool, n = source_of(name).pool, 4000
    place = pool.names.index(OFTEN[name])
    rate, rate_se = pool.mu[place], np.sqrt(pool.mu_covariance[place, place])
    stop, share = f"stop={{episodes: {n}, rhw: null}}", {"forced": 1.0, "nde": pool.p_event}
    for method in ("nde", "forced"):
        run_here(campaign_of(name, method, stop), out := tmp_path / method)
        tests = harness.read(out).episodes()
        weighed = np.where(tests["outcome"] == "crash", np.exp(tests["log_weight"]), 0.0)
        assert abs(weighed.mean() - rate) < 4.0 * np.hypot(rate_se, weighed.std() / np.sqrt(n))
        happened = tests["event"] >= 0
        assert np.array_equal(happened, tests["event_step"].notna())
        spread = np.sqrt(share[method] * (1.0 - min(share[method], 1.0)) / n) + pool.p_event_se
        assert abs(happened.mean() - share[method]) < 4.0 * spread + 1e-12
        assert set(tests["outcome"]) <= {"crash", "timeout"}
    run_here(campaign_of(name, "shells", "stop.rhw=0.2"), out := tmp_path / "shells")
    found = json.loads((out / "estimates.json").read_text())["estimates"]["shells"]
    half = 0.5 * (found["ci_high"] - found["ci_low"])
    assert abs(found["crash_rate"] - rate) < 3.0 * half


@pytest.mark.parametrize("name", LADDERS)
def test_an_inattentive_driver_is_an_attentive_one_or_a_late_one(name):
    """C3: test by test, so that its rate is (1 - q) times the one's and q times the other's."""
    kinds = {"attentive": {}, "late": {"delay_s": 2.5}}
    q = {"inattention_probability": 0.4, "inattention_delay_s": 2.5}
    crashed = {}
    for kind, reaction in {**kinds, "both": q}.items():
        av = f"av={json.dumps({'model': 'idm', 'parameters': {'time_headway_s': 0.6}, 'reaction': reaction})}"
        resolved, source = resolved_of(name, None, av), source_of(name)
        rows = np.linspace(0, len(source.pool.events.at) - 1, 400).astype(np.int64)
        traffic = source.prescribed.of_rows(rows, np.zeros(len(rows), np.int64))
        crashed[kind] = run(TwinWorld, resolved, traffic).episode["outcome"] == CRASH
    late = steps_late(Reaction(**q), len(rows), seed=resolved.scenario.seed) > 0
    assert 0.3 < late.mean() < 0.5
    assert np.array_equal(crashed["both"], np.where(late, crashed["late"], crashed["attentive"]))
    assert (crashed["late"] != crashed["attentive"]).sum() > 20


CONTROLLER = "examples.idm:IDM"
REFUSED = {
    "testing.method=step_mixture": r"testing\.method.*importance functions are those of cut-ins",
    f"av={{controller: '{CONTROLLER}', before_event: controller}}": r"av\.before_event.*means nothing there",
    f"av={{controller: '{CONTROLLER}', takes_over: onset}}": r"av\.takes_over: found onset.*means nothing there",
    f"av={{controller: '{CONTROLLER}', warm_up_s: 20}}": r"av\.warm_up_s: found 20\.0.*means nothing there",
    "av={model: r157-fsm}": r"av\.model.*has not been tried",
    "environment.lane_change_level=2": "environment.*numbers of cut-ins",
    "pool.library=ladder-2": r"pool\.library, r157-fsm",
    "environment.parameters=ndd-overtaking-2": r"environment\.parameters",
    "scenario=lead_break": "Write --set scenario=lead_brakes",
}


@pytest.mark.parametrize("name", LADDERS)
@pytest.mark.parametrize("asked", REFUSED)
def test_what_does_not_go_together_is_refused_with_one_error(name, asked):
    with pytest.raises(CampaignError, match=REFUSED[asked]) as caught:
        prepare(resolve(load_campaign("idm", [f"scenario={name}", "stop.rhw=null", asked])))
    assert str(caught.value).count("expected") == 1


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("av={model: r157-cc, parameters: {time_headway_s: natural}}", r"av\.parameters\.time_headway_s"),
        ("pool.library=ladder-lead-1", "pool.library, r157-cc.*a natural headway"),
    ],
)
def test_headways_that_people_keep_are_those_of_vehicles_that_follow(asked, words):
    with pytest.raises(CampaignError, match=words) as caught:
        prepare(resolve(load_campaign("idm", [asked, "scenario=cut_in"])))
    assert str(caught.value).count("expected") == 1
