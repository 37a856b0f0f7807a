"""The page of each kind of run: what it says, that it is self-contained, and that it comes out the same again."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyarrow.parquet as pq
import pytest
from junitparser import JUnitXml

from harness.estimators.traffic import Bar, Sensitivity
from harness.report.drawing import PlotAxis, PlotPanel
from harness.report.junit import difference_case, statement_case, write_junit
from harness.report.plots import POOL, sensitivity_plot, severity_plot, shells_plot, where_plot
from harness.report.summary import read_run_folder, summarise
from harness.runner.stored import write_report
from harness.vocabulary import CRASH, OUTCOMES
from tests.report.page_text import GOLDEN, KINDS, PAGES, Page, golden_text
from tests.stored_runs import copy_of, edit, estimates

SEEN = {
    "weighted": ({"severity"}, ["defensive_share: 0.1"]),
    "no_crash": (set(), ["No crash was seen."]),
    "nde": ({"severity"}, []),
    "shells": ({"severity", "shells"}, ["tests FAILED", "step: returned nan, expected"]),
    "shells_refuted": ({"severity", "shells"}, ["refuted by these tests; by test", "outermost no. 1"]),
}
"""Plots, and words that no other kind of run has."""


def test_a_verdict_is_said_first(stored_run, tmp_path):
    page = write_report(copy_of(stored_run("shells-accepted"), tmp_path / "run"))
    assert 'Answer</h2>\n<p class="big accepted">ACCEPTED <small>' in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", KINDS)
def test_the_page_says_what_it_always_said(reports, kind):
    """Where it is meant to say something else: ``python -m tests.report.page_text``, and read the difference."""
    said, before = golden_text(reports[kind]), (GOLDEN / f"{kind}.txt").read_text(encoding="utf-8")
    assert said.splitlines() == before.splitlines()


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_self_contained_with_plots_and_words_that_make_sense(reports, name):
    folder, page = reports[name], Page(reports[name])
    assert "://" not in page.html
    assert len(page.ids) == len(set(page.ids))
    for tag, attribute, value in page.attributes:
        assert tag not in {"link", "iframe"}
        assert (tag, attribute) != ("script", "src")
        assert not attribute.startswith("on")
        assert attribute not in {"href", "xlink:href", "src"} or value.removeprefix("#") in page.ids
    assert {reference[1:] for reference in re.findall(r"url\(([^)]*)\)", page.html)} <= set(page.ids)
    plots, words = SEEN[name]
    assert [each for each in words if each not in page.words] == []
    stems = {path.stem for path in (folder / "plots").iterdir()}
    assert stems == {"where"} | plots | ({"convergence"} if name != "no_crash" else set())
    for stem in stems:
        ElementTree.parse(folder / "plots" / f"{stem}.svg")
        assert f"plot-{stem}" in page.ids


def test_hostile_texts_are_escaped_and_no_formula(folders, tmp_path):
    hostile = "<script>alert('x')</script>$\\frac{&"
    folder = shutil.copytree(folders["no_crash"], tmp_path / "run")
    text = (folder / "campaign.yaml").read_text()
    described = text.replace('\ndescription: ""', f"\ndescription: {json.dumps(hostile + chr(27) + '[31m')}")
    (folder / "campaign.yaml").write_text(described)
    of = estimates(folder)["estimates"]
    warnings = [{"key": hostile}, {"key": "untested", "numbers": {"shells": [hostile]}}]
    named = of | {hostile: {**of["nade"], "warnings": warnings}}
    edit(folder, "estimates.json", campaign=hostile, headline=hostile, estimates=named)
    write_report(folder)
    page = Page(folder)
    assert hostile not in page.html
    assert page.words.count(hostile) >= 5
    assert hostile + "\\u001b[31m" in page.words


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_report_made_again_has_the_same_bytes(reports, tmp_path):
    """Plots of an earlier report go, other files stay."""
    folder = shutil.copytree(reports["weighted"], tmp_path / "run")
    before = contents(folder)
    for name in ("shells.svg", "my-notes.svg"):
        (folder / "plots" / name).write_text("left over")
    assert write_report(folder) == folder / "report.html"
    assert contents(folder) == before | {"plots/my-notes.svg": b"left over"}


# -- JUnit XML as a CI system reads it --


ABOVE = "REJECTED <above> & beyond\x1b[31m"


def content(**within):
    return {"headline": "shells", "estimates": {"shells": {"details": {"within": {"refuted": False, **within}}}}}


@pytest.mark.parametrize(("code", "kind"), [(0, None), (4, "Error"), (5, "Failure"), (3, "Failure")])
def test_what_was_asked_decides_and_nothing_else_is_told(tmp_path, code, kind):
    file, report = tmp_path / "gate.xml", tmp_path / "report.html"
    write_junit(file, "smoke", statement_case(content(), ABOVE, "assumption_free", code), [report])
    (suite,) = JUnitXml.fromfile(str(file))
    assert (suite.name, suite.tests, suite.skipped) == ("smoke", 1, 0)
    assert (suite.failures, suite.errors) == (int(kind == "Failure"), int(kind == "Error"))
    (asked,) = suite
    assert (asked.name, "library" in asked.system_out) == ("crash rate", False)
    assert [type(each).__name__ for each in asked.result] == ([] if kind is None else [kind])
    assert all("REJECTED <above> & beyond\\u001b[31m" in each.message for each in asked.result)
    assert f"[[ATTACHMENT|{report}]]" in asked.system_out
    assert [each.text for each in asked.result] == ([] if kind is None else ["REJECTED <above> & beyond\\u001b[31m"])


NO_SHELLS = {**content(), "estimates": {"shells": {"details": {}}}}
"""A method without shells may still carry a statement's name in its settings."""


