"""The look of all plots, scales of axes, intervals where they are, and names that no line can hide."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib.style
import pytest

import harness.report
from harness.estimators.estimate import Estimate, Estimates, Unavailable
from harness.numbers import number
from harness.report.rate_plots import POOL, answer_plot, shells_plot
from harness.report.style import CSS_NAMES, INK, RC, Plot, inline_svg, new_figure, svg

CSS = (Path(harness.report.__file__).parent / "report.css").read_text(encoding="utf-8")
LIGHT, DARK, PRINT = re.findall(r":root \{(.*?)\n\s*\}", CSS, flags=re.DOTALL)


@pytest.mark.parametrize("block", [LIGHT, DARK, PRINT], ids=["light", "dark", "print"])
def test_every_plot_colour_is_a_css_variable_in_every_scheme(block):
    defined = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", block))
    assert set(CSS_NAMES.values()) <= set(defined)
    if block != DARK:
        assert [name for colour, name in CSS_NAMES.items() if defined[name] != colour and name != "muted"] == []


def test_inline_svg_is_themed_text_without_names_or_namespaces():
    with matplotlib.style.context(["default", RC]):
        figure = new_figure(2.0, 1.0)
        axes = figure.subplots()
        axes.plot([0.0, 1.0], [0.0, 1.0], "o-", color=INK)
        axes.set_title("<b>a & b</b> $x$")
        markup = inline_svg(svg(Plot("tiny", figure, "alt", "caption")))
    assert markup.startswith("<svg viewBox=")
    for there in ("var(--ink)", "&lt;b&gt;a &amp; b&lt;/b&gt; $x$", "var(--sans)"):
        assert there in markup
    for absent in ("xmlns", '<g id="', "DejaVu"):
        assert absent not in markup


def estimates(**rates: tuple[float, float, float] | None) -> Estimates:
    rest = 1.0, 0.9, 0.1, 9, 9, 9.0, 0.1, "m"
    found = {
        name: Unavailable("why") if rate is None else Estimate(rate[0], 0.0, *rate[1:], *rest)
        for name, rate in rates.items()
    }
    return Estimates("c", "h", 1.0, 0.9, 9, 9, next(iter(rates)), 0.3, None, found, {}, (), "s", {}, (), {}, "")


@pytest.mark.parametrize(
    ("rates", "scale"),
    [
        ({"nade": (1.0e-7, 0.9e-7, 1.1e-7)}, "linear"),
        ({"nade": (1.0e-8, 1.0e-12, 2.0e-8)}, "linear"),
        ({"nde": (0.0, 0.0, 3.0e-4)}, "linear"),
        ({"nade": (1.0e-7, 0.9e-7, 1.1e-7), "nde": (0.0, 0.0, 1e-4)}, "log"),
        ({"nade": (1.0e-7, 0.9e-7, 1.1e-7), "other": (1.0e-4, 0.0, 2e-4)}, "log"),
    ],
)
def test_axis_is_logarithmic_only_where_estimators_differ_by_orders_of_magnitude(rates, scale):
    plot = answer_plot(estimates(**rates), None)
    axes = plot.figure.axes[0]
    plot.figure.draw_without_rendering()
    assert axes.get_xscale() == scale
    low, high = axes.get_xlim()
    for rate, _, end in rates.values():
        assert end <= high
        assert rate >= low or rate == 0.0


def test_intervals_are_drawn_where_they_are_with_the_headline_first():
    plot = answer_plot(estimates(cv=(2.0e-7, 1.5e-7, 2.5e-7), nade=(2.1e-7, 1.0e-7, 3.0e-7), scv=None), None)
    axes = plot.figure.axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["cv", "nade"]
    (first,) = axes.containers[0].lines[2]
    assert first.get_segments()[0][:, 0] == pytest.approx([1.5e-7, 2.5e-7])
    assert "2.00 (1.50 to 2.50) × 10⁻⁷" in [text.get_text() for text in axes.texts]
    assert answer_plot(estimates(scv=None), None) is None


def test_the_plot_shows_contributions_and_half_widths(runs):
    """The latter are what is not known, that of the pool included; a refuted statement has no interval."""
    found = runs["shells"].shells
    rates, widths = shells_plot(found).figure.axes
    assert [label.get_text() for label in rates.get_yticklabels()] == [*(s.shell for s in found.shells), POOL]
    assert [bar.get_width() for bar in rates.patches] == [*(s.contribution for s in found.shells), 0.0]
    half_widths = [*(s.half_width for s in found.shells), found.pool_half_width]
    assert [bar.get_width() for bar in widths.patches] == half_widths
    assert sum(map(found.share_of_uncertainty, half_widths)) == pytest.approx(1.0)
    for name, rows in (("shells", ["shells", "given library", "given need-based"]), ("shells_refuted", ["shells"])):
        axes = answer_plot(runs[name].estimates, runs[name].shells).figure.axes[0]
        assert [label.get_text() for label in axes.get_yticklabels()] == rows


def test_a_shell_without_tests_is_said_so_and_runs_out_of_the_plot(runs):
    found = runs["shells_inside_only"].shells
    rates, widths = shells_plot(found).figure.axes
    outside = found.shells[-1]
    label = f"{outside.shell}\nnot tested: up to {number(outside.p)}"
    assert rates.get_yticklabels()[len(found.shells) - 1].get_text() == label
    assert max(rates.get_xlim()[1], widths.get_xlim()[1]) < 0.1 * outside.p
