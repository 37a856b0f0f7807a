"""The core knows no family: one of its own, with rates that one can add up, goes through all of it."""

from __future__ import annotations

import json
from importlib.metadata import EntryPoint
from typing import NamedTuple

import numpy as np
import pytest

import harness
from harness import families
from harness.campaign.files import load_campaign
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vehicles.sideways import TO_OVERLAP_M
from tests.families.fake import FAKE, P_EVENT, RATE
from tests.in_process import run_here
from tests.stored_runs import ROOT

INSTALLED = families.families.__wrapped__
SMOKE = ROOT / "scenarios" / "smoke.yaml"
SMALL = (
    "scenario=fake",
    "environment.parameters=two-events",
    "run.shard_size=500",
    "pool.relative_error=0.02",
    "pool.events_per_shell=4000",
)


@pytest.fixture(autouse=True)
def _fake_is_known(monkeypatch):
    known = {**families.families(), "fake": FAKE}
    monkeypatch.setattr(families, "families", lambda: known)


def estimate(out, *overrides: str):
    """Headline of a run, and its folder."""
    campaign = load_campaign(SMOKE, [*SMALL, *overrides])
    run_here(campaign, out)
    return json.loads((out / "estimates.json").read_text())["estimates"], harness.read(out)


@pytest.mark.parametrize("engine", ["twin", "sumo"])
@pytest.mark.parametrize("method", ["nde", "forced"])
def test_naturalistic_and_forced_tests_have_the_exact_rate(method, engine, tmp_path):
    """Within four standard errors, in the twin and in SUMO: a false alarm in 16,000."""
    n = 6000 if engine == "twin" else 1500
    stop = f"stop={{episodes: {n}, rhw: null}}"
    found, run = estimate(tmp_path / "run", f"testing.method={method}", stop, f"world.engine={engine}")
    episodes = run.episodes()
    share = 1.0 if method == "forced" else P_EVENT
    spread = np.sqrt(share * (1.0 - share) / n) if share < 1.0 else 1e-12
    assert abs(episodes["event_step"].notna().mean() - share) < 4.0 * spread
    weighed = np.where(episodes["outcome"] == "crash", np.exp(episodes["log_weight"]), 0.0)
    assert abs(weighed.mean() - RATE) < 4.0 * weighed.std() / np.sqrt(n)
    headline = found["nde" if method == "nde" else "nade"]
    assert headline["crash_rate"] == pytest.approx(weighed.mean(), rel=1e-12)
    assert set(episodes["event"]) <= {-1, 0, 1}


@pytest.mark.parametrize("engine", ["twin", "sumo"])
def test_the_pool_knows_the_rate_and_a_run_of_shells_finds_it(engine, tmp_path):
    resolved = resolve(load_campaign(SMOKE, [*SMALL, "testing.method=shells"]))
    source = prepare(resolved)
    assert source.design.p_event == pytest.approx(P_EVENT, rel=0.1)
    assert source.design.p.sum() == pytest.approx(RATE, rel=0.1)  # on the others nobody could crash
    found, run = estimate(tmp_path / "run", "testing.method=shells", f"world.engine={engine}", "stop.rhw=0.1")
    assert found["shells"]["ci_low"] < RATE < found["shells"]["ci_high"]
    assert found["shells"]["crash_rate"] == pytest.approx(RATE, rel=0.1)
    crashed = run.episodes().query("outcome == 'crash'")
    assert set(crashed["gap_m"]) == {8.0}
    page = harness.write_report(tmp_path / "run").read_text()
    assert ("<caption>The hardest impacts, the most typical" in page, "r157-cc</code> avoids" in page) == (True, False)
    again = harness.replay(tmp_path / "run", int(crashed["episode"].iloc[0]))
    assert again.row["outcome"] == "crash"


class Table(NamedTuple):
    probability: object


def test_the_hash_of_a_traffic_is_of_all_its_numbers_or_the_family_is_told_to_make_its_own():
    known = FAKE.digest(Table(np.array([0.1, 0.2])))
    assert known == FAKE.digest(Table(np.array([0.1, 0.2])))
    assert known != FAKE.digest(Table(np.array([0.1, 0.3]))) != FAKE.digest(Table(np.array([[0.1], [0.3]])))
    with pytest.raises(TypeError, match=r"dict in a traffic is no number: .* digest of its own"):
        FAKE.digest(Table({"a": 0.1}))


def test_how_far_a_vehicle_moves_sideways_is_said_by_its_family_unless_it_comes_over_into_the_lane_or_nobody_does():
    class Another(type(FAKE)):
        crosses = -1

    assert (FAKE.sideways_m(None), Another().sideways_m(None)) == (TO_OVERLAP_M, 0.0)
    Another.principal, Another.crosses = 1, 0
    with pytest.raises(NotImplementedError, match="fake says how far its vehicle 0 moves"):
        Another().sideways_m(None)


def test_an_installed_package_brings_a_family_by_an_entry_point(monkeypatch):
    entry = EntryPoint("fake", "tests.families.fake:FAKE", families.GROUP)
    monkeypatch.setattr(families, "entry_points", lambda *, group: [entry] if group == families.GROUP else [])
    assert set(INSTALLED()) == {"cut_in", "lead_brakes", "cut_out", "fake"}
    assert INSTALLED()["fake"] is FAKE
