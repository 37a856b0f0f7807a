"""A vehicle that fails just before contact: its interval holds the crash rate of the same vehicle that drives on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from examples.idm import IDM
from tests.pool.conftest import SMALL_POOL

ROOT = Path(__file__).parents[2]
FAILING = "av={controller: 'tests.runner.test_failed_both_ways:RaisesBeforeContact'}"
TRUTH = json.loads((ROOT / "tests/reference/default.json").read_text())["crash_rate"]
BUSY = json.loads((ROOT / "docs/validation/nde_1e4.json").read_text())["crash_rate"]
METHODS = {
    "shells": (TRUTH, ("testing.method=shells", "stop.rhw=null", "stop.episodes=1500", *SMALL_POOL)),
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
    content = run_here(tested, tmp_path / "run").estimates
    found = content["estimates"][content["headline"]]
    assert found["details"]["n_failed"] > 0
    assert found["crash_rate"] < 0.6 * truth
    assert found["ci_low"] <= truth <= found["ci_high"]
    assert truth <= found["upper_bound"]
    assert found["details"]["crash_rate_if_failed_had_crashed"] > 0.6 * truth
    assert "FAILED: they count as no crash in the rate and as crashes in the upper limit" in content["statement"]
    if found["rhw"] is not None:
        assert found["rhw"] == pytest.approx((found["ci_high"] - found["ci_low"]) / 2.0 / found["crash_rate"])


def test_a_precision_is_not_reached_on_the_word_of_failed_tests(campaign, run_here, tmp_path, monkeypatch):
    """Without them the interval would be narrow enough after the first tests."""
    monkeypatch.chdir(ROOT)
    asked = ("testing.method=shells", "stop.rhw=0.5", "stop.episodes=1500", "stop.min_crashes=null", *SMALL_POOL)
    result = run_here(campaign("world.engine=twin", "run.max_failed_share=1", *asked, FAILING), tmp_path / "run")
    assert (result.exit_code, result.stopped_by) == (4, "episodes")
    assert result.ending.startswith("Stopped after 1,500 tests without stop.rhw (0.5): stop.episodes was spent")
    assert result.estimates["ending"] == result.ending
