"""The answer at a glance of every kind of run: short, and with what changes its meaning."""

import math
import re
from dataclasses import replace

import pytest

import harness
from harness.estimators.answer import STORED_ESTIMATES, AssumedOfRate, estimate_blocks, n_softened
from harness.estimators.stopping import Decision
from harness.numbers import number, plain, ratio
from harness.records.folder import read_manifest
from harness.report.rows import decided, held_back, ratio_texts
from harness.report.summary import read_run_folder
from harness.report.words import LINES, WIDTH, columns, go_on, lines, short_answer
from harness.runner.stored import stored_blocks
from harness.sampling.paths import n_left_out
from tests.stored_runs import answer_in, estimates, golden

SAID = {
    "nde-twin": ["lane_change_level is 3,000,000: compare only with", "impact speed "],
    "step-recursive-twin": ["the true rate may lie far above this interval: a crash may weigh 1.00 × 10²⁰⁰, and all"],
    "forced-failing-twin": [
        " of 240 tests FAILED; had they all crashed, as upper limits assume, the rate would be ",
        "; most with: ",
    ],
    "shells-twin": ["crash rate  ", "× competent driver  ", "r157-cc, UN R157’s driver", "impact speed  "],
    "shells-accepted": [
        "ACCEPTED ",
        "rate below 4 × 10⁻⁷ per test",
        "confidence 0.95 over all looks",
        "stopped: verdict reached",
    ],
    "shells-refuted": ["138 (crashes more)", "stopped: all tests done"],
    "shells-inside": ["given the library ", "no tests outside it", "crash rate so far", "impact speed so far"],
    "shells-acting-twin": ["tests.golden.vehicles:Speeds · 240 tests in SUMO’s twin", "r157-cc, from the same state"],
    "forced-inattentive": ["fvdm (reaction.delay_s 0.2, "],
    "forced-krauss": ["SUMO’s Krauss · 240 tests in SUMO"],
    "shells-lateral-twin": ["idm · 240 tests"],
}


@pytest.mark.parametrize("name", SAID)
def test_it_is_short_and_says_what_changes_the_meaning(name, stored_run):
    run = read_run_folder(stored_run(name))
    text = lines(short_answer(run.campaign, run.manifest, run.estimates), 3.21, run.path / "report.html")
    assert len(text) - sum(line.startswith("    ") for line in text) <= LINES
    assert max(map(len, text[:-1])) <= WIDTH
    assert "…" not in "".join(text[1:])
    assert " · 3.2 s" in text[0]
    assert text[-1] == f"  report  {run.path}/report.html"
    scope = "; 90 % intervals cover sampling error in this simulated traffic only; stopped: "
    assert scope in re.sub(r"\n    ", " ", "\n".join(text))
    assert [each for each in SAID[name] if each not in re.sub(r"\n    ", " ", "\n".join(text))] == []


def said(run, best=None, campaign=None, manifest=None, **changes):
    """The answer of a run, had its estimate, or others of its numbers, been other ones."""
    found = {run.estimates.headline: best or run.estimates.best}
    return short_answer(campaign or run.campaign, manifest or {}, replace(run.estimates, estimates=found, **changes))


def test_without_a_crash_there_is_a_bound_and_nothing_about_impacts(stored_run):
    """Of the same tests had none crashed: above 50 m/s none did."""
    folder, campaign = stored_run("shells-twin"), golden("shells-twin", "crash.counts_above_mps=50")
    blocks, known = [block.harder_than(50.0) for block in stored_blocks(folder, moments=False)], read_manifest(folder)
    told = STORED_ESTIMATES.validate_python(estimate_blocks(blocks, campaign, known))
    rows = {row.key: row for row in short_answer(campaign, known, told).rows}
    assert set(rows) == {"rate", "ratio"}
    assert (rows["rate"].what, rows["rate"].interval) == ("crash rate > 50 m/s", "no crash seen")
    assert rows["rate"].value.startswith("< ")
    assert rows["rate"].remark.startswith("< ")


