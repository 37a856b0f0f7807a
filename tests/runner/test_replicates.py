"""What fitted traffic leaves open of an answer: known where rates are in proportion, and told where it is not."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from harness.cli import main
from harness.errors import HarnessError
from harness.estimators.answer import estimate_blocks
from harness.estimators.traffic import ONE_LAW, uncertain
from harness.pool import moved
from harness.pool.moved import assumed
from harness.progress import Progress
from harness.resolved import resolve
from harness.runner import other_traffic, stored_shells
from harness.runner.compare import compare_campaigns
from harness.runner.other_traffic import estimate_in_other_traffic
from harness.runner.stored_shells import StoredShells
from tests.golden.campaigns import COMPARED
from tests.in_process import one_process, without_page
from tests.stored_runs import answer, copy_of, estimates, golden
from tests.traffic.tables import TEXT as SHIPPED
from tests.traffic.tables import fitted

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


@pytest.mark.slow
def test_the_ratio_of_two_vehicles_hardly_moves(tmp_path, capsys):
    shared, other = COMPARED
    with one_process(), without_page():
        compare_campaigns(
            golden("shells-twin", *shared), golden("shells-twin", *shared, other), tmp_path / "pair", workers=1
        )
    mine = fitted(tmp_path, **{LOOK: [0.005, 0.02]})
    assert main(["estimate", str(tmp_path / "pair"), "--environment", mine, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    compared = json.loads((tmp_path / "pair" / "compare.json").read_text())
    assert found["traffic"]["rate"]["times"] == pytest.approx([0.5, 2.0], rel=0.01)
    assert found["traffic"]["rate"]["value"] == pytest.approx(compared["a"]["crash_rate"])
    of_both = found["traffic"]["ratios"]["B"]
    assert of_both["times"] == pytest.approx([1.0 / (1.0 + ONE_LAW), 1.0 + ONE_LAW], rel=0.01)
    assert of_both["value"] == pytest.approx(compared["ratio"])
    assert of_both["sampling"] == pytest.approx([compared["ratio_low"], compared["ratio_high"]])
    assert main(["estimate", str(tmp_path / "pair"), "--environment", mine, "--write"]) == 2
    assert "--write does not go with" in capsys.readouterr().err


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
def test_who_may_look_less_is_a_line_of_its_own(stored_run, tmp_path):
    """The rate is in proportion to the share that does not look, in its range; without a crash its limit is."""
    text = SHIPPED.replace("{value: 0.01, source: assumed}", "{value: 0.01, source: assumed, range: [0.005, 0.08]}")
    (tmp_path / "mine.yaml").write_text(text)
    tested = StoredShells.of(stored_run("shells-twin"), Progress())
    there = resolve(tested.here.campaign.replaced(("environment", "parameters"), str(tmp_path / "mine.yaml")))
    found = assumed(there, tested.pool, tested.design, Progress())
    assert (found["where"], found["share"], found["highest"]) == ("", 0.01, 0.08)
    content = estimate_blocks(tested.blocks, there.campaign, {**tested.manifest, "assumed": found})
    (row,) = [row for row in told(content)["rows"] if row["key"] == "assumed"]
    assert (row["value"], row["remark"]) == ("up to 8.0 times", "if 8 %, not 1 %, do not look behind")
    assert content["assumed"]["times"] == pytest.approx([0.5, 8.0], rel=0.005)
    assert assumed(tested.here, tested.pool, tested.design, Progress()) is None


@pytest.mark.parametrize(
    ("columns", "found"),
    [({"cut_in__look": [0.1]}, "column cut_in__look"), ({LOOK: ["few"]}, "else than numbers"), (None, "no such file")],
)
def test_replicates_that_are_none_are_refused(stored_run, tmp_path, columns, found):
    mine = fitted(tmp_path, **(columns or {}))
    if columns is None:
        (tmp_path / "replicates.parquet").unlink()
    with pytest.raises(HarnessError, match=found):
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
