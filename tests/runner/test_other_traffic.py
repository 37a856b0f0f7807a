"""Stored tests answered for other traffic: rates in proportion, what a fit leaves open, what an answer depends on."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from harness.campaign.sections import EnvironmentSettings
from harness.cli import main
from harness.errors import CampaignError, HarnessError
from harness.estimators.answer import _of_rate, estimate_blocks
from harness.estimators.traffic import ONE_LAW, uncertain
from harness.families.cut_in.loading import load_parameters
from harness.families.cut_in.parameters import SHIPPED_FOLDER
from harness.pool import moved
from harness.pool.moved import OnPaths, assumed
from harness.progress import Progress
from harness.report.rows import bar_note
from harness.report.summary import read_run_folder
from harness.resolved import resolve
from harness.runner import other_traffic, stored_shells
from harness.runner.other_traffic import Move, bar_of, bar_of_readings, estimate_in_other_traffic, moves, sensitivity
from harness.runner.stored_shells import Nearby, StoredShells
from harness.strata import Assumed, Reference
from tests.golden.campaigns import LATERAL_FILE
from tests.stored_runs import answer, copy_of, estimates, golden, manifest
from tests.traffic.tables import TEXT, fitted
from tests.traffic.tables import TEXT as SHIPPED

pytestmark = pytest.mark.usefixtures("few_paths")
LOOK = "cut_in__ignore_share"


def told(content):
    return answer(content, golden("shells-twin"))


@pytest.mark.slow
def test_the_rate_moves_with_the_share_that_does_not_look_and_the_ratio_does_not(stored_run, tmp_path):
    folder = stored_run("shells-twin")
    mine = fitted(tmp_path, **{LOOK: [0.005, 0.01, 0.015, 0.02, 0.03]})
    content = estimate_in_other_traffic(folder, mine)
    traffic, stored = content["traffic"], estimates(folder)["estimates"]["shells"]
    assert (traffic["n_replicates"], traffic["n_refused"], traffic["unseen"]) == (5, 0, None)
    assert traffic["rate"]["times"] == pytest.approx([0.5, 3.0], rel=0.01)
    assert traffic["rate"]["value"] == pytest.approx(stored["crash_rate"])
    assert traffic["rate"]["sampling"] == pytest.approx([stored["ci_low"], stored["ci_high"]])
    assert traffic["ratios"]["r157-cc"]["times"] == pytest.approx([1.0 / (1.0 + ONE_LAW), 1.0 + ONE_LAW], rel=0.005)
    keys = [row["key"] for row in told(content)["rows"]]
    assert keys[keys.index("ratio") + 1 :][:2] == ["traffic", "traffic_ratio"]
    (warning,) = [text for text in told(content)["warnings"] if "replicates" in text]
    assert warning.startswith("only 5 replicates (a 90 % interval needs at least 20): the error of the fit ")


@pytest.mark.slow
def test_of_a_vehicle_whose_shares_may_change_there_is_an_upper_limit_alone(stored_run, tmp_path, monkeypatch):
    """All cut-ins of the shells that it crashes in may crash."""
    folder, mine = stored_run("shells-twin"), fitted(tmp_path, **{LOOK: [0.01, 0.02]})
    tested = StoredShells.of(folder, Progress())
    (near,) = tested.nearby([{LOOK: 0.02}], Progress())
    monkeypatch.setattr(stored_shells, "LEAST_SHARE", 1.1)
    content = estimate_in_other_traffic(folder, mine)
    estimate, traffic = content["estimates"]["shells"], content["traffic"]
    worst = tested.limit(near.p, at_worst=True) / tested.limit(tested.design.p)
    assert traffic["rate"]["times"] == [0.0, pytest.approx(worst, rel=0.01)]
    assert traffic["rate"]["both"] == [0.0, pytest.approx(estimate["upper_bound"] * traffic["rate"]["times"][1])]
    (row,) = [row for row in told(content)["rows"] if row["key"] == "traffic"]
    assert (row["value"][:6], row["interval"][:2]) == ("up to ", "< ")


@pytest.mark.slow
def test_the_folder_keeps_the_answer_of_its_own_traffic_alone(stored_run, tmp_path, capsys):
    folder = copy_of(stored_run("shells-twin"), tmp_path / "run")
    mine = fitted(tmp_path, **{LOOK: [0.005, 0.02]})
    assert main(["estimate", str(folder), "--environment", mine, "--write"]) == 0
    assert "  error of the fit  " in capsys.readouterr().out
    assert json.loads((folder / "estimates.json").read_text())["traffic"]["n_replicates"] == 2
    assert main(["report", str(folder)]) == 0
    assert "error of the fit" in (folder / "report.html").read_text()
    (tmp_path / "mine.yaml").write_text(Path(mine).read_text().replace("{value: 0.01,", "{value: 0.02,"))
    assert main(["estimate", str(folder), "--environment", mine, "--write"]) == 2
    assert "with other numbers" in capsys.readouterr().err


def without_changes() -> str:
    """The shipped environment with steps of acceptance much as there, in which below 2 s nothing was seen."""
    ends, shares, n = (1, 2, 3, 5, 8), (0.01, 0.01, 0.01, 0.01, 0.02, 1.0), [0, 0, 2, 3, 9, 1000]
    listed = [", ".join(f"{{value: {each}, source: fitted}}" for each in of) for of in (ends, shares)]
    steps = "acceptance_steps: {{ttc_s: [{}], share: [{}], events: {}, exposure: {}}}".format(*listed, n, [50.0] * 6)
    replaced = re.compile(r"  (ignore_share|accept_ttc_s|accept_scale_s):")
    return "\n".join([*(line for line in SHIPPED.splitlines() if not replaced.match(line)), steps])


@pytest.mark.slow
def test_where_no_lane_change_was_seen_there_is_an_upper_limit_alone(stored_run, tmp_path, monkeypatch):
    """Shares of the wishes that are much as those of the tests' traffic, none of them seen below 2 s."""
    text = without_changes()
    a, names = 0.02, [f"acceptance_steps__share__{step}" for step in (0, 1)]
    fitted(tmp_path, text, **{name: [a] for name in names})
    content = estimate_in_other_traffic(stored_run("shells-twin"), str(tmp_path / "mine.yaml"))
    traffic = content["traffic"]
    assert traffic["unseen"]["where"] == "TTC < 2 s"
    part = traffic["unseen"]["share"]
    assert part > 0.9
    far = -math.log1p(-math.erf(math.sqrt(a * 50.0))) / 50.0  # the same quantile, of what zero events refuse
    assert traffic["rate"]["times"] == [0.0, pytest.approx(1.0 + part * (far / 0.01 - 1.0), rel=0.03)]
    (row,) = [row for row in told(content)["rows"] if row["key"] == "traffic"]
    assert row["value"].startswith("up to ")
    assert row["remark"] == "none seen at TTC < 2 s"

    # What was found serves vehicles, too, of whose rate other steps carry much.
    with monkeypatch.context() as patch:
        patch.setattr(moved.FewPaths, "_walk", None)
        patch.setattr(other_traffic, "CARRIES", 0.5)
        fewer = estimate_in_other_traffic(stored_run("shells-twin"), str(tmp_path / "mine.yaml"))["traffic"]["unseen"]
    assert 0.5 < fewer["share"] < part

    # What is known comes first: the ratio.
    first, rate, *_ = told(content)["rows"]
    assert (first["key"], rate["value"]) == ("ratio", f"{row['interval']} per test")
    assert content["assumed"] is None

    # So it does where no replicates are asked, as in a run in that traffic.
    (tmp_path / "mine.yaml").write_text(text)
    content = estimate_in_other_traffic(stored_run("shells-twin"), str(tmp_path / "mine.yaml"))
    first, rate, *_ = told(content)["rows"]
    stored, none = content["estimates"]["shells"], -math.log(0.05) / 50.0
    high = stored["ci_high"] * (1.0 + part * (none / 0.01 - 1.0))
    assert (first["key"], rate["value"][:2], rate["remark"]) == ("ratio", "< ", "none seen at TTC < 2 s")
    assert float(rate["value"].split()[1]) == pytest.approx(high * 10 ** -math.floor(math.log10(high)), rel=0.03)
    assert content["assumed"]["times"][1] == pytest.approx(high / stored["ci_high"], rel=0.03)


