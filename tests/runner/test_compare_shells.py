"""Two AVs on the same cut-ins of shells: pairs, what is not driven again, a margin, and what is refused."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import ANY, Mock, call

import pytest

from harness.cli import main
from harness.errors import CampaignError, RunFolderError
from harness.estimators.pairs import PairDecision
from harness.numbers import ratio
from harness.progress import Progress
from harness.report.several import deciding_words, pair_warnings, pair_words
from harness.runner.compare import _decided, compare_campaigns
from harness.runner.tables import read
from harness.runner.workers import ShardRunner, Workers
from tests.in_process import one_process, run_here, without_page
from tests.pool.conftest import SMALL_POOL
from tests.runner.conftest import campaign
from tests.stored_runs import copy_of, manifest

SHELLS = (
    *("testing.method=shells", "testing.shells.statement=library", "stop.rhw=0.15", "stop.episodes=3000"),
    *("stop.min_crashes=null", "world.engine=twin", *SMALL_POOL),
)
HARDER = "av.parameters.min_acceleration_mps2=-8"


@pytest.fixture(scope="module", autouse=True)
def _here():
    with one_process(), without_page():
        yield


@pytest.fixture(scope="module")
def campaigns():
    return campaign(*SHELLS), campaign(*SHELLS, HARDER)


@pytest.fixture(scope="module")
def done(campaigns, tmp_path_factory):
    return compare_campaigns(*campaigns, tmp_path_factory.mktemp("pairs") / "out", workers=1, rhw=0.15)


@pytest.fixture
def driven(monkeypatch):
    """Episodes that were driven, not read."""
    n, run = [], ShardRunner.run

    def counted(self, spec, fatal=None):
        n.append(spec.n_episodes)
        return run(self, spec, fatal)

    monkeypatch.setattr(ShardRunner, "run", counted)
    return n


def by_stratum(folder):
    """Cut-in, initial range and outcome of each test, in order, by stratum."""
    found = defaultdict(list)
    for row in read(folder).table("episodes", ["component", "pool_row", "r2_m", "outcome"]).to_pylist():
        found[row["component"]].append((row["pool_row"], row["r2_m"], row["outcome"]))
    return found


def test_both_meet_the_same_cut_ins_and_the_difference_is_that_of_the_records(done):
    a, b = (by_stratum(done.folder / side) for side in "ab")
    shells, difference = done.content["shells"], 0.0
    for s, shell in enumerate(shells):
        assert [row[:2] for row in a[s]] == [row[:2] for row in b[s]]
        assert len(a[s]) == shell["n_pairs"]
        ends = [(x[2] == "crash", y[2] == "crash") for x, y in zip(a[s], b[s], strict=True)]
        assert [ends.count(kind) for kind in ((True, True), (True, False), (False, True), (False, False))] == [
            shell[key] for key in ("n_both", "n_only_a", "n_only_b", "n_neither")
        ]
        difference += shell["p"] * (shell["n_only_a"] - shell["n_only_b"]) / max(shell["n_pairs"], 1)
    assert done.content["conditional"]["difference"] == pytest.approx(difference)
    assert done.content["conditional"]["rhw"] <= 0.15
    assert done.exit_code == 0
    assert json.loads((done.folder / "compare.json").read_text()).items() >= done.content.items()
    inside = done.content["conditional"]
    assert inside["ci_low"] > 0.0
    assert inside["ratio_low"] < 1.35e-7 / 7.5e-8 < inside["ratio_high"]


def test_what_makes_a_rate_doubtful_is_told_of_each_vehicle(done):
    """As its own run tells it."""
    for side in "ab":
        estimates = json.loads((done.folder / side / "estimates.json").read_text())
        assert done.content[side]["cut_off"] == estimates["cut_off"]
        assert done.content[side]["repeated"] == manifest(done.folder / side).get("repeated")
    doubts = {
        "a": {"repeated": {"differing": [1, 2], "n_episodes": 3}},
        "b": {"n_crashes_before_event": 4, "cut_off": 1.0, "details": {"n_failed": 5}},
    }
    doubts["b"]["milder"] = {"n_crashes": 3, "n_failed": 0, "n_tests": 36, "per_hour": 0.1}
    sides = {side: {**done.content[side], **doubts[side]} for side in "ab"}
    told = list(pair_warnings({**done.content, **sides, "scenario": "cut_out"}))
    assert [text for text in told if text.startswith("A: NOT REPRODUCIBLE: 2 of 3 tests")]
    assert len([text for text in told if text.startswith("B: 4 tests crashed BEFORE the event")]) == 1
    assert len([text for text in told if "still closing in" in text]) == 1
    assert [text[:6] for text in told if "tests FAILED; had they all crashed, as upper limits" in text] == ["B: 5 o"]
    assert [text[:7] for text in told if "MILDER cut-outs end in a crash, too" in text] == ["B: 3 of"]
    assert all(": no test in outside" in text for text in pair_warnings(done.content))
    both = {side: {**done.content[side], **doubts["a"]} for side in "ab"}
    told = [text for text in pair_warnings({**done.content, **both}) if "NOT REPRODUCIBLE" in text]
    assert [text[:13] for text in told] == ["A and B: NOT "]


def test_a_stored_run_of_a_is_taken_over(done, campaigns, tmp_path, driven):
    run_here(campaign(*SHELLS, "stop.rhw=0.9"), tmp_path / "stored")
    before = sum(driven)
    again = compare_campaigns(*campaigns, tmp_path / "out", workers=1, stored=tmp_path / "stored", rhw=0.15)
    assert again.content == done.content
    assert sum(driven) - before < 2 * done.content["n_pairs"]
    assert sum(driven) == manifest(tmp_path / "out" / "a")["n_episodes"] + done.content["n_pairs"]
    with pytest.raises(RunFolderError, match="a run of campaign"):
        compare_campaigns(*campaigns, tmp_path / "other", stored=done.folder / "b")
    with pytest.raises(RunFolderError, match="a folder outside of"):
        compare_campaigns(*campaigns, tmp_path / "stored" / "in_it", stored=tmp_path / "stored")


def test_no_test_that_is_there_is_thrown_away_where_a_file_is_gone(done, campaigns, tmp_path):
    """As none is by a run: what follows the gone ones is driven anew, or stays where less is asked for."""
    out = copy_of(done.folder, tmp_path / "out")
    next((out / "b" / "episodes").iterdir()).unlink()
    before = manifest(out / "b")
    with pytest.raises(RunFolderError, match="finished tests, of which the campaign as it is asked for now would keep"):
        compare_campaigns(*campaigns, out, workers=1, rhw=0.5)
    assert manifest(out / "b") == before
    assert compare_campaigns(*campaigns, out, workers=1, rhw=0.15).content == done.content


@pytest.mark.slow
def test_an_interrupted_comparison_goes_on(done, campaigns, tmp_path, monkeypatch, driven):
    run, calls = Workers.run, []

    def interrupted(self, requests, known):
        calls.append(1)
        if len(calls) == 8:
            raise KeyboardInterrupt
        return run(self, requests, known)

    monkeypatch.setattr(Workers, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        compare_campaigns(*campaigns, tmp_path, workers=1, rhw=0.15)
    assert manifest(tmp_path / "a")["status"] == manifest(tmp_path / "b")["status"] == "interrupted"
    for held in (True, False):  # what is finished is not driven again
        progress, n_kept = (
            Mock(Progress, cancelled=False, remark=""),
            sum(manifest(tmp_path / side)["n_episodes"] for side in "ab"),
        )
        found = compare_campaigns(*campaigns, tmp_path, workers=1, rhw=0.15, progress=progress)
        assert found.content == done.content
        assert sum(driven) == 2 * done.content["n_pairs"]
        assert call("tests of A and B", ANY, done=n_kept) in progress.stage.mock_calls
        assert held == (n_kept < sum(driven))


@pytest.mark.parametrize(("swapped", "verdict", "exit_code"), [(False, "proven", 0), (True, "refuted", 5)])
def test_a_margin_is_decided(campaigns, done, tmp_path, swapped, verdict, exit_code):
    a, b = reversed(campaigns) if swapped else campaigns
    found = compare_campaigns(a, b, tmp_path, workers=1, margin=0.1)
    assert (found.content["decision"]["verdict"], found.exit_code) == (verdict, exit_code)
    low, high = found.content["decision"]["ratio"]
    end = f"≤ {ratio(1.0 / low)}" if swapped else f"≥ {ratio(1.0 / high)}"  # in the direction of the row A / B
    assert pair_words(found.content["decision"]).endswith(f"10 % worse than A (A / B {end}, limit 0.91)")
    assert pair_words(found.content["decision"]).startswith("B crashes less often than A, so") == (high < 1.0)
    assert "verdict: confidence 0.95 over all looks" in " ".join(repr(found).split())
    assert low > 1.1 if swapped else high <= 1.1
    assert manifest(tmp_path / "a")["unmet"] == [{"key": "margin", "numbers": {"margin": 0.1}}]


@pytest.mark.parametrize(
    ("margin", "of_a", "of_b", "verdict"),
    [
        (0.1, (0, 0), (0, 0), "proven"),
        (0.1, (3, 0), (0, 0), "proven"),  # A crashes more often than its rate says
        (0.1, (0, 0), (1, 0), "open"),
        (0.1, (0, 1), (0, 0), "open"),
        (0.1, (0, 0), (0, 1), "open"),
        (0.0, (0, 0), (0, 1), "open"),  # a gate like any other
        (None, (0, 0), (1, 1), "proven"),
        (None, (1, 0), (1, 1), "proven"),  # who crashes less often is told, with the warnings
    ],
)
def test_no_margin_is_kept_by_a_vehicle_in_doubt(margin, of_a, of_b, verdict):
    """Doubts are crashes that a rate leaves out, and tests that were not the same when they ran twice."""
    sides = [SimpleNamespace(doubtful=lambda doubts=doubts: doubts) for doubts in (of_a, of_b)]
    rule = SimpleNamespace(decision=PairDecision(margin, "proven", 0.95, given_the_library=False))
    found = _decided(rule, [SimpleNamespace(runs=sides)])
    assert found.verdict == verdict
    assert deciding_words({"decision": asdict(found), "to_decide": None}) is None  # more pairs would not help
    refuted = replace(found, verdict="refuted").doubted(of_a[0], 0, 1)
    assert refuted.verdict == "refuted"
    if margin == 0.0:
        assert pair_words(found.to_json()) == "Not told apart, see !"
    if margin is None:  # of a safer one in doubt that is said beside it
        assert pair_words(found.to_json()) == "B crashes less often than A, see !"
        assert pair_words(refuted.to_json()) == "B crashes more often than A" + ", see !" * of_a[0]


def test_it_ends_when_it_is_known_who_crashes_less_often(campaigns, done, tmp_path):
    """Sooner than at a half-width that is asked by hand, and whatever the campaigns' stop.rhw says of one vehicle."""
    found = compare_campaigns(*campaigns, tmp_path, workers=1)
    content = found.content
    assert pair_words(content["decision"]) == "B crashes less often than A"
    assert (content["ended"], manifest(tmp_path / "b")["stopped_by"], found.exit_code) == ("accept", "accept", 0)
    assert content["n_pairs"] < done.content["n_pairs"]
    assert content["conditional"]["rhw"] > 0.15 >= done.content["conditional"]["rhw"]
    assert (content["to_decide"], done.content["ended"]) == (None, "rhw")


