"""Campaigns where cut-ins take time, from the call to the page."""

from __future__ import annotations

import json

import numpy as np
import pytest

from harness import replay
from harness.errors import CampaignError
from harness.runner.look import check_av, plan_campaign
from studies.alarm import alarm_of_run
from tests.pool.conftest import SMALL_POOL
from tests.pool.test_vehicle_pool import ACTING
from tests.stored_runs import manifest, stored_table, unlike_columns

LEAD = "environment.cut_in_lead_s=0.5"
SHELLS = ("testing.method=shells", "pool.library=ladder-lateral-1", "stop.rhw=0.5", "stop.episodes=4000", LEAD)
SHELLS = (*SHELLS, "stop.min_crashes=null", "records.traces=crash", *SMALL_POOL)
COLUMNS = ["lead_steps", "onset_step", "onset_r2_m", "onset_r2dot_mps", "onset_ttc_s", "overlap_ttc_s", "contact"]


@pytest.fixture(scope="module")
def lateral_run(campaign, run_here, tmp_path_factory):
    """In SUMO, eight cells. Never written to."""
    out = tmp_path_factory.mktemp("lateral") / "run"
    return run_here(campaign(*SHELLS, "world.cells=8"), out)


def test_it_reaches_the_precision_and_the_twin_has_retraced_every_test(lateral_run):
    assert (lateral_run.exit_code, lateral_run.stopped_by) == (0, "rhw")
    retraced = manifest(lateral_run.folder)["retraced"]
    assert retraced["n_equal"] > 500
    assert retraced["compared"][:2] == ["onset_r2_m", "onset_r2dot_mps"]
    shells = lateral_run.estimates["estimates"]["shells"]
    assert shells["ci_low"] < 0.96e-7 < shells["ci_high"]  # the pool's own rate of this vehicle


def test_records_say_when_it_began_and_how_it_ended(lateral_run):
    episodes = stored_table(lateral_run.folder, "episodes")
    assert episodes.column_names[-8:-1] == COLUMNS
    rows = episodes.to_pylist()
    assert {row["lead_steps"] for row in rows} == {5}
    assert all(row["onset_step"] == max(row["cut_in_step"] - 5, 0) for row in rows)
    for row in rows:
        side = row["outcome"] == "crash" and row["n_steps"] == row["cut_in_step"] + 1
        assert row["contact"] == ("side" if side else "rear" if row["outcome"] == "crash" else None)
    traces = stored_table(lateral_run.folder, "traces").to_pandas()
    bv = traces[traces.vehicle == "BV"]
    assert bv.lateral_m.between(0.0, 1.7).all()
    assert (bv[bv.lane == 0].lateral_m == 1.7).all()
    assert (bv[bv.lane == 1].lateral_m < 1.7).all()
    assert (traces[traces.vehicle != "BV"].lateral_m == 0.0).all()


def test_a_test_is_replayed_bit_for_bit(lateral_run):
    episodes = stored_table(lateral_run.folder, "episodes").to_pylist()
    crashed = next(row["episode"] for row in episodes if row["outcome"] == "crash")
    again = replay(lateral_run.folder, crashed)
    assert again.bit_equal
    assert "traces" in again.compared
    assert again.row["onset_step"] is not None
    assert "lateral_m" in again.trace.column_names


@pytest.mark.usefixtures("lateral_run")  # it builds the pool
def test_stored_forced_tests_can_be_asked_what_surrogates_would_have_done(campaign, run_here, tmp_path):
    forced = campaign("testing.method=forced", "world.engine=twin", *SHELLS[1:], "stop.rhw=null", "stop.episodes=800")
    folder = run_here(forced, tmp_path / "run").folder
    assert manifest(folder)["n_episodes"] == 800
    assert alarm_of_run(folder)["p_value"] > 1e-3  # seed fixed; fails once in a thousand


def test_a_vehicle_that_acts_before_the_onset_is_tested_after_shadow_runs(campaign, run_here, tmp_path):
    """With forced cut-ins: in a test it must do what it did in its baseline run, through the step of the onset."""
    asked = ("testing.method=forced", "world.engine=twin", LEAD, "stop.rhw=null", "stop.episodes=120")
    speeds = f"av={ACTING.format('Speeds')}"
    forced, again = (
        run_here(campaign(*asked, speeds, f"world.cells={cells}"), tmp_path / str(cells)) for cells in (64, 5)
    )
    rows = stored_table(forced.folder, "episodes")
    assert rows.column("failure").null_count == rows.num_rows == 120
    assert set(rows.column("lead_steps").to_pylist()) == {5}
    assert unlike_columns(forced.folder, again.folder) == []


def test_av_check_looks_at_a_vehicle_from_the_onset_on_and_refuses_one_that_acts_before(campaign):
    with_lead, without = (check_av(campaign("world.engine=twin", *lead), 48) for lead in ((LEAD,), ()))
    assert with_lead.exit_code == 0
    assert with_lead.behaviour.n_crashes <= without.behaviour.n_crashes
    with pytest.raises(CampaignError, match="baseline runs"):
        check_av(campaign(LEAD, "testing.method=forced", f"av={ACTING.format('Speeds')}"), 4)


def test_check_says_what_is_within_reach(lateral_run, campaign):
    plan = plan_campaign(campaign(*SHELLS))
    said = {name: text for name, text in plan.items() if name.startswith("within_reach_of_")}
    assert set(said) == {f"within_reach_of_{name}" for name in ("assumption_free", "library", "sees-the-overlap")}
    assert all("upper limit" in text for text in said.values())
    assert 0 < plan["expected_tests"] < plan["most_tests"]
    assert plan["expected_seconds"] < plan["most_seconds"]
    assert (
        "until the limit is decided"
        in plan_campaign(campaign(*SHELLS, "accept.crash_rate_below=1e-7"))["expected_tests"]
    )
    assert plan_campaign(campaign(*SHELLS, "stop.rhw=null"))["expected_tests"] == plan["most_tests"]
    smallest = {name: float(text.split("some ")[1].split(" per test")[0]) for name, text in said.items()}
    assert smallest["within_reach_of_library"] < smallest["within_reach_of_assumption_free"] / 10.0
    shells = json.loads((lateral_run.folder / "shells.json").read_text(encoding="utf-8"))
    free = 1.6 * np.log(10.0) * sum(shells["cell_p"]) / (2.0 * 0.5 * 4000)
    assert smallest["within_reach_of_assumption_free"] == pytest.approx(free, rel=0.05)