@pytest.mark.parametrize(
    ("told", "code", "name", "outcome"),
    [
        (content(), 0, "crash rate, given the library", "passed"),
        (content(refuted=True), 0, "crash rate, given the library", "failure"),
        (content(refuted=True), 4, "crash rate, given the library", "failure"),
        (NO_SHELLS | {"decision": {"limit": 2.0, "driver": "r157-cc"}}, 4, "crash rate below 2 × r157-cc", "error"),
    ],
)
def test_a_refuted_assumption_fails_and_no_gate_passes_because_nothing_was_asked(told, code, name, outcome):
    case = statement_case(told, "", "library", code)
    assert (case.name, case.outcome) == (name, outcome)


def test_the_verdict_is_whole_and_of_a_comparison_its_own(tmp_path):
    """A row too long for a terminal goes on below; its cells are a sentence."""
    answer = (
        "idm · 9 tests\n  UNDECIDED  0 is the limit;\n    it may be 1.12 × 10⁻⁷ to 1.09\n    × 10⁻⁶\n  crash rate  1"
    )
    decision = {"margin": 0.1, "verdict": "refuted", "confidence": 0.95}
    worse = difference_case({"decision": decision}, "B is more …\n  A a  1", 5)
    told = statement_case(content(), answer, "assumption_free", 4), worse
    for case, verdict in zip(
        told, ("UNDECIDED: 0 is the limit; it may be 1.12 × 10⁻⁷ to 1.09 × 10⁻⁶", ""), strict=True
    ):
        write_junit(tmp_path / "gate.xml", "x", case, [])
        ((asked,),) = JUnitXml.fromfile(str(tmp_path / "gate.xml"))
        assert asked.result[0].message == (verdict or "B is more than 10 % worse than A")
    assert (worse.name, worse.outcome) == ("B is at most 10 % worse than A", "failure")
    assert difference_case({"decision": {**decision, "margin": None}}, "", 0).name == "difference"


def marks(panel, kind):
    """Columns of the marks of a kind, by label."""
    return {mark.label: tuple(map(np.atleast_1d, mark.columns)) for mark in panel.marks if mark.kind == kind}


def test_texts_are_escaped_and_marks_stand_where_their_axis_says():
    panel = PlotPanel("<b>a & b</b>", PlotAxis("gap", 0.0, 2e-7), PlotAxis("rate", 1e-3, 10.0, log=True))
    panel.add("line", "blue", [0.0, 1e-7, np.nan], [1e-3, 0.1, 1.0], label="a < b")
    panel.add("dots", "grey", [2e-7], [10.0], 3.0)
    svg = str(panel.svg)
    ElementTree.fromstring(svg)
    for there in ("&lt;b&gt;a &amp; b&lt;/b&gt;", "a &lt; b", ">gap, × 10⁻⁷</text>", ">0.5</text>", ">10</text>"):
        assert there in svg
    [(width, height)] = re.findall(r'<svg x="54.0" y="\S+" width="([\d.]+)" height="([\d.]+)">', svg)
    ends = f'd="M0.0 {height}L{float(width) / 2:.1f} {float(height) / 2:.1f}"', f'd="M{float(width) - 3:.1f} 0.0a3.0'
    assert [end for end in ends if end not in svg] == []


