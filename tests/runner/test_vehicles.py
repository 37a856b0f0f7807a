"""Vehicles in runs: that fail just before contact, and with a bug that crashes share."""

from __future__ import annotations

import json

import pytest

from examples.idm import IDM
from examples.what_crashes_share import what_crashes_share
from tests.runner.conftest import SHELLS
from tests.stored_runs import ROOT, answer_in

FAILING = "av={controller: 'tests.runner.test_vehicles:RaisesBeforeContact'}"
TRUTH = json.loads((ROOT / "tests/reference/default.json").read_text())["crash_rate"]
BUSY = json.loads((ROOT / "docs/validation/nde_1e4.json").read_text())["crash_rate"]
METHODS = {
    "shells": (TRUTH, (*SHELLS, "stop.episodes=1500")),  # whose precision failed tests would soon have reached
    "forced": (TRUTH, ("testing.method=forced", "stop.episodes=2000", "records.moments=none")),
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [pytest.param(each, marks=[pytest.mark.slow] * (each != "shells")) for each in METHODS]
)
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
    assert any("tests FAILED; had they all crashed" in text for text in answer_in(result.folder)["warnings"])
    if found["rhw"] is not None:
        assert found["rhw"] == pytest.approx((found["ci_high"] - found["ci_low"]) / 2.0 / found["crash_rate"])


# -- examples/what_crashes_share.py: a bug at one speed shows --


class AtOneSpeed(IDM):
    """Does not brake where its speed at the cut-in is 30.0 to 30.5 m/s."""

    def start(self, episode):
        self.asleep = None

    def step(self, seen):
        self.asleep = 30.0 <= seen.speed_mps <= 30.5 if self.asleep is None else self.asleep
        return 0.0 if self.asleep else super().step(seen)


@pytest.mark.slow
def test_what_crashes_share(campaign, run_here, tmp_path):
    av = "av={controller: 'tests.runner.test_vehicles:AtOneSpeed', limits: {max_acceleration_mps2: 2}}"
    many = (*SHELLS, "world.engine=twin", "stop.episodes=1500", "records.traces=none", "records.trace_share=0", av)
    first = what_crashes_share(run_here(campaign(*many), tmp_path / "run").folder).iloc[0]
    assert (first["quantity"], first["share of crashes"], first["p_value"]) == ("AV speed, m/s", 1.0, 1 / 200)
    assert first["band"].left < 30.5
    assert first["band"].right > 30.0