@pytest.mark.slow
def test_who_may_look_less_is_a_line_of_its_own(folder, tmp_path):
    """The rate is in proportion to the share that does not look, in its range; without a crash its limit is."""
    text = SHIPPED.replace("{value: 0.01, source: assumed}", "{value: 0.01, source: assumed, range: [0.005, 0.08]}")
    (tmp_path / "mine.yaml").write_text(text)
    tested = StoredShells.of(folder, Progress())
    there = resolve(tested.here.campaign.replaced(("environment", "parameters"), str(tmp_path / "mine.yaml")))
    found = assumed(there, tested.pool, tested.design, Progress())
    assert (found["where"], found["share"], found["highest"]) == ("", 0.01, 0.08)
    content = estimate_blocks(tested.blocks, there.campaign, {**tested.manifest, "assumed": found})
    (row,) = [row for row in told(content)["rows"] if row["key"] == "assumed"]
    assert (row["value"], row["remark"]) == ("up to 8.0 times", "if 8 %, not 1 %, do not look behind")
    assert content["assumed"]["times"] == pytest.approx([0.5, 8.0], rel=0.005)
    assert content["assumed"]["ratio_times"] == pytest.approx([1.0, 1.0], rel=0.005)
    moved = sensitivity(folder, ranges={"cut_in.ignore_share": (0.005, 0.08)})
    (bar,) = (bar for bar in moved["bars"] if bar["what"] == "cut_in.ignore_share")
    assert content["assumed"]["ratio_times"] == pytest.approx(bar["ratio"], rel=1e-9)
    assert assumed(tested.here, tested.pool, tested.design, Progress()) is None


