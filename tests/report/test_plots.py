"""The look of all plots, scales of axes, intervals where they are, and names that no line can hide."""

import re
from xml.etree import ElementTree

import numpy as np
import pyarrow.parquet as pq
import pytest

from harness.estimators.traffic import Bar, Sensitivity
from harness.families import family_named
from harness.records.reader import traffic_of
from harness.report.drawing import PlotAxis, PlotPanel
from harness.report.plots import POOL, limits_of_others, sensitivity_plot, severity_plot, shells_plot
from harness.report.summary import summarise
from harness.vocabulary import CRASH, OUTCOMES


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


def test_others_avoid_a_crash_from_the_gap_on_that_their_brakes_need(runs):
    """No less than v²/2b and 0.1 s, no more than half a metre and half a second above; a delay of 0.47 s needs more."""
    run = runs["shells"]
    lines = limits_of_others(family_named("cut_in"), traffic_of(run.campaign, run.manifest), summarise(run), 12.0)
    (speeds, at_once), (_, competent) = lines["brakes-8"], lines["r157-cc"]
    needed = speeds**2 / 16.0
    assert np.all((at_once > needed - 0.3) & (at_once < needed + 0.5 * speeds + 0.5))
    assert np.all(np.diff(competent) >= 0.0)
    assert np.all(competent[speeds > 3.0] > at_once[speeds > 3.0])


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


# -- counts, weights, rankings and bins against the whole table --


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