@pytest.mark.parametrize(
    ("name", "shows", "blind", "held"),
    [
        ("forced-krauss", True, True, False),
        ("forced-krauss", False, False, False),
        ("shells-lateral-twin", True, False, False),
        ("shells-controller-sumo", True, False, True),
    ],
)
def test_what_a_vehicle_of_the_users_own_did_while_bv_came_over_is_warned_of(name, shows, blind, held, stored_run):
    run = read_run_folder(stored_run(name))
    counts = dict.fromkeys(("n_asked_to_speed_up", "n_braked_before", "n_braked"), 1234 * (name != "forced-krauss"))
    asked = {**run.estimates.diagnostics, **counts}
    warnings = "".join(said(run, manifest={"events_show": shows}, diagnostics=asked).warnings)
    assert ("cannot see that BV comes over" in warnings) == blind
    assert ("1,234 tests it asked to speed up" in warnings) == held
    assert ("or set av.before_event=controller" in warnings) == (name != "forced-krauss")
    assert ("1,234 tests it braked with nobody ahead" in warnings) == (name != "forced-krauss")
    assert ("it never braked with 1 m/s² or more" in warnings) == (name == "forced-krauss")


@pytest.mark.parametrize(
    ("seen", "high", "first", "value", "ends"),
    [
        (0.0, 0.2, "ratio", "< 0.20", "no crash seen"),
        (0.08, 0.2, "ratio", "< 0.20 (crashes less)", "estimate 0.080, 0.050 to 0.20"),
        (0.08, 3.0, "rate", "< 3.00 × 10⁻⁸ per test", "estimate 1.00 × 10⁻⁹"),
    ],
)
def test_what_is_known_of_an_attentive_vehicle_comes_first(seen, high, first, value, ends, stored_run):
    """An upper limit, where the interval is wide or nothing crashed; the ratio's, where it says something."""
    run = read_run_folder(stored_run("shells-lateral-twin"))
    [beside, *_] = run.estimates.best.details["references"]
    low = 0.0 if seen == 0.0 else 0.05
    beside = {**beside, "reference": "r157-cc", "crash_rate": 3e-8, "ratio": seen, "ratio_low": low, "ratio_high": high}
    rate = {"crash_rate": 1e-9 * (seen > 0.0), "ci_low": 5e-10 * (seen > 0.0), "ci_high": 3e-8, "rhw": 15.0}
    tested = [{**each, "n_episodes": 9} for each in run.estimates.best.details["shells"]]
    details = {**run.estimates.best.details, "references": [beside], "shells": tested}
    best = replace(run.estimates.best, **rate, n_crashes=2 * (seen > 0.0), details=details)
    rows = said(run, best, golden("shells-lateral-twin", "stop.rhw=0.3"), severity=None).rows
    assert (rows[0].key, rows[0].value, rows[0].interval) == (first, value, ends)


@pytest.mark.parametrize(("name", "untested"), [("shells-inside", True), ("shells-twin", False)])
def test_a_rate_that_counts_no_crash_where_nothing_was_tested_says_so(name, untested, stored_run):
    content = estimates(stored_run(name))
    rows = {row["key"]: row for row in answer_in(stored_run(name))["rows"]}
    rate = rows["rate"]
    shells = content["estimates"]["shells"]["details"]["shells"]
    assert any(not each["n_episodes"] for each in shells) == untested
    assert (rate["what"] == "crash rate so far") == untested
    assert rate["remark"].endswith(" per hour")
    assert not rows["ratio"]["value"].startswith("≥")
    assert (rows["impact"]["what"] == "impact speed so far") == untested


def test_what_a_missed_precision_takes_is_told_once(stored_run):
    run = read_run_folder(stored_run("shells-acting-twin"))
    manifest = {**run.manifest, "expected": {"runs": run.campaign.pool.shadow_paths, "tests": 900}}
    answer = said(run, campaign=run.campaign.replaced(("stop", "rhw"), 0.01), manifest=manifest)
    told = " ".join([*(row.remark for row in answer.rows), answer.scope])
    assert re.findall(r"stop\.episodes=\d+", told) == ["stop.episodes=900"]


