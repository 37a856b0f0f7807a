from __future__ import annotations

import re
from pathlib import Path

import matplotlib.style
import pytest

import harness.report
from harness.report.plot_style import CSS_NAMES, INK, RC, Plot, inline_svg, new_figure, svg

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