@pytest.mark.parametrize(
    ("shared", "other", "said"),
    [
        (("testing.method=forced",), HARDER, "forced, in a comparison"),
        ((*SHELLS, "accept.crash_rate_below=1e-7"), HARDER, "a limit of one crash rate"),
        (SHELLS, "av={controller: 'tests.controllers.early:Speeds', before_event: controller}", "events of its own"),
        (SHELLS, "testing.epsilon=0.2", r"^testing\.epsilon"),
    ],
)
def test_what_cannot_be_compared_is_refused(tmp_path, shared, other, said):
    with pytest.raises(CampaignError, match=said):
        compare_campaigns(campaign(*shared), campaign(*shared, other), tmp_path / "out")
    assert not (tmp_path / "out" / "a").exists()


def test_where_one_accelerates_harder_both_are_tested_beyond_the_envelope(tmp_path):
    """As such a vehicle may crash there; a stored run that was not is driven anew."""
    asked = [each.replace("=library", "=assumption_free") for each in SHELLS]
    gentle, harder = campaign(*asked), campaign(*asked, "av.parameters.max_acceleration_mps2=5")
    for at, sides in enumerate([(gentle, harder), (harder, gentle)]):
        found = compare_campaigns(*sides, tmp_path / str(at), workers=1)
        tested = [json.loads((found.folder / side / "shells.json").read_text()) for side in "ab"]
        assert tested[0]["cell_p"] == tested[1]["cell_p"]
        assert tested[0]["p_unreachable"] == pytest.approx(0.0, abs=1e-15)
    stored = tmp_path / "0" / "b"
    assert compare_campaigns(harder, gentle, tmp_path / "2", workers=1, stored=stored).content["n_pairs"] > 0
    alone = run_here(gentle, tmp_path / "alone").folder
    with pytest.raises(CampaignError, match="beyond_envelope: found false in the stored run of A"):
        compare_campaigns(gentle, harder, tmp_path / "3", workers=1, stored=alone)


def test_one_end_is_asked_for(campaigns, tmp_path):
    with pytest.raises(CampaignError, match=r"--margin: found stop\.rhw=0\.1 beside it"):
        compare_campaigns(*campaigns, tmp_path / "out", margin=0.1, rhw=0.1)


def test_the_command_line_takes_a_run_folder(done, tmp_path, capsys):
    copy = Path(done.folder) / "a"
    call = ["compare", str(copy), "--against", HARDER, "--out", str(tmp_path / "out"), "--workers", "1"]
    assert main([*call, "--set", "stop.rhw=0.15"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("B crashes less often than A · ")
    assert len(out.splitlines()) <= 9
    again = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert again["shells"] == done.content["shells"]