@pytest.mark.parametrize(("crash_share", "most", "of_ratio"), [(0.9, 2.3, (0.1, 2.3)), (0.02, 25.0, None)])
def test_crashes_on_few_events_of_a_shell_may_all_be_of_drivers_who_do_not_look(
    crash_share, most, of_ratio, stored_run
):
    best = read_run_folder(stored_run("shells-twin")).estimates.best
    shells = [{**shell, "crash_share": crash_share} for shell in best.details["shells"]]
    times = (0.1,) * len(shells), (2.3,) * len(shells)
    found = _of_rate(Assumed("", 0.25, times, 0.01, (1.0, 1.0)), replace(best, details={"shells": shells}))
    assert found.times == pytest.approx((0.1, most))
    assert found.ratio_times == (of_ratio and pytest.approx(of_ratio))


def test_replicates_that_are_gone_are_refused(stored_run, tmp_path):
    mine = fitted(tmp_path)
    (tmp_path / "replicates.parquet").unlink()
    with pytest.raises(HarnessError, match="no such file"):
        estimate_in_other_traffic(stored_run("shells-twin"), mine)


def test_both_errors_add_as_squares_of_distances_on_a_logarithmic_scale():
    factors, exact, ends = np.exp(np.linspace(-1.0, 1.0, 201)), np.zeros(201), (1e-7, 4e-7)
    found = uncertain(2e-7, ends, factors, exact, 0, 0.9)
    assert found.times == pytest.approx((math.exp(-0.9), math.exp(0.9)))
    far = math.exp(math.hypot(math.log(2.0), 0.9))
    assert found.both == pytest.approx((2e-7 / far, 2e-7 * far))
    assert uncertain(2e-7, (0.0, 4e-7), factors, exact, 0, 0.9).both[0] == 0.0
    assert uncertain(0.0, (0.0, 4e-7), factors, exact, 0, 0.9).both == pytest.approx((0.0, 4e-7 * math.exp(0.9)))
    assert uncertain(2e-7, ends, factors, exact, 11, 0.9).times == (0.0, math.inf)  # above 5 %
    only = uncertain(2e-7, ends, factors, exact, 0, 0.9, from_below=False)
    assert (only.times[0], only.both[0]) == (0.0, 0.0)
    wider = uncertain(2e-7, ends, factors, exact + 0.1, 0, 0.9).times
    assert wider == pytest.approx((found.times[0] / 1.1, found.times[1] * 1.1))