@pytest.mark.parametrize("name", ["shells", "weighted", "nde"])
def test_severity_is_drawn_as_it_was_estimated(name, runs):
    rows = [row for row in runs[name].estimates.severity.exceedance if row.crash_rate > 0.0]
    [panel] = severity_plot(runs[name].estimates).panels
    above, rate = marks(panel, "line")["rate of harder crashes"]
    assert list(zip(above, rate, strict=True)) == [(row.above_mps, row.crash_rate) for row in rows]
    [(_, _, high)] = marks(panel, "band").values()
    assert {row.ci_high for row in rows} <= set(high)
    assert severity_plot(runs["no_crash"].estimates) is None


def test_the_plot_shows_contributions_and_half_widths(runs):
    """The latter are what is not known, that of the pool included."""
    found = runs["shells"].shells
    rates, widths = shells_plot(found).panels
    assert rates.y.names == widths.y.names == (*(s.shell for s in found.shells), POOL)
    inside, outside, limits = (mark.columns for mark in rates.marks if mark.kind == "boxes")
    assert [*inside[1], *outside[1]] == [s.contribution for s in found.shells]
    assert [*map(tuple, np.transpose(limits[:2]))] == [(s.low, s.high) for s in found.shells]
    half_widths = [*(s.half_width for s in found.shells), found.pool_half_width]
    assert marks(widths, "boxes")[""][1].tolist() == half_widths
    assert sum(map(found.share_of_uncertainty, half_widths)) == pytest.approx(1.0)
    of_a_rough_pool = shells_plot(replace(found, rhw_from_pool=100.0)).panels[1]
    assert marks(of_a_rough_pool, "boxes")[""][1].max() == pytest.approx(100.0 * found.rate)


def test_counts_and_weights_by_outcome(folders, runs):
    summary, table = summarise(runs["weighted"]), pq.read_table(folders["weighted"] / "episodes").to_pandas()
    for k, outcome in enumerate(OUTCOMES):
        rows = table[table.outcome == outcome]
        assert summary.count[k] == len(rows)
        assert summary.weight[k] == pytest.approx(np.exp(rows.log_weight).sum(), rel=1e-12)


@pytest.mark.parametrize("name", ["shells", "shells_refuted"])
def test_weights_of_a_shells_run_add_up_to_the_rate(runs, name):
    """Those that are recorded do not: they ignore how often shells were tested."""
    run, summary = runs[name], summarise(runs[name])
    assert summary.per_test(float(summary.weight[CRASH])) == pytest.approx(run.estimates.best.crash_rate, rel=1e-12)
    assert summary.crashes["weight"].sum() == pytest.approx(run.estimates.best.crash_rate, rel=1e-12)


def test_what_moves_the_rate_most_need_not_move_its_ratio():
    gaps = Bar("cut_in.ignore_share", "assumed", (0.001, 0.25), (0.1, 25.0), (1.004, 0.9996), (0.0, 0.0))
    speeds = Bar("lateral.speed_median_mps", "assumed", (0.6, 1.3), (1.003, 1.08), (3.69, 0.519), (0.0, 0.0))
    said = sensitivity_plot(Sensitivity("", "smoke", "r157-cc", (gaps, speeds))).caption
    assert "The rate depends most on cut_in.ignore_share: × 0.10 to × 25;" in said
    assert "its ratio to r157-cc on lateral.speed_median_mps: × 0.519 to × 3.69." in said


def test_an_end_that_the_tests_do_not_say_is_not_given_as_one():
    stops = Bar("braking.stop_share", "assumed", (0.0, 0.2), (0.305, np.nan), (0.359, np.nan), (0.5, 0.6), unlike=1)
    said = sensitivity_plot(Sensitivity("", "smoke", "r157-cc", (stops,))).caption
    assert "on braking.stop_share: × 0.30 to × 1.0 (the other end is not known" in said
    assert said.count("the other end is not known") == 2


@pytest.mark.parametrize("name", ["shells-twin", "forced-twin"])
def test_the_map_holds_every_crash(name, stored_run):
    run = read_run_folder(stored_run(name))
    summary = summarise(run)
    crashed = summary.rows["outcome"] == CRASH
    rate = summary.rows["event_rate_mps"].copy()
    rate[crashed.argmax()] = -90.0  # one is far from all others
    summary = replace(summary, rows={**summary.rows, "event_rate_mps": rate})
    for panel, axes in zip(where_plot(run, summary).panels, run.family.maps, strict=True):
        for axis, shown in zip((panel.x, panel.y), axes, strict=True):
            assert axis.low <= shown.of(summary.rows)[crashed].min()
            assert shown.of(summary.rows)[crashed].max() <= axis.high