def test_a_gate_whose_pool_is_used_up_says_what_to_raise(stored_run):
    run = read_run_folder(stored_run("shells-accepted"))
    decision = {**run.manifest["decision"], "verdict": "undecided"}
    answer = said(run, stopped_by="pool", decision=decision)
    assert answer.scope.endswith("; raise pool.events_per_shell, with a new --out")


@pytest.mark.parametrize(("verdict", "untested"), [("rejected", False), ("rejected", True), ("accepted", True)])
def test_an_end_that_says_nothing_is_not_shown(stored_run, verdict, untested):
    """Where a limit is rejected, or the upper end is what has not been tested: the lower end alone says something."""
    run = read_run_folder(stored_run("shells-accepted"))
    decision, details = {**run.manifest["decision"], "verdict": verdict}, run.estimates.best.details
    shells = [{**each, "n_episodes": each["n_episodes"] * (not untested)} for each in details["shells"]]
    beside = {**details["references"][0], "ratio": 3.98, "ratio_low": 2.0, "ratio_high": 980.0}
    rate = {"crash_rate": 2e-7, "ci_low": 1e-7, "ci_high": 5e-5, "rhw": 100.0}
    best = replace(run.estimates.best, **rate, details={**details, "references": [beside], "shells": shells})
    limits = {"limits_above_5_mps": (0.0, 1.0), "limits_below_1_mps": (0.001, 0.41)}
    severity = replace(run.estimates.severity, **limits, share_below_1_mps=0.0)
    others = AssumedOfRate("", 0.25, (0.1, 25.0), 0.01)
    rows = said(run, best, severity=severity, decision=decision, assumed=others).rows
    found = {row.key: row.texts[1:] for row in rows}
    assert found["rate"][:2] == ("> 1.00 × 10⁻⁷ per test", "estimate 2.00 × 10⁻⁷")
    assert found["ratio"][:2] == ("> 2.00 (crashes more)", "estimate 3.98")
    assert "assumed" not in found
    assert found["impact"][1:] == ("", "0 % (0–41 %) below 1 m/s")


@pytest.mark.parametrize(
    ("times", "verdict", "said_of_it"),
    [
        ((0.9, 1.2), "accepted", None),
        ((3.0, 0.8), None, "7.20 to 27.0"),
        ((3.0, 0.8), "accepted", "0.40 to 1.50, which may turn the verdict"),
        ((1.5, 0.8), "accepted", "0.40 to 0.75"),
        ((0.2, 1.3), "rejected", "1.80 to 11.7"),
        ((0.1, 1.3), "rejected", "0.90 to 11.7, which may turn the verdict"),
    ],
)
def test_a_ratio_that_moves_with_who_does_not_look_is_warned_of(times, verdict, said_of_it, stored_run):
    """Of a vehicle with half or nine times the reference driver's rate, and a limit of once that."""
    run = read_run_folder(stored_run("shells-accepted"))
    details = run.estimates.best.details
    beside = {**details["references"][0], "ratio": 0.5 if verdict == "accepted" else 9.0}
    best = replace(run.estimates.best, details={**details, "references": [beside]})
    decision = verdict and {**run.manifest["decision"], "verdict": verdict, "driver": "r157-cc", "limit": 1.0}
    others = AssumedOfRate("", 0.25, (0.1, 25.0), 0.01, times)
    warnings = said(run, best, decision=decision, assumed=others).warnings
    found = [text.rpartition("it is ")[2] for text in warnings if "rests on who does not look" in text]
    assert found == ([] if said_of_it is None else [said_of_it])


@pytest.mark.parametrize(("cut_off", "high", "warned"), [(0.19, 1.1, False), (0.3, 1.2, True), (0.3, 1.4, False)])
def test_tests_whose_time_was_up_are_warned_of_where_the_interval_leaves_them_out(cut_off, high, warned, stored_run):
    """They are many, and had they crashed the rate would be above its upper end."""
    run = read_run_folder(stored_run("shells-twin"))
    best, rate = run.estimates.best, run.estimates.best.crash_rate
    times = (1.0 + cut_off) * rate / best.details["references"][0]["crash_rate"]
    for severity in (run.estimates.severity, None):  # a crash or none
        of = {"severity": severity, "cut_off": cut_off * rate, "cut_off_test": 17}
        warnings = said(run, replace(best, ci_high=high * rate), **of).warnings
        told = [each.rpartition(" per test, ")[2] for each in warnings if "test 17" in each]
        assert told == [f"× {ratio(times)} (competent driver)"] * warned