@pytest.mark.slow
def test_replicates_that_tests_cannot_answer_leave_the_interval_open(stored_run, tmp_path):
    """One in which the AV closes in faster than in any test, one whose laws are none."""
    columns = {"initial_state__r2dot_min_mps": [-10.0, -16.0, -10.0], "cut_in__intercept": [-8.7, -8.7, 900.0]}
    content = estimate_in_other_traffic(stored_run("shells-twin"), fitted(tmp_path, **columns))
    traffic, answer = content["traffic"], told(content)
    assert (traffic["n_replicates"], traffic["n_refused"]) == (3, 2)
    assert traffic["rate"]["times"] == [0.0, None]
    (row,) = [row for row in answer["rows"] if row["key"].startswith("traffic")]
    assert (row["value"], row["remark"]) == ("no limit", "2 of 3 replicates unlike what was tested")
    assert "∞" not in f"{answer}"


def environment(folder: Path, **values: float) -> str:
    """The shipped environment with other numbers."""
    text = SHIPPED
    for name, value in values.items():
        text, n = re.subn(rf"(\n  {name}: {{value: )[-0-9.]+", rf"\g<1>{value}", text)
        assert n == 1
    (folder / "mine.yaml").write_text(text)
    return str(folder / "mine.yaml")


def shells_in(folder: Path, where: str) -> dict:
    return estimate_in_other_traffic(folder, where)["estimates"]["shells"]


def test_the_same_traffic_under_another_name_gives_the_same_answer(stored_run, tmp_path):
    folder = stored_run("shells-twin")
    found, stored = shells_in(folder, environment(tmp_path)), estimates(folder)["estimates"]["shells"]
    for key in ("crash_rate", "ci_low", "ci_high", "n_crashes"):
        assert found[key] == pytest.approx(stored[key], rel=1e-9)
    assert found["details"]["references"][0]["ratio"] == pytest.approx(stored["details"]["references"][0]["ratio"])


def test_the_rate_is_proportional_to_the_share_that_does_not_look(stored_run, tmp_path):
    """And the ratio to a driver in the same traffic does not move. The pool's error is 5 %, mostly of equal paths."""
    folder = stored_run("shells-twin")
    mine = environment(tmp_path, ignore_share=0.02)
    found, stored = shells_in(folder, mine), estimates(folder)["estimates"]["shells"]
    assert found["crash_rate"] == pytest.approx(2.0 * stored["crash_rate"], rel=0.05)
    ratios = [each["details"]["references"][0]["ratio"] for each in (found, stored)]
    assert ratios[0] == pytest.approx(ratios[1], rel=0.02)
    assert "the same share of each shell" in told(estimate_in_other_traffic(folder, mine))["scope"]


def test_cut_ins_that_no_test_stands_for_are_refused(stored_run, tmp_path):
    with pytest.raises(CampaignError, match="unlike any that was tested"):
        shells_in(stored_run("shells-twin"), environment(tmp_path, r2dot_min_mps=-16.0))


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
    with pytest.raises(CampaignError, match=r"on few .* of the events of its shells"):
        shells_in(folder, mine)


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
        shells_in(stored_run(name), where)


@pytest.fixture
def folder(stored_run, tmp_path):
    """A run that may be changed."""
    return copy_of(stored_run("shells-twin"), tmp_path / "run")


def test_the_rate_is_in_proportion_to_who_does_not_look_and_the_ratio_is_not(folder):
    ranges = {"cut_in.accept_ttc_s": (7.0, 8.0), "cut_in.ignore_share": (0.005, 0.04)}
    content = sensitivity(folder, ranges=ranges)
    look, accept = content["bars"]  # the longest first
    assert (look["what"], look["known"], look["values"]) == ("cut_in.ignore_share", "assumed", [0.005, 0.04])
    assert look["rate"] == pytest.approx([0.5, 4.0], rel=0.01)
    assert look["ratio"] == pytest.approx([1.0, 1.0], rel=0.005)
    assert accept["rate"] == pytest.approx([1.0, 1.0], abs=0.03)
    assert content["campaign_hash"] == manifest(folder)["campaign_hash"]


@pytest.mark.slow
def test_of_traffic_in_which_nobody_crashes_nothing_is_said(folder, capsys):
    """Tests too short for a crash: the reference driver's rate is 0, to which there is no ratio."""
    assert main(["sensitivity", str(folder), "--range", "scenario.duration_s=1:2", "--json"]) == 0
    (bar,) = (each for each in json.loads(capsys.readouterr().out)["bars"] if each["what"] == "scenario.duration_s")
    assert (bar["rate"], bar["ratio"], bar_note(bar)) == ([None, None], [None, None], "")


