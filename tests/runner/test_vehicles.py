"""Vehicles in runs: that fail just before contact, beside the need-based driver, and with a bug that crashes share."""

from __future__ import annotations

import json

import numpy as np
import pytest

from examples.idm import IDM
from examples.what_crashes_share import what_crashes_share
from harness import replay
from harness.campaign.drivers import NeedBasedParameters
from harness.vehicles.kinematics import CONTACT_M, VEHICLE_LENGTH_M
from tests.runner.conftest import SHELLS
from tests.stored_runs import ROOT, stored_table, unlike_columns

FAILING = "av={controller: 'tests.runner.test_vehicles:RaisesBeforeContact'}"
TRUTH = json.loads((ROOT / "tests/reference/default.json").read_text())["crash_rate"]
BUSY = json.loads((ROOT / "docs/validation/nde_1e4.json").read_text())["crash_rate"]
METHODS = {
    "shells": (TRUTH, (*SHELLS, "stop.episodes=1500")),  # whose precision failed tests would soon have reached
    "forced": (TRUTH, ("testing.method=forced", "stop.episodes=4000", "records.moments=none")),
    "episode_mixture": (TRUTH, ("testing.method=episode_mixture", "stop.episodes=2000")),
    "nde": (BUSY, ("testing.method=nde", "environment.lane_change_level=1e4", "stop.episodes=8000")),
}


class RaisesBeforeContact(IDM):
    """The built-in IDM; in three of four episodes it raises in the step before contact."""

    def start(self, episode):
        self.raises = episode.episode % 4 != 0

    def step(self, seen):
        if self.raises and seen.gap_m + 0.1 * (seen.lead_speed_mps - seen.speed_mps) < 0.0:
            raise RuntimeError("no room")
        return super().step(seen)