@pytest.mark.parametrize("value", [5e-324, 1e-320, 3e-7, -2e-9, 9.99999999999e-5, 2e6])
def test_any_number_can_be_written(value):
    """Those that are too small for a power of ten of their own, too."""
    for text in (plain(value), number(value)):
        digits, _, power = text.replace("−", "-").replace(",", "").partition(" × 10")
        read = float(f"{digits}e{power.translate(str.maketrans('⁻⁰¹²³⁴⁵⁶⁷⁸⁹', '-0123456789')) or 0}")
        assert read == pytest.approx(value, rel=1e-2, abs=1e-323)


def test_a_row_that_is_too_long_keeps_the_columns_before_what_is_long():
    rows = [("lead brakes", "0.1", "×" * 40, "median"), ("cut-in", "2", "1", "×" * 45), ("cut-out", "3", "2", "×" * 22)]
    shown = list(columns(rows))
    assert max(map(len, shown)) <= WIDTH
    assert [line.index(row[1]) for line, row in zip(shown, rows, strict=True)] == [15, 15, 15]


@pytest.mark.parametrize(("low", "told"), [(0.0, "nothing is known yet"), (0.2, "at least 0.200")])
def test_a_decision_without_an_upper_end_is_written_and_told(low, told):
    found = Decision(0.5, "assumption_free", 0.95, low, math.inf, 40, "r157-cc").to_json()
    assert (found["verdict"], found["high"], held_back(found)) == ("undecided", None, False)
    assert decided(found).remark == told


@pytest.mark.parametrize(
    ("n_crashes", "high", "said"), [(0, 2.6, True), (1, 2.6, False), (0, None, False), (0, 0.9, False)]
)
def test_what_an_undecided_limit_takes_is_told_where_none_crashed(n_crashes, high, said):
    how = "stop.episodes=7800 decides, if none of them crashes" if said else "stop.episodes=6000 goes on"
    assert go_on(3000, n_crashes, {"high": high, "limit": 1.0}) == f"; the same command with --resume --set {how}"


@pytest.mark.parametrize(("further", "n"), [(1.2, 6000), (4.01, 13_000), (math.inf, 30_000)])
def test_what_a_precision_takes_is_told_where_the_budget_ended_before(further, n):
    assert f"stop.episodes={n} " in go_on(3000, further=further)


@pytest.mark.parametrize(
    ("behind", "braked", "waits", "built_in", "n"),
    [
        (11, 0, False, False, 11),
        (10, 0, False, False, 0),
        (0, 50, True, False, 50),
        (0, 50, False, False, 0),
        (90, 90, True, True, 0),
    ],
)
def test_many_events_that_it_made_milder_are_more_than_a_tenth(behind, braked, waits, built_in, n):
    acts = {"n_fell_behind": behind, "n_braked_before": braked, "waits": waits, "built_in": built_in, "n_events": 100}
    assert n_softened(acts) == n
    reference = {"ratio": 0.5, "ratio_low": 0.4, "ratio_high": 0.6}
    less, _ = ratio_texts(reference, wide=False, from_below=False, softened=n > 0)
    assert less == ("0.50 (crashes less, see !)" if n else "0.50 (crashes less)")


def test_crashes_before_events_are_left_out_where_the_vehicle_follows():
    """But not by plain simulation, which counts such crashes as they are."""
    asked = [["scenario=lead_brakes"], ["scenario=lead_brakes", "testing.method=nde"], ["scenario=cut_out"], []]
    assert [n_left_out(harness.load_campaign("idm", each), 3) for each in asked] == [3, 0, 3, 0]
