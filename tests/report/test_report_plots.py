"""The look of all plots, the answer's axis and intervals, and names of lines: where no line is, and one for each."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib.style
import numpy as np
import pytest

import harness.report
from harness.report.answer_plot import answer_plot
from harness.report.convergence_plot import convergence_plot
from harness.report.crash_gallery import NAME_HEIGHT, Track, time_space_plot
from harness.report.plot_style import CSS_NAMES, INK, RC, Plot, inline_svg, new_figure, svg
from harness.report.run_folder import StoredEstimates
from harness.report.summary import Crash

CSS = (Path(harness.report.__file__).parent / "report.css").read_text(encoding="utf-8")
LIGHT, DARK, PRINT = re.findall(r":root \{(.*?)\n\s*\}", CSS, flags=re.DOTALL)


@pytest.mark.parametrize("block", [LIGHT, DARK, PRINT], ids=["light", "dark", "print"])
def test_every_plot_colour_is_a_css_variable_in_every_scheme(block):
    defined = set(re.findall(r"--([\w-]+): #[0-9a-f]{6};", block))
    assert set(CSS_NAMES.values()) <= defined


def test_plot_files_and_light_page_have_the_same_colours():
    for colour, name in CSS_NAMES.items():
        if name != "muted":
            assert f"--{name}: {colour};" in LIGHT
            assert f"--{name}: {colour};" in PRINT


def luminance(colour: str) -> float:
    channels = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("block", [LIGHT, DARK], ids=["light", "dark"])
def test_text_and_lines_have_enough_contrast(block):
    """WCAG 2: at least 4.5 to 1 for text, 3 to 1 for graphics."""
    colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", block))
    for background in ("paper", "tint"):
        for name, least in (("ink", 7.0), ("muted", 4.5), ("blue", 4.5), ("vermillion", 3.0), ("green", 3.0)):
            high, low = sorted((luminance(colours[name]), luminance(colours[background])), reverse=True)
            assert (high + 0.05) / (low + 0.05) >= least, (background, name)


def test_inline_svg_is_themed_text_without_names_or_namespaces():
    with matplotlib.style.context(["default", RC]):
        figure = new_figure(2.0, 1.0)
        axes = figure.subplots()
        axes.plot([0.0, 1.0], [0.0, 1.0], "o-", color=INK)
        axes.set_title("<b>a & b</b> $x$")
        markup = inline_svg(svg(Plot("tiny", figure, "alt", "caption")))
    assert markup.startswith("<svg viewBox=")
    assert "xmlns" not in markup
    assert "var(--ink)" in markup
    assert '<g id="' not in markup
    assert "&lt;b&gt;a &amp; b&lt;/b&gt; $x$" in markup
    assert "var(--sans)" in markup
    assert "DejaVu" not in markup


def estimates(**rates: tuple[float, float, float] | None) -> StoredEstimates:
    entries = {
        name: {"crash_rate": None, "reason": "not allowed"}
        if rate is None
        else dict(zip(("crash_rate", "ci_low", "ci_high"), rate, strict=True))
        for name, rate in rates.items()
    }
    return StoredEstimates(
        campaign="c", campaign_hash="h", lane_change_level=1.0, confidence=0.9, headline=next(iter(rates)),
        estimates=entries, statement="s", distance_per_test_km=0.3,
    )  # fmt: skip


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
    assert list(axes.lines[0].get_xdata()) == [1.5e-7, 2.5e-7]
    assert "2.00 (1.50 to 2.50) × 10⁻⁷" in [text.get_text() for text in axes.texts]


def test_nothing_to_draw_without_any_rate():
    assert answer_plot(estimates(scv=None), None) is None


@pytest.mark.parametrize("name", ["full", "shells", "shells_inside_only"])
def test_legends_of_convergence_lie_outside_the_panels(runs, name):
    plot = convergence_plot(runs[name].estimates, 0.05)
    svg(plot)  # lays out
    for axes in plot.figure.axes:
        legend = axes.get_legend().get_window_extent()
        assert legend.y0 >= axes.get_window_extent().y1 - 1.0
        assert legend.x1 <= plot.figure.bbox.x1


def test_speeds_are_named_apart_even_if_equal():
    crash = Crash(
        episode=7, impact_speed_mps=10.0, crash_time_s=8.0, log_weight=0.0, cut_in_step=70.0, cut_in_r2_m=9.0,
        cut_in_r2dot_mps=-10.0, component=0,
    )  # fmt: skip
    time_s = np.arange(0.0, 8.05, 0.1)
    speeds = {"LV": 20.0, "BV": 20.0, "AV": 30.0}
    still = np.zeros(time_s.size)
    tracks = {
        name: Track(time_s, 10.0 * k + (speed - 20.0) * time_s, still + speed, still, still)
        for k, (name, speed) in enumerate(speeds.items())
    }
    speed = time_space_plot(crash, tracks, worth="weight 1").figure.axes[1]
    heights = {text.get_text(): text.xy[1] for text in speed.texts}
    assert set(heights) == set(speeds)
    assert abs(heights["LV"] - heights["BV"]) >= NAME_HEIGHT
    assert heights["AV"] == max(heights.values())