@pytest.mark.parametrize("method", METHODS)
def test_the_interval_holds_what_may_have_happened(method, campaign, run_here, tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    truth, settings = METHODS[method]
    tested = campaign("world.engine=twin", "run.max_failed_share=1", "run.shard_size=1000", *settings, FAILING)
    result = run_here(tested, tmp_path / "run")
    assert (result.exit_code, result.stopped_by) == (4 if method == "shells" else 0, "episodes")
    content = result.estimates
    found = content["estimates"][content["headline"]]
    assert found["details"]["n_failed"] > 0
    assert found["crash_rate"] < 0.6 * truth
    assert found["ci_low"] <= truth <= found["ci_high"]
    assert truth <= found["upper_bound"]
    assert found["details"]["crash_rate_if_failed_had_crashed"] > 0.6 * truth
    assert any("tests FAILED; had they all crashed" in text for text in content["answer"]["warnings"])
    if found["rhw"] is not None:
        assert found["rhw"] == pytest.approx((found["ci_high"] - found["ci_low"]) / 2.0 / found["crash_rate"])


# -- a driver beside the AV: equal to a walk of its own, in both worlds, and never ahead of itself --


BESIDE = (*SHELLS, "stop.episodes=400", "stop.rhw=null", "testing.shells.first_tests=50")
TWIN = "world.engine=twin"
EQUAL = "av={model: need-based}"
KEEN = "{min_acceleration_mps2: -2.0, acceleration_mps2: 6.0, time_headway_s: 0.6}"
FASTER = f"av={{model: idm, parameters: {KEEN}, reaction: {{delay_s: 0.3}}}}"


def walked_beside(trace, cut_in_step: int) -> int | None:
    """Step after which the AV was first ahead of the need-based driver, from the trace, in plain Python."""
    p = NeedBasedParameters()
    of = {name: trace[trace["vehicle"] == name].sort_values("step") for name in ("AV", "BV")}
    x_av, x_bv, v_bv = of["AV"]["x_m"].to_numpy(), of["BV"]["x_m"].to_numpy(), of["BV"]["v_mps"].to_numpy()
    first = cut_in_step + 1
    x, v, needed_since = x_av[first], of["AV"]["v_mps"].to_numpy()[first], None
    for step in range(first, len(x_av) - 1):
        gap, closing = x_bv[step] - VEHICLE_LENGTH_M - x, v - v_bv[step]
        if gap < CONTACT_M:
            return None
        room = 2.0 * (gap - p.standstill_gap_m)
        needs = closing > 0.0 and closing**2 >= p.needed_mps2 * room
        needed_since = step if needs and needed_since is None else needed_since
        a = p.acceleration_mps2
        if needs and step - needed_since >= 5:
            a = -min(closing**2 / room, p.deceleration_mps2) if room > 0.0 else -p.deceleration_mps2
        after = max(v + 0.1 * a, 0.0)
        x, v = x + 0.05 * (v + after), after
        if x_av[step + 1] > x + 1e-6:
            return step + 1
    return None


@pytest.fixture(scope="module")
def faster(campaign, run_here, tmp_path_factory):
    """A vehicle that brakes too little, in the twin, with all its motion."""
    return run_here(campaign(*BESIDE, TWIN, FASTER, "records.traces=all"), tmp_path_factory.mktemp("faster") / "run")


def test_it_is_ahead_where_a_plain_walk_says_so(faster):
    episodes = stored_table(faster.folder, "episodes").to_pandas()
    traces = stored_table(faster.folder, "traces").to_pandas()
    ahead, motion = 0, dict(list(traces.groupby("episode")))
    for row in episodes.itertuples():
        expected = walked_beside(motion[row.episode], int(row.cut_in_step))
        assert (None if np.isnan(row.ahead_step) else int(row.ahead_step)) == expected, row.episode
        ahead += expected is not None
    assert 10 < ahead < len(episodes) - 10


def test_the_statement_says_so_where_it_matters(faster):
    """A vehicle that is ahead and never comes within 4 s of a collision does no harm; one that crashes has."""
    need = faster.estimates["estimates"]["shells"]["details"]["statements"][1]
    tests = stored_table(faster.folder, "episodes").to_pandas()
    was_ahead, crashed = tests["ahead_step"].notna(), tests["outcome"] == "crash"
    ahead = (was_ahead & (crashed | (tests["min_ttc_s"] < 4.0))).to_numpy()
    assert 0 < (was_ahead & crashed).sum() < ahead.sum() < was_ahead.sum()
    assert (need["n_checked"], need["n_ahead"]) == (400, ahead.sum())
    assert need["ahead_in"] == np.flatnonzero(ahead)[:10].tolist()
    first = need["ahead_in"][0]
    assert (
        replay(faster.folder, first).row["ahead_step"]
        == stored_table(faster.folder, "episodes").column("ahead_step")[first].as_py()
    )


def test_the_boundary_itself_is_never_ahead_in_sumo_or_twin(campaign, run_here, tmp_path):
    """Bit for bit the same motion; and both worlds leave the same rows."""
    twin, sumo = (
        run_here(campaign(*BESIDE, EQUAL, f"world.engine={engine}"), tmp_path / engine) for engine in ("twin", "sumo")
    )
    assert [name for name in unlike_columns(twin.folder, sumo.folder) if name != "estimates.json"] == []
    tests = stored_table(sumo.folder, "episodes")
    assert tests.column("ahead_step").null_count == tests.num_rows
    assert tests.column("outcome").to_pylist().count("crash") > 100


# -- examples/what_crashes_share.py: a bug at one speed shows, a vehicle that fails at random has nothing in common --


MANY = (*SHELLS, TWIN, "stop.episodes=1500", "records.traces=none", "records.trace_share=0")
BAND_MPS = (30.0, 30.5)


class AtOneSpeed(IDM):
    """Does not brake where its speed at the cut-in is 30.0 to 30.5 m/s."""

    def start(self, episode):
        self.asleep, self.draw = None, episode.random.random()

    def step(self, seen):
        self.asleep = self.fails(seen.speed_mps) if self.asleep is None else self.asleep
        return 0.0 if self.asleep else super().step(seen)

    def fails(self, speed_mps):
        return BAND_MPS[0] <= speed_mps <= BAND_MPS[1]


class AtRandom(AtOneSpeed):
    """Does not brake in one cut-in of fifty, whatever it is like."""

    def fails(self, speed_mps):
        return self.draw < 0.02


@pytest.mark.parametrize("vehicle", ["AtOneSpeed", "AtRandom"])
def test_what_crashes_share(vehicle, campaign, run_here, tmp_path):
    av = f"av={{controller: 'tests.runner.test_vehicles:{vehicle}', limits: {{max_acceleration_mps2: 2}}}}"
    first = what_crashes_share(run_here(campaign(*MANY, av), tmp_path / "run").folder).iloc[0]
    if vehicle == "AtRandom":
        assert first["p_value"] > 0.01
        return
    assert (first["quantity"], first["share of crashes"], first["p_value"]) == ("AV speed, m/s", 1.0, 1 / 200)
    assert first["band"].left < BAND_MPS[1]
    assert first["band"].right > BAND_MPS[0]
