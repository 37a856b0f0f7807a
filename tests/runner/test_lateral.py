"""Campaigns where cut-ins take time, from the call to the page."""

from __future__ import annotations

import pytest

from harness.errors import CampaignError
from harness.runner.look import check_av, plan_campaign
from studies.alarm import alarm_of_run
from tests.in_process import run_here as run_golden
from tests.pool.test_vehicle_pool import ACTING
from tests.stored_runs import golden, stored_table

LEAD = "environment.cut_in_lead_s=0.5"
COLUMNS = ["lead_steps", "onset_step", "onset_r2_m", "onset_r2dot_mps", "onset_ttc_s", "overlap_ttc_s", "contact"]


def test_records_say_when_it_began_and_how_it_ended(stored_run):
    folder = stored_run("shells-lateral-twin")
    episodes = stored_table(folder, "episodes")
    assert episodes.column_names[-8:-1] == COLUMNS
    rows = episodes.to_pylist()
    assert len({row["lead_steps"] for row in rows}) > 1
    assert all(row["onset_step"] == max(row["cut_in_step"] - row["lead_steps"], 0) for row in rows)
    for row in rows:
        side = row["outcome"] == "crash" and row["n_steps"] == row["cut_in_step"] + 1
        assert row["contact"] == ("side" if side else "rear" if row["outcome"] == "crash" else None)
    traces = stored_table(folder, "traces").to_pandas()
    bv = traces[traces.vehicle == "BV"]
    assert bv.lateral_m.between(0.0, 1.7).all()
    assert (bv[bv.lane == 0].lateral_m == 1.7).all()
    assert (bv[bv.lane == 1].lateral_m < 1.7).all()
    assert (traces[traces.vehicle != "BV"].lateral_m == 0.0).all()


def test_stored_forced_tests_can_be_asked_what_surrogates_would_have_done(tmp_path):
    lateral = ("pool.library=ladder-lateral-1", "environment.lane_change_level=1", "stop.episodes=800")
    run_golden(golden("forced-lateral-twin", *lateral, "records.traces=none"), tmp_path / "run")
    assert alarm_of_run(tmp_path / "run")["p_value"] > 1e-3  # seed fixed; fails once in a thousand


def test_av_check_looks_at_a_vehicle_from_the_onset_on_and_refuses_one_that_acts_before(campaign):
    with_lead, without = (check_av(campaign("world.engine=twin", *lead), 48) for lead in ((LEAD,), ()))
    assert with_lead.exit_code == 0
    assert with_lead.behaviour.n_crashes <= without.behaviour.n_crashes
    with pytest.raises(CampaignError, match="baseline runs"):
        check_av(campaign(LEAD, "testing.method=forced", f"av={ACTING.format('Speeds')}"), 4)


def test_check_says_how_many_tests_are_expected():
    def plan(*more: str):
        return plan_campaign(golden("shells-lateral-twin", "stop.rhw=0.5", "stop.episodes=4000", *more))

    asked = plan()
    assert 0 < asked["expected_tests"] < asked["most_tests"]
    assert asked["expected_seconds"] <= asked["most_seconds"]
    assert "until the limit is decided" in plan("accept.crash_rate_below=1e-7")["expected_tests"]
    assert plan("stop.rhw=null")["expected_tests"] == asked["most_tests"]
