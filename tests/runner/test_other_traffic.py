"""Stored tests answered for other traffic: equal where it is the same, in proportion where rates are, else refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from harness.errors import CampaignError
from harness.families.cut_in.parameters import SHIPPED_FOLDER
from harness.pool.moved import OnPaths
from harness.progress import Progress
from harness.runner import stored_shells
from harness.runner.other_traffic import estimate_in_other_traffic
from harness.runner.stored_shells import StoredShells
from tests.golden.campaigns import LATERAL_FILE
from tests.stored_runs import answer as words
from tests.stored_runs import estimates, golden

SHIPPED = (SHIPPED_FOLDER / "ndd-overtaking-1.yaml").read_text()


def environment(folder: Path, **values: float) -> str:
    """The shipped environment with other numbers."""
    text = SHIPPED
    for name, value in values.items():
        text, n = re.subn(rf"(\n  {name}: {{value: )[-0-9.]+", rf"\g<1>{value}", text)
        assert n == 1
    (folder / "mine.yaml").write_text(text)
    return str(folder / "mine.yaml")


def answer(folder: Path, where: str) -> dict:
    return estimate_in_other_traffic(folder, where)["estimates"]["shells"]


def test_the_same_traffic_under_another_name_gives_the_same_answer(stored_run, tmp_path):
    folder = stored_run("shells-twin")
    told, stored = answer(folder, environment(tmp_path)), estimates(folder)["estimates"]["shells"]
    for key in ("crash_rate", "ci_low", "ci_high", "n_crashes"):
        assert told[key] == pytest.approx(stored[key], rel=1e-9)
    assert told["details"]["references"][0]["ratio"] == pytest.approx(stored["details"]["references"][0]["ratio"])


def test_the_rate_is_proportional_to_the_share_that_does_not_look(stored_run, tmp_path):
    """And the ratio to a driver in the same traffic does not move. The pool's error is 5 %, mostly of equal paths."""
    folder = stored_run("shells-twin")
    mine = environment(tmp_path, ignore_share=0.02)
    told, stored = answer(folder, mine), estimates(folder)["estimates"]["shells"]
    assert told["crash_rate"] == pytest.approx(2.0 * stored["crash_rate"], rel=0.05)
    ratios = [each["details"]["references"][0]["ratio"] for each in (told, stored)]
    assert ratios[0] == pytest.approx(ratios[1], rel=0.02)
    assert (
        "the same share of each shell" in words(estimate_in_other_traffic(folder, mine), golden("shells-twin"))["scope"]
    )


def test_cut_ins_that_no_test_stands_for_are_refused(stored_run, tmp_path):
    with pytest.raises(CampaignError, match="unlike any that was tested"):
        answer(stored_run("shells-twin"), environment(tmp_path, r2dot_min_mps=-16.0))


def test_a_vehicle_that_crashes_on_few_cut_ins_of_its_shells_is_refused(stored_run, tmp_path, monkeypatch):
    """Which these are may change: in other traffic, and a little in all that is close by, where there is a limit."""
    folder, mine = stored_run("shells-twin"), environment(tmp_path, ignore_share=0.02)
    tested = StoredShells.of(folder, Progress())
    share, p = tested.seen.tally.share, tested.design.p
    assert tested.mean_share == pytest.approx(np.average(share, weights=p * share))
    monkeypatch.setattr(stored_shells, "LEAST_SHARE", 0.0)
    assert tested.limit(p, at_worst=True) == tested.limit(p)
    monkeypatch.setattr(stored_shells, "LEAST_SHARE", 1.1)
    further = float(p @ ((share > 0.0) * (1.0 - share)))
    assert further > 0.0
    assert tested.limit(p, at_worst=True) == pytest.approx(tested.limit(p) + further, rel=0.05)
    with pytest.raises(CampaignError, match="of the events of the shells that it crashes in"):
        answer(folder, mine)


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_a_reference_driver_told_too_low_is_as_far_off_as_one_told_too_high(stored_run, monkeypatch, times):
    """Its rate moves, and the shells do not; the vehicle's factor is widened by as much to both sides."""
    tested = StoredShells.of(stored_run("shells-twin"), Progress())
    n_drivers, nothing = len(tested.design.references), np.zeros_like(tested.design.p)
    found = [OnPaths(tested.design.p, np.full(n_drivers, rate), nothing, np.zeros(())) for rate in (1.0, times)]
    monkeypatch.setattr(stored_shells.FewPaths, "of", lambda *_: iter([found.pop(0)]))
    (near,) = tested.nearby([{}], Progress())
    assert (near.rate, near.off) == (1.0, pytest.approx(1.0))
    assert near.references == pytest.approx(times)


@pytest.mark.parametrize(
    ("name", "where", "found"),
    [
        ("shells-twin", LATERAL_FILE, "in which events take time"),
        ("forced-twin", "ndd-overtaking-1", "tests by forced"),
        ("shells-acting-twin", "ndd-overtaking-1", "acts before the event"),
        ("shells-twin", "nowhere", "which is not shipped"),
    ],
)
def test_what_cannot_be_answered_is_refused(stored_run, name, where, found):
    with pytest.raises(CampaignError, match=found):
        answer(stored_run(name), where)
