"""A run of shells that ends as soon as it knows on which side of a limit the crash rate lies."""

from __future__ import annotations

import pytest

from harness import estimate
from harness.errors import CampaignError
from harness.report.page import write_report
from tests.runner.test_shells_runs import SHELLS


@pytest.mark.parametrize(
    ("changes", "code", "verdict"),
    [
        (("accept.crash_rate_below=4e-7",), 0, "accepted"),
        (("accept.crash_rate_below=5e-8",), 5, "rejected"),
        (("accept.crash_rate_below=1.4e-7", "stop.episodes=300"), 4, "undecided"),
        (("accept={crash_rate_below: 4e-7, statement: library}",), 0, "accepted"),
    ],
)
def test_a_limit_ends_it_with_a_decision(campaign, run_here, tmp_path, changes, code, verdict):
    decided = run_here(campaign(*SHELLS, "world.engine=twin", *changes), tmp_path / "run")
    found = decided.estimates["decision"]
    assert (decided.exit_code, found["verdict"]) == (code, verdict)
    assert "accept.crash_rate_below" in decided.ending
    assert (decided.stopped_by == "accept") == (code != 4)
    assert estimate(decided.folder)["decision"] == found
    if code == 5:
        assert found["sentence"] in write_report(decided.folder).read_text(encoding="utf-8")
    assert found["statement"] == ("library" if "library" in changes[0] else "assumption_free")
    n_outside = decided.estimates["estimates"]["shells"]["details"]["statements"][0]["n_episodes_outside"]
    assert n_outside == 0 or "library" not in changes[0]


def test_a_second_limit_is_answered_and_said(campaign, run_here, tmp_path):
    """The first one that is asked again is no second one."""
    for limit, before in (("5e-8", []), ("5e-8", []), ("3e-8", [5e-8]), ("5e-8", [3e-8])):
        asked = campaign(*SHELLS, "world.engine=twin", f"accept.crash_rate_below={limit}")
        found = run_here(asked, tmp_path / "run", resume=(tmp_path / "run").exists()).estimates["decision"]
        assert (found["verdict"], found["asked_before"]) == ("rejected", before)
        assert ("This is the second limit asked of these tests" in found["sentence"]) == bool(before)


def test_nothing_is_accepted_given_what_the_vehicle_does_not_do(campaign, run_here, tmp_path):
    """SM-II crashes 8.8e-6 times per test, mostly outside, and brakes later than the need-based driver."""
    changes = (
        "accept={crash_rate_below: 1e-6, statement: need-based}",
        "av={model: fvdm, parameters: {min_acceleration_mps2: -1.0}}",
    )
    found = run_here(campaign(*SHELLS, "world.engine=twin", *changes), tmp_path / "run")
    assert (found.exit_code, found.stopped_by) == (4, "contradicted")
    assert found.estimates["decision"]["sentence"].startswith("UNDECIDED")
    assert "ask for accept.statement: assumption_free" in found.ending


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        (("testing.method=forced", "accept.crash_rate_below=1e-7"), "accept"),
        (("accept={crash_rate_below: 1e-7, statement: library}", "testing.shells.statement=need-based"), "statement"),
        (("accept.crash_rate_below=0",), "accept.crash_rate_below"),
        (("accept={crash_rate_below: 1e-7, statement: nobody}",), "nobody"),
    ],
)
def test_limits_that_cannot_be_decided_are_refused(campaign, run_here, tmp_path, changes, where):
    with pytest.raises(CampaignError, match=where):
        run_here(campaign(*SHELLS, "world.engine=twin", *changes), tmp_path / "run")
