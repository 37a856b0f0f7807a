"""Several scenarios in one run: one answer, a run folder each, the same bits whatever the workers, and resumed."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import harness
from harness.cli import main
from harness.errors import CampaignError, HarnessError, RunFolderError
from harness.estimators.stopping import Decision
from harness.estimators.traffic import Bar, Sensitivity
from harness.families.words import ELSEWHERE, EXCLUDED
from harness.numbers import number, share
from harness.numbers import ratio as shown_ratio
from harness.pool import moved
from harness.pool.build import seed_of_paths
from harness.printed import PRINTED
from harness.progress import Progress
from harness.random_stream import AV_DRAWS, INITIAL, uniforms
from harness.records.folder import read_manifest, write_sealed
from harness.report.rows import not_moved_words
from harness.report.several import family_rows, hour_lines
from harness.resolved import resolve
from harness.runner import other_traffic
from harness.runner.compare import compare_campaigns
from harness.runner.run import exposure_of
from harness.runner.stored import estimate_families, read_families
from tests.in_process import one_process, run_here, run_with_workers
from tests.stored_runs import copy_of

NAMES = ("cut_in", "lead_brakes", "cut_out")
QUICK = [
    f"scenarios=[{', '.join(NAMES)}]", "world.engine=twin", "pool.relative_error=0.2", "pool.events_per_shell=200",
    "stop.below_reference=null", "stop.rhw=0.6",
]  # fmt: skip
HARDER = "av.parameters.min_acceleration_mps2=-5"


def campaign(*overrides):
    return harness.load_campaign("idm", [*QUICK, *overrides])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    with one_process():
        return harness.run(campaign(), tmp_path_factory.mktemp("hours") / "run", workers=1)


def bits(folder):
    """Of all tests, and of the answer."""
    answer = json.loads((folder / "families.json").read_text())
    kept = {key: value for key, value in answer.items() if key not in ("wall_time_s", "crc32")}
    return [harness.read(folder / name).table("episodes") for name in NAMES], kept


def test_the_answer_is_the_sum_over_families_of_what_their_runs_say(run):
    assert run.exit_code == 0
    told = run.content
    assert list(told["families"]) == list(NAMES)
    total = 0.0
    for name, of in told["families"].items():
        own = json.loads((run.folder / name / "estimates.json").read_text())["estimates"]["shells"]
        per_hour = of["exposure"]["per_hour"] / own["details"]["p_event"]
        assert of["rate_per_hour"] == pytest.approx(per_hour * own["crash_rate"], rel=1e-12)
        low, high = (per_hour * own[end] for end in ("ci_low", "ci_high"))
        assert of["ci_low"] * (1.0 - 1e-9) <= low < high <= of["ci_high"] * (1.0 + 1e-9)  # with the error of p_event
        assert (of["ci_low"], of["ci_high"]) == pytest.approx((low, high), rel=0.05)
        total += of["rate_per_hour"]
        assert read_manifest(run.folder / name)["stopped_by"] == "sum"
        assert "stopped: with the sum of all scenarios" in " ".join(repr(run.runs[name]).split())
    hour = told["per_hour"]
    assert hour["rate"] == pytest.approx(total)
    assert hour["ci_low"] < total < hour["ci_high"]
    assert (hour["ci_high"] - hour["ci_low"]) / 2.0 / total <= 0.6
    assert told["n_episodes"] == sum(read_manifest(run.folder / name)["n_episodes"] for name in NAMES)
    assert told["families"]["lead_brakes"]["share"] > 0.9  # idm brakes with 4 m/s² at most
    assert told["beside"]["ratio"] > 1.0 > told["families"]["cut_in"]["ratio"]
    low, high = told["beside"]["over_assumed"]
    assert low < told["beside"]["ratio"] < high
    letter, at_once = told["readings"]
    assert (letter["reference"], at_once["reference"]) == ("r157-cc-letter", "r157-cc-at-once")
    assert letter["ratio"] < told["beside"]["ratio"] < at_once["ratio"]
    assert "× r157-cc-letter" in (run.folder / "report.html").read_text()
    # Of an event that happens for certain no test knows how far apart two are.
    assert read_manifest(run.folder / "cut_in")["distance_per_test_m"] > 100.0
    assert read_manifest(run.folder / "lead_brakes")["distance_per_test_m"] is None
    for name, part in told["families"].items():  # the factor that an answer of one scenario gives
        alone = harness.estimate(run.folder / name)
        shells, times = alone["estimates"]["shells"], read_manifest(run.folder / name)["tests_per_hour"]
        assert times * shells["crash_rate"] == pytest.approx(part["rate_per_hour"], rel=1e-9)
        shown = (f"{number(times * shells[key])} per hour" for key in ("crash_rate", "ci_high", "upper_bound"))
        assert any(each in repr(alone) for each in shown)  # of a wide interval the limit


def test_each_scenario_has_random_numbers_of_its_own():
    """With the same, vehicles fail in the same tests of all, and pools err alike: the sum varies more than it says."""
    resolved, n = [resolve(campaign().of_family(name)) for name in NAMES], 4000
    for stream, seed_of in ((AV_DRAWS, lambda each: each.scenario.seed), (INITIAL, seed_of_paths)):
        together = np.corrcoef([uniforms(seed_of(each), 0, n, stream, 1)[:, 0] for each in resolved])
        assert np.abs(together - np.eye(3)).max() < 4.0 / np.sqrt(n)


def test_workers_and_interruptions_change_no_bit(run, tmp_path):
    out = tmp_path / "run"
    stopped = run_with_workers(campaign("stop.rhw=2.0"), out, workers=2)
    assert stopped.content["n_episodes"] < run.content["n_episodes"]
    (out / PRINTED).write_text("what a vehicle has printed")
    run_with_workers(campaign(), out, workers=2, resume=True)
    assert bits(out) == bits(run.folder)
    with pytest.raises(RunFolderError, match="already begun"):
        harness.run(campaign(), out)


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (
            ["exposure.cut_out=0.01"],
            r"exposure as shipped; expected exposure cut_out=0\.01\. Without .*cut_out=0\.01\. Or",
        ),
        (["scenarios=[lead_brakes, cut_in, cut_out]"], "tests of cut_in, lead_brakes, cut_out"),
        (["stop.each_family=true"], "expected tests of each_family, cut_in"),
        (["scenario=cut_in", "scenarios=null"], "a run of several scenarios"),
    ],
)
def test_what_would_allocate_other_tests_is_refused_before_one_is_run(run, other, told):
    kept = {file: file.read_bytes() for file in run.folder.rglob("*") if file.is_file()}
    with pytest.raises(RunFolderError, match=told):
        harness.run(campaign("stop.rhw=0.5", *other), run.folder, resume=True)
    assert {file: file.read_bytes() for file in run.folder.rglob("*") if file.is_file()} == kept


@pytest.mark.slow
def test_a_precision_of_each_family_can_be_asked_for(tmp_path):
    """That of the one which is known worst takes most tests."""
    found = harness.run(campaign("stop.each_family=true", "stop.episodes=1500"), tmp_path / "run", workers=1)
    of = found.content["families"]
    assert found.content["stopped_by"] in ("episodes", "pool")
    assert of["lead_brakes"]["n_episodes"] < of["cut_out"]["n_episodes"]


def test_other_exposures_need_no_new_tests(run, capsys):
    """All e_f twice: all rates twice; one alone moves its own part."""
    told = run.content
    twice = {name: 2.0 * of["exposure"]["per_hour"] for name, of in told["families"].items()}
    found = estimate_families(run.folder, twice)
    for key in ("rate", "ci_low", "ci_high"):
        assert found["per_hour"][key] == pytest.approx(2.0 * told["per_hour"][key], rel=1e-9)
    assert found["beside"]["ratio"] == pytest.approx(told["beside"]["ratio"])
    assert main(["estimate", str(run.folder), "--exposure", "lead_brakes=0.3"]) == 0
    said = capsys.readouterr()
    assert "given: lead brakes 0.3" in said.out
    assert said.out.rstrip().endswith("stopped: precise enough")
    assert not said.err
    assert main(["estimate", str(run.folder), "--confidence", "0.999"]) == 0
    assert re.search(r"precise enough as it was run; here (over )?± \d+ %", " ".join(capsys.readouterr().out.split()))
    assert main(["estimate", str(run.folder), "--exposure", "cut_out=1"]) == 0  # of all, not of those in scope
    assert "note: exposure cut_out=1 is 245 times the shipped one" in capsys.readouterr().err
    again = estimate_families(run.folder, {})
    assert {key: of for key, of in again.items() if key != "crc32"} == told
    assert main(["estimate", str(run.folder), "--exposure", "lane_change=0.3"]) == 2
    assert "cut_in, lead_brakes, cut_out" in capsys.readouterr().err
    assert main(["estimate", str(run.folder), "-e", "nade"]) == 2
    assert f"Name {run.folder / 'cut_in'}, say." in " ".join(capsys.readouterr().err.split())
    assert main(["estimate", str(run.folder), "--exposure", "lead_brakes=1,cut_in=2"]) == 2
    assert "Write --exposure lead_brakes=0.1, once for each; or" in capsys.readouterr().err
    given = ["--exposure", "cut_in=0.1", "--exposure-uncertainty"]
    assert main(["estimate", str(run.folder), *given]) == 0
    said = capsys.readouterr()
    assert "note: no exposure here is counted" in said.err
    assert "also of counted events" not in said.out
    assert main(["estimate", str(run.folder / "cut_in"), "--exposure", "cut_in=0.3"]) == 2
    assert "families.json" in capsys.readouterr().err


@pytest.mark.slow
def test_a_budget_that_leaves_a_scenario_without_tests_is_refused_and_may_be_raised(run, tmp_path):
    with pytest.raises(CampaignError, match=r"stop\.episodes: found 5, spent before a test of"):
        harness.run(campaign("stop.episodes=5"), tmp_path / "run", workers=1)
    again = harness.run(campaign(), tmp_path / "run", workers=1, resume=True)
    assert bits(again.folder) == bits(run.folder)


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"times_reference": {"driver": "r157-cc"}}, "rate above 1 × r157-cc"),
        ({"crash_rate_below": 1e-5}, "rate above 1 × 10⁻⁵ per hour"),
    ],
)
def test_a_verdict_is_of_the_exposures_that_it_was_reached_with(asked, told, tmp_path):
    run = run_here(campaign(f"accept={asked}", "stop.rhw=null"), tmp_path / "run")
    verdict = run.content["decision"]
    assert verdict["verdict"] == "rejected"
    assert f"REJECTED {told} confidence 0.95" in " ".join(repr(run).split())
    assert estimate_families(run.folder, confidence=0.5)["decision"] == verdict
    other = estimate_families(run.folder, {"lead_brakes": 1e-6})
    assert other["decision"] is None
    assert "stopped: verdict reached (rejected) at the exposures of the run" in " ".join(repr(other).split())
    ran = {"decision": {**verdict, "verdict": "undecided", "low": 0.0, "high": 0.0, "n_milder": 1}}
    held_back = " ".join(" ".join(hour_lines({**other, "ran": ran})).split())
    assert "stopped: rate below the limit (undecided) at the exposures of the run" in held_back
    write_sealed(run.folder / "families.json", dict(other))  # with its own the verdict is there again
    stored = json.loads((run.folder / "families.json").read_text())
    shipped = run.content["families"]["lead_brakes"]["exposure"]["per_hour"]
    assert stored["decision"] is None
    for same in (shipped, 0.1):  # as it is shown: the share in scope is 1 but for the last bits
        assert estimate_families(run.folder, {"lead_brakes": same})["decision"] == verdict


@pytest.mark.parametrize("wrong", ["1e300", "1e-320", "nan", "x", 0.0, 1e300, True])
def test_exposures_out_of_all_bounds_are_refused(wrong, run, capsys):
    """On the command line, and from Python."""
    assert main(["estimate", str(run.folder), "--exposure", f"cut_in={wrong}"]) == 2
    assert "exposure" in capsys.readouterr().err
    with pytest.raises(HarnessError, match="exposure"):
        estimate_families(run.folder, {"cut_in": wrong})


@pytest.mark.parametrize(
    ("overrides", "where"),
    [
        (["testing.method=forced", "stop.rhw=null"], "testing.method"),
        (["pool.library=ladder-2"], "pool.library"),
        (["testing.shells.statement=library"], "testing.shells.statement"),
        (["accept={times_reference: {driver: r157-fsm}}", "stop.rhw=null"], "accept.times_reference.driver"),
        (["exposure.cut_inn=1"], "exposure"),
        (["exposure.cut_in=1e300"], "exposure.cut_in"),
        (["environments.cut_in=ndd-overtaking-1"], "environments"),
        (["scenarios=[cut_in, lead_breaks]"], "scenario"),
    ],
)
def test_what_does_not_go_together_is_refused(overrides, where, tmp_path):
    with pytest.raises(CampaignError) as refused:
        harness.run(campaign(*overrides), tmp_path / "run")
    assert where in str(refused.value.where)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("rhw", "low", "shown"), [(3.0, 1.2, True), (0.3, 1.2, False), (3.0, 0.9, False)])
def test_where_few_tests_reject_only_the_lower_ends_are_told(run, rhw, low, shown):
    decision = Decision(1.0, "assumption_free", 0.95, low, 40.0, driver="r157-cc").to_json()
    per_hour, beside = ({**run.content[key]} for key in ("per_hour", "beside"))
    content = {**run.content, "decision": decision, "per_hour": per_hour | {"rhw": rhw, "ci_low": 1e-3}}
    told = "\n".join(hour_lines({**content, "beside": beside | {"ratio_low": 2.5, "ratio_high": 900.0}}))
    ratio = "> 2.50 (crashes more)" in told
    used_up = {**content, "stopped_by": "episodes", "asked_rhw": 0.3, "per_hour": {**per_hour, "rhw": 1e3 * rhw}}
    assert "asked: ±" not in " ".join(hour_lines(used_up))  # of a limit, at which it would have ended
    used_up["decision"] = None
    assert "at over ± 1,000 % (asked: ± 30 %)" in " ".join(" ".join(hour_lines(used_up)).split())
    assert ("crashes so far      > 1.00 × 10⁻³ per hour" in told, ratio, "to 900" in told) == (shown, shown, not shown)


def test_which_crashes_count_is_said(run):
    assert hour_lines(run.content)[1].startswith("  crashes  ")
    assert hour_lines({**run.content, "counts_above_mps": 3.0})[1].startswith("  crashes > 3 m/s  ")


def test_the_hardest_crash_of_all_scenarios_is_replayed(run, capsys):
    tests = {name: harness.read(run.folder / name).episodes(["impact_speed_mps"]) for name in NAMES}
    hardest = max(NAMES, key=lambda name: tests[name]["impact_speed_mps"].max())
    number_of = int(tests[hardest]["impact_speed_mps"].argmax())
    assert main(["replay", str(run.folder), "--stored"]) == 0
    assert capsys.readouterr().out.startswith(f"{run.folder / hardest}, test {number_of}: crash; ")
    assert harness.replay(run.folder, stored=True).row["episode"] == number_of


def test_a_sum_whose_runs_are_gone_has_nothing_to_replay(run, tmp_path, capsys):
    shutil.copy(run.folder / "families.json", tmp_path)
    assert main(["replay", str(tmp_path), "--stored"]) == 2
    assert f"error: {tmp_path / 'manifest.json'}" in capsys.readouterr().err


def test_a_sum_of_before_its_range_over_what_is_assumed_has_its_page(run, tmp_path):
    folder = copy_of(run.folder, tmp_path / "run")
    content = json.loads((folder / "families.json").read_text())
    del content["per_hour"]["over_assumed"]
    write_sealed(folder / "families.json", content)
    assert main(["report", str(folder)]) == 0


def test_estimates_of_another_run_are_refused_in_a_sum(run, tmp_path, capsys):
    folder = copy_of(run.folder, tmp_path / "run")
    shutil.copy(folder / NAMES[0] / "estimates.json", folder / NAMES[1])
    assert main(["estimate", str(folder)]) == 2
    assert f"error: {folder / NAMES[1] / 'estimates.json'}" in capsys.readouterr().err


def test_what_other_traffic_does_to_a_scenario_is_said_once(run):
    """As in the answer of that scenario alone, but at as many events: there are 1.31 times as many per test, too."""
    content = run.content
    told = " ".join(" ".join(hour_lines(content)).split())
    said = "cut-in 0.048 (0.013–0.12; crashes × 19 if 25 %, not 1 %, do not look behind); assumed: lead brakes 0.1"
    assert told.count(said) == 1
    assert "25 %, not 1 %, do not look behind" in repr(run.runs["cut_in"])
    assert (run.folder / "report.html").read_text().count("× 19 if 25 %, not 1 %") == 1
    brakes = content["families"]["lead_brakes"]
    kept = {**brakes, "exposure": {**brakes["exposure"], "source": f"assumed; {EXCLUDED}: 0 in 200 h of following"}}
    fitted = " ".join(hour_lines({**content, "families": {**content["families"], "lead_brakes": kept}}))
    assert f"lead brakes 0.1 ({EXCLUDED})" in " ".join(fitted.split())
    resolved = resolve(campaign().of_family("cut_in"))
    fitted_too = replace(resolved, parameters=resolved.parameters.model_copy(update={"replicates": "of a fit"}))
    assert ELSEWHERE in exposure_of(fitted_too, {}).source
    assert ELSEWHERE not in exposure_of(resolved, {}).source
    elsewhere = {**content["families"]["cut_in"], "exposure": exposure_of(fitted_too, {})._asdict()}
    told = " ".join(hour_lines({**content, "families": {**content["families"], "cut_in": elsewhere}}))
    assert f"cut-in 0.048 (0.013–0.12; {ELSEWHERE}; crashes ×" in " ".join(told.split())
    verdict = Decision(1.0, "assumption_free", 0.95, 2.5, 40.0, driver="r157-cc").to_json()
    report = run.folder / "report.html"
    assert (len(hour_lines(content, report)), len(hour_lines({**content, "decision": verdict}, report))) == (10, 12)


def test_what_moves_one_scenario_moves_the_sum_by_its_share(run, tmp_path, monkeypatch, capsys):
    """And an exposure as an answer with that exposure; a scenario that says nothing of its own is named."""
    told, folder = run.content, copy_of(run.folder, tmp_path / "run")
    stored = read_families(folder)

    def of_one(where, ranges, _, *, per_event):
        # The shipped exposure is of all cut-outs: how many are in scope moves with the traffic, unless that is given.
        assert per_event == (where.name == "cut_in" or where.name in stored["exposure"])
        if where.name == "cut_out":
            raise CampaignError("harness sensitivity", "no number", "one", "Look for one.")
        assert ranges == ({"braking.stop_share": (0.0, 0.1)} if where.name == "lead_brakes" else {})
        return Sensitivity("", "", "r157-cc", (Bar("twice", "assumed", None, (2.0, 1.0), (4.0, 1.0), (0.1, 0.0)),))

    monkeypatch.setattr("harness.runner.other_traffic._of_one", of_one)
    assert main(["sensitivity", str(folder), "--range", "braking.stop_share=0:0.1"]) == 0
    said = capsys.readouterr().out
    of = share(told["families"]["cut_out"]["share"])
    left = f"Not moved: the numbers of cut-out ({of} of the rate). Found: no number"
    assert left in said
    assert left in (folder / "report.html").read_text()
    assert "no test crashed" not in said
    stored["families"]["cut_out"] |= {"n_crashes": 0}
    stored["exposure"] = {"cut_out": 0.01}
    monkeypatch.setattr(other_traffic, "read_families", lambda _: stored)
    none, _ = other_traffic._of_sum(folder, {"braking.stop_share": (0.0, 0.1)}, Progress()).not_moved
    assert not_moved_words(none) == (
        "Of cut-out no test crashed: its bars move the competent driver alone, and no bar the upper limit."
    )
    bars = {bar["what"]: bar for bar in json.loads((folder / "sensitivity.json").read_text())["bars"]}
    assert len(bars) == 3 + 2
    stored["families"]["cut_out"] |= {"assumed": told["families"]["cut_in"]["assumed"], "share": 0.5}
    least, most = told["families"]["cut_in"]["assumed"]["times"]
    asked = {"braking.stop_share": (0.0, 0.1)}
    (of,) = [bar for bar in other_traffic._of_sum(folder, asked, Progress()).bars if bar.what.endswith("up to 25 %")]
    assert of.what == "cut_out drivers who do not look, up to 25 %"
    assert of.rate == pytest.approx((0.5 + 0.5 * least, 0.5 + 0.5 * most))
    assert all(map(math.isnan, of.ratio))
    for name, of in told["families"].items():
        rate, driver = told["per_hour"]["rate"], told["beside"]["rate_per_hour"]
        low, high = (estimate_families(folder, {name: of["exposure"][end]}) for end in ("low", "high"))
        bar = bars[f"exposure {name}"]
        assert bar["rate"] == pytest.approx([each["per_hour"]["rate"] / rate for each in (low, high)], rel=1e-3)
        assert bar["ratio"] == pytest.approx(
            [each["beside"]["ratio"] / told["beside"]["ratio"] for each in (low, high)], rel=1e-3
        )
        if name != "cut_out":
            more, half = of["rate_per_hour"] / rate, 0.5 * of["reference_rate_per_hour"] / driver
            assert bars[f"{name} twice"]["rate"] == pytest.approx([1.0 + more, 1.0])
            assert bars[f"{name} twice"]["ratio"] == pytest.approx([(1.0 + more) / (1.0 - half), 1.0])
    again = run_here(campaign(), folder, resume=True)  # it hinders nothing
    assert again.content["per_hour"] == told["per_hour"]
    assert main(["report", str(folder)]) == 0
    assert 'id="plot-sensitivity"' in (folder / "report.html").read_text()
    assert main(["estimate", str(folder), "--exposure", "lead_brakes=0.3", "--write"]) == 0
    assert main(["report", str(folder)]) == 0
    assert 'id="plot-sensitivity"' not in (folder / "report.html").read_text()  # it is of other exposures
    assert main(["sensitivity", str(folder), "--range", "braking.stop_shar=0:0.1"]) == 2
    assert "found:    braking.stop_shar" in capsys.readouterr().err


def test_a_limit_of_the_sum_has_no_bars(run, tmp_path):
    """Where none crashed a share of the rate is of nothing, and all bars would be 1."""
    folder = copy_of(run.folder, tmp_path / "run")
    write_sealed(folder / "families.json", {**run.content, "n_crashes": 0})
    with pytest.raises(CampaignError, match="tests of which none crashed"):
        harness.sensitivity(folder)


def test_a_rate_beside_its_count_is_that_of_it(tmp_path):
    for events, right in ((30, True), (3, False)):
        counted = f"{{per_hour: {{value: 0.3, source: user}}, events: {events}, hours: 100.5}}"
        (tmp_path / "mine.yaml").write_text(f"like: lead-brakes-1\nexposure: {counted}\n")
        asked = campaign(f"environments={{lead_brakes: {tmp_path / 'mine.yaml'}}}").of_family("lead_brakes")
        if right:
            assert resolve(asked).parameters.exposure.events == events
        else:
            with pytest.raises(CampaignError, match=r"0\.3, beside events 3 in hours 100\.5"):
                resolve(asked)


@pytest.mark.parametrize(("times", "warned"), [(0.9, 0), (1.1, 1)])
def test_a_verdict_that_assumed_numbers_may_turn_says_so(run, times, warned):
    ratio, (low, high) = run.content["beside"]["ratio"], run.content["beside"]["over_assumed"]
    assert 1.1 * low < ratio < high
    verdict = Decision(times * low, "assumption_free", 0.95, 0.9 * ratio, 1.1 * ratio, driver="r157-cc").to_json()
    told = " ".join(" ".join(hour_lines({**run.content, "decision": verdict})).split())
    assert told.count("! assumed numbers may turn this verdict: × ") == warned
    accepted = {**verdict, "limit": 2.0 * high, "verdict": "accepted", "over_assumed": [low, times * 1.9 * high]}
    told = " ".join(" ".join(hour_lines({**run.content, "decision": accepted})).split())  # by limits, not by the rate
    assert told.count("! assumed numbers may turn this verdict: × ") == warned
    wider = {**verdict, "limit": 2.0 * ratio, "over_assumed": [ratio, 2.0 * high]}  # of exposures alone
    told = " ".join(" ".join(hour_lines({**run.content, "decision": wider})).split())
    assert f"turn this verdict: × {shown_ratio(low)} to {shown_ratio(2.0 * high)} over" in told
    own = {**run.content, "decision": {**verdict, "verdict": "undecided"}}
    assert "may turn" not in " ".join(hour_lines(own))


def test_ranges_without_who_does_not_look_are_over_exposures(run):
    """As where the vehicle acts before the cut-in: what moves with them is not known then."""
    families = run.content["families"]
    acts = {**run.content, "families": {**families, "cut_in": {**families["cut_in"], "assumed": None}}}
    for content, told in ((run.content, "over assumed ranges"), (acts, "over exposures")):
        (row,) = (line for line in hour_lines(content) if "× competent driver" in line)
        assert row.endswith(told)


def test_a_reading_of_the_regulation_that_turns_the_answer_is_said(run):
    letter, at_once = run.content["readings"]
    turned = {**run.content, "readings": [{**letter, "ratio": 0.531, "ratio_low": 0.462, "ratio_high": 1.21}, at_once]}
    said = "! beside r157-cc-letter, another reading of UN R157, it is × 0.53 (0.46 to 1.21)"
    for content, n in ((run.content, 0), (turned, 1)):
        assert " ".join(" ".join(hour_lines(content)).split()).count("another reading") == n
    assert said in " ".join(" ".join(hour_lines(turned)).split())
    none = {"ratio": 0.0, "ratio_low": 0.0, "ratio_high": 1.021}
    without = {**run.content, "beside": run.content["beside"] | none | {"ratio_high": 0.9}, "readings": [letter | none]}
    without["families"] = {name: {**of, "n_crashes": 0} for name, of in run.content["families"].items()}
    told = " ".join(" ".join(hour_lines(without)).split())
    assert said.replace("0.53 (0.46 to 1.21)", "< 1.02") in told
    assert ("; crashes × " in " ".join(hour_lines(run.content)), "; crashes × " in told) == (True, False)


def test_what_the_vehicle_did_before_bv_came_is_said_as_in_the_answer_of_one_scenario(run):
    of = run.content["families"]
    assert of["cut_in"]["before_event"]["built_in"]
    for early, but in ((0, ""), (5, "in all but 5 tests "), (6, None)):
        acted = {**of["cut_in"]["before_event"], "n_braked_before": 1234, "n_braked_early": early, "n_events": 50}
        content = {**run.content, "families": {**of, "cut_in": {**of["cut_in"], "before_event": acted}}}
        told = " ".join(" ".join(hour_lines(content)).split())
        assert "! cut-in: in 1,234 tests it braked with nobody ahead" in told
        assert (f"! cut-in: {but}it did nothing before the other car" in told) == (but is not None)
    script = {"idle_s": 0.0, "left_s": 0.0, "safe_speeds": True}
    all_of = {
        name: {**each, "before_event": {**each["before_event"], "tried_script": script}} for name, each in of.items()
    }
    told = " ".join(" ".join(hour_lines({**run.content, "families": all_of})).split())
    assert told.count("! cut-in, lead brakes, cut-out: in the script’s speed mode SUMO’s safe speeds would hold") == 1
    assert told.count("safe speeds") == 1
    brakes = {**of["lead_brakes"]["before_event"], "built_in": False, "n_events": 50}
    for n, warned in ((6, True), (5, False)):
        part = {**of["lead_brakes"], "before_event": {**brakes, "n_fell_behind": n}, "share_below_1_mps": 0.1 * n}
        lines = " ".join(" ".join(hour_lines({**content, "families": {**of, "lead_brakes": part}})).split())
        assert (f"! lead brakes: in {n} tests it was over 5 s behind the vehicle ahead" in lines) == warned
        assert (f"! lead brakes: {10 * n} % of these crashes are touches" in lines) == warned


@pytest.mark.parametrize(("times", "warned"), [([0.2, 4.0], True), ([0.99, 1.01], False), (None, False)])
def test_a_rate_that_traffic_leaves_open_has_only_an_upper_limit_in_the_sum_too(run, times, warned):
    """Where no lane change was seen that a notable part of it comes from."""
    open_ = {"where": "TTC < 3 s", "highest": None, "times": times}
    of = run.content["families"]
    content = {**run.content, "families": {**of, "cut_in": {**of["cut_in"], "assumed": open_}}}
    told = " ".join(" ".join(hour_lines(content)).split())
    said = "! cut-in: no lane change was seen at TTC < 3 s in the data of this traffic: rates have only an upper limit"
    most = f", here {number(4.0 * of['cut_in']['ci_high'])} per hour"
    row = f"< {number(4.0 * of['cut_in']['ci_high'])} ({number(of['cut_in']['rate_per_hour'])} as fitted)"
    assert [each in told for each in (said, said + most, row)] == [warned] * 3


@pytest.mark.parametrize(
    ("high", "ratios", "shown"),
    [
        (1e-3, (0.5, 200.0), ("< 1.00 × 10⁻³ (est. 2.00 × 10⁻⁶)", "× < 200")),
        (4e-6, (0.5, 2.0), ("2.00 (1.00 to 4.00) × 10⁻⁶", "× 3.00 (0.50–2.0)")),
        (None, (2.0, None), ("2.00 × 10⁻⁶ (≥ 1.00 × 10⁻⁶)", "× 3.00 (≥ 2.0)")),
    ],
)
def test_a_row_says_of_a_scenario_what_is_known(run, high, ratios, shown):
    """A limit, where its ends are far apart."""
    known = {"rate_per_hour": 2e-6, "ci_low": 1e-6, "ci_high": high, "ratio": 3.0}
    known |= {"ratio_low": ratios[0], "ratio_high": ratios[1]}
    families = {"lead_brakes": run.content["families"]["lead_brakes"] | known}
    ((_, _, _, *row, _),) = family_rows({"families": families})
    assert tuple(row) == shown


def test_each_scenario_may_have_a_file_of_its_own(tmp_path):
    (tmp_path / "mine.yaml").write_text("like: lead-brakes-1\nexposure: {per_hour: {value: 0.3, source: user}}\n")
    found = campaign(f"environments={{lead_brakes: {tmp_path / 'mine.yaml'}}}")
    exposures = {name: resolve(found.of_family(name)).parameters.exposure.per_hour.value for name in NAMES[1:]}
    assert exposures == {"lead_brakes": 0.3, "cut_out": 1.0}
    one = campaign("scenarios=[lead_brakes]", f"environments={{lead_brakes: {tmp_path / 'mine.yaml'}}}")
    told = hour_lines(run_here(one, tmp_path / "run").content)
    assert " in SUMO’s twin, 1 scenario · " in told[0]
    assert "  events per hour, given: lead brakes 0.3; other numbers: harness" in "\n".join(told)
    (tmp_path / "mine.yaml").write_text("like: lead-brakes-1\nexposure: {per_hour: {value: 0.5, source: user}}\n")
    folder = tmp_path / "run"
    for again, of in ((estimate_families, folder), (other_traffic.sensitivity, folder / "lead_brakes")):
        with pytest.raises(RunFolderError, match="which made the records"):  # the tests are of the file as it was
            again(of)
    with pytest.raises(CampaignError, match="no file"):
        campaign("environments={lead_brakes: ./none.yaml}")
    with pytest.raises(CampaignError, match="cut-out-1"):
        campaign("environments={cut_out: cut-out-7}")


@pytest.mark.slow
def test_what_the_answer_of_one_scenario_depends_on(run, monkeypatch):
    """Harder peaks, or longer ones: twice, or three times as many crashes; how many events there are moves none."""
    monkeypatch.setattr(moved, "N_PATHS_OF_FOLLOWERS", 256)  # of some ends these few do not tell
    found = harness.sensitivity(run.folder / "lead_brakes")
    rates = {bar["what"]: bar["rate"] for bar in found["bars"]}
    assert 1.5 < rates["braking.peak_scale_mps2"][1] < 3.0
    assert 1.2 < rates["braking.held_log_sd"][1] < 3.0
    assert not [name for name in rates if name.startswith("exposure")]


def test_who_does_not_look_moves_the_answer_of_the_sum_as_sensitivity_says(run, monkeypatch):
    """Both of events per hour that stay, as counted: not of tests, of which more would have such an event."""
    every = other_traffic.moves
    monkeypatch.setattr(
        other_traffic, "moves", lambda *given: [of for of in every(*given) if of.what == "cut_in.ignore_share"]
    )
    (bar,) = other_traffic._of_one(run.folder / "cut_in", {}, Progress(), per_event=True).bars
    of = run.content["families"]["cut_in"]["assumed"]
    assert bar.rate == pytest.approx(of["times"], rel=0.01)
    (of_tests,) = other_traffic._of_one(run.folder / "cut_in", {}, Progress()).bars
    assert of_tests.rate[1] > 1.2 * bar.rate[1]
    assert of_tests.ratio == pytest.approx(bar.ratio, rel=1e-12)


@pytest.mark.slow
def test_a_comparison_drives_no_test_that_a_stored_run_of_a_has(run, tmp_path, capsys):
    call = ["compare", str(run.folder), "late-600ms", "--out", str(tmp_path / "out"), "--workers", "1", "--json"]
    assert main(call) in (0, 4)  # so small a pool may be used up
    found = json.loads(capsys.readouterr().out)
    for name in NAMES:
        held, n_pairs = read_manifest(run.folder / name)["n_episodes"], found["families"][name]["n_pairs"]
        n = read_manifest(tmp_path / "out" / name / "a")["n_episodes"]
        assert max(held, n_pairs) <= n < held + n_pairs  # those held are of strata that pairs need, or not
    assert [of["label"] for of in found["campaigns"].values()] == ["idm", "late-600ms"]  # as A's campaign says
    a, b = (found[side] for side in "ab")
    assert a["per_hour"]["rate"] - b["per_hour"]["rate"] == pytest.approx(found["difference"])
    assert a["n_episodes"] == b["n_episodes"] == found["n_pairs"]  # further tests that are held do not count


def test_a_stored_campaign_that_is_damaged_is_not_believed(run, tmp_path):
    stored = copy_of(run.folder, tmp_path / "stored")
    file = stored / "campaign.yaml"
    file.write_text(file.read_text().replace("exposure: {}", "exposure: {lead_brakes: 7.0}"))
    with pytest.raises(RunFolderError, match="checksum"):
        compare_campaigns(campaign(), campaign(HARDER), tmp_path / "out", stored=stored)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_sum_warns_of_what_a_scenario_alone_would(tmp_path):
    """Tests that failed, that differed when run twice, that crashed before the event: each says of which scenario."""
    asked = ("stop.rhw=null", "stop.episodes=400", "scenarios=[cut_in, lead_brakes]", "run.max_failed_share=0.5")
    moody = "av={controller: 'tests.controllers.misbehaving:Moody'}"
    run = run_here(campaign(*asked, moody), tmp_path / "run")
    told = " ".join(repr(run).split())
    for name, words in (("cut_in", "cut-in"), ("lead_brakes", "lead brakes")):
        of, alone = run.content["families"][name], run.runs[name].estimates
        best, scale = alone["estimates"]["shells"], of["exposure"]["per_hour"] / of["p_event"]
        assert of["n_failed"] == best["details"]["n_failed"] > 0
        worst = scale * best["details"]["crash_rate_if_failed_had_crashed"]
        assert of["if_failed_had_crashed"] == pytest.approx(worst, rel=1e-12)
        failed = f"{of['n_failed']} of {of['n_episodes']} tests FAILED; had they all crashed, as upper limits assume"
        assert f"! {words}: {failed}, the rate would be {number(worst)} per hour" in told
        assert f"! {words}: NOT REPRODUCIBLE: " in told
    assert "! lead brakes: " in told.partition("tests crashed BEFORE the event")[0]
    again = estimate_families(run.folder)
    assert {**again, "crc32": 0} == {**run.content, "crc32": 0}