def test_other_readings_of_the_regulations_driver_move_the_ratio_alone(stored_run):
    design = StoredShells.of(stored_run("shells-twin"), Progress(), "").design
    named = [Reference("cc", ""), Reference("cc-letter", ""), Reference("cc-early", ""), Reference("fsm", "")]
    rates = np.array([2.0e-4, 2.0e-3, 0.5e-4, 1e-9])
    (bar,) = bar_of_readings(replace(design, references=tuple(named), reference_rate=rates, reference_square=rates))
    assert (bar.rate, bar.ratio) == ((1.0, 1.0), pytest.approx((0.1, 4.0)))
    assert not bar_of_readings(design)


def test_what_was_fitted_together_moves_together(tmp_path):
    """Replicates move a block at a time; a standard error moves a number where there are none."""
    columns = {
        "cut_in__intercept": [-8.0, -9.0],
        "cut_in__ignore_share": [0.01, 0.02],
        "free_driving__df": [15.0, 17.0],
    }
    text = TEXT.replace("df: {value: 16.0, source: ndd}", "df: {value: 16.0, source: fitted, se: 2.0}")
    (tmp_path / "one.yaml").write_text(text)
    found = {}
    for name, file in (("one", str(tmp_path / "one.yaml")), ("both", fitted(tmp_path, text, **columns))):
        parameters = load_parameters(EnvironmentSettings(parameters=file))
        found[name] = {move.what: move.settings for move in moves(file, parameters, SHIPPED_FOLDER, {})}
    assert found["one"] == {"free_driving.df": [{"free_driving__df": pytest.approx(16.0 + k * 3.29)} for k in (-1, 1)]}
    assert found["both"] == {
        "free driving": [{"free_driving__df": 15.0}, {"free_driving__df": 17.0}],
        "cut-in": [
            {"cut_in__intercept": -8.0, "cut_in__ignore_share": 0.01},
            {"cut_in__intercept": -9.0, "cut_in__ignore_share": 0.02},
        ],
    }


@pytest.mark.parametrize(
    ("option", "found"),
    [
        ("cut_in.look=0:1", "cut_in.look"),
        ("cut_in.ignore_share=0.1", "no two numbers"),
        ("cut_in.ignore_share=0.02:0.01", "the lower first"),
        (None, "no number has a standard error"),
    ],
)
def test_what_is_not_said_to_be_uncertain_is_refused(folder, capsys, option, found):
    assert main(["sensitivity", str(folder), *(["--range", option] if option else [])]) == 2
    assert found in capsys.readouterr().err
    assert not (folder / "sensitivity.json").exists()


@pytest.mark.parametrize(("n", "ends", "off"), [(1, [0.55, 1.45], [0.05, 0.15]), (3, [None, None], [None, None])])
def test_a_block_shows_what_is_answered_and_how_much_is_not(n, ends, off):
    """Of five replicates, n in which the reference driver comes out wrong by a factor of 3."""
    near = [Nearby(np.ones(1), 1.0, rate, np.ones(1), rate / 10.0, 0.0) for rate in np.linspace(0.5, 1.5, 5 - n)]
    wrong = [Nearby(np.ones(1), 1.0, 9.0, np.ones(1), 2.0, 0.0)] * n
    bar = bar_of(Move("cut-in", "fitted", None, []), [*near, *wrong])
    assert [None if math.isnan(end) else pytest.approx(end) for end in bar.rate] == ends
    assert [None if math.isnan(end) else pytest.approx(end) for end in bar.off] == off
    assert bar_note(asdict(bar)) == f"{n} of 5: unlike what was tested"


def test_each_end_of_a_number_is_off_by_its_own():
    near = [Nearby(np.ones(1), 1.0, rate, np.ones(1), off, 0.0) for rate, off in ((0.5, 0.048), (1.5, 0.21))]
    bar = bar_of(Move("cut_in.ignore_share", "assumed", (0.0, 1.0), []), near)
    assert (bar.rate, bar.off) == ((0.5, 1.5), (0.048, 0.21))
