"""Tests of a pool: the same bits in the twin, in SUMO and by `drive`, and crashes where the pool says so."""

from __future__ import annotations

import json
from contextlib import closing
from functools import cache

import numpy as np
import pytest

from harness.campaign.files import load_campaign
from harness.loop.loop import EpisodeLoop, RecordPolicy
from harness.records.schemas import chosen_from, episodes_table
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vehicles.library import load_library
from harness.vocabulary import CRASH, TIMEOUT
from harness.worlds.sumo import SumoWorld
from harness.worlds.twin import TwinWorld

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
