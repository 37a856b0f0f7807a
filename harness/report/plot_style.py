"""One look for all plots, axes that show small rates, and three forms: PNG, SVG file, and SVG inside the page.

Inside the page the palette's colours become CSS variables, so that plots follow the page's light or dark scheme, and
text stays text in the page's own typeface. Everything that would make two runs differ (dates, random ids) is fixed.
"""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from harness.report.number_format import exponent_of, plain, power_of_ten

INK, MUTED, GRID, PAPER = "#1c2126", "#5d6873", "#dde2e7", "#ffffff"
BLUE, VERMILLION, GREEN, GREY = "#0067a8", "#c94f0a", "#00795a", "#8b95a0"
BLUES = ("#dceaf5", "#b3d1e8", "#7fb2d7", "#478fc1", "#166ba3", "#083f68")
REDS = ("#fbe5d8", "#f5c3a5", "#ea9a6c", "#d96f36", "#b34a10", "#6f2a05")
VEHICLE_COLOURS = {"LV": GREEN, "BV": VERMILLION, "AV": BLUE}

CSS_NAMES = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    PAPER: "paper",
    BLUE: "blue",
    VERMILLION: "vermillion",
    GREEN: "green",
    GREY: "grey",
    **{colour: f"blue-{level}" for level, colour in enumerate(BLUES, 1)},
    **{colour: f"red-{level}" for level, colour in enumerate(REDS, 1)},
}

FULL_WIDTH_IN, HALF_WIDTH_IN = 8.6, 4.9
PNG_DPI = 160
FEW_DECADES = 1.7

RC: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.titlecolor": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "text.color": INK,
    "text.parse_math": False,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "xtick.minor.size": 1.8,
    "ytick.minor.size": 1.8,
    "lines.linewidth": 1.8,
    "lines.solid_capstyle": "round",
    "axes.facecolor": "none",
    "legend.frameon": False,
    "svg.fonttype": "none",
}


@dataclass(frozen=True)
class Plot:
    """A drawn plot with what a reader needs beside it."""

    name: str
    """File name without suffix; also seeds the ids inside the SVG."""
    figure: Figure
    alt: str
    """What the plot shows, in words, for those who cannot see it."""
    caption: str
    """What to read from it."""


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that is not registered anywhere, so that none can leak."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def only_horizontal_grid(axes: Axes) -> None:
    """For bars and lines over a categorical or wide axis: vertical lines would add nothing."""
    axes.grid(visible=False, axis="x")


def decades(axis: Axis, low: float, high: float) -> None:
    """Label a logarithmic axis from ``low`` to ``high`` by powers of ten; also by 2 and 5 where it spans few."""
    few = math.log10(high / low) < FEW_DECADES
    axis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=9))
    axis.set_minor_locator(LogLocator(base=10.0, subs=tuple(range(2, 10)), numticks=99 if few else 9))
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(FuncFormatter(lambda value, _: tick_label(value)))


def tick_label(value: float) -> str:
    """Plain digits from 0.01 to 9999, else ``10⁻⁷`` or ``2·10⁻⁷``."""
    if value <= 0.0:
        return ""
    if 0.0099 < value < 9_999.5:
        return f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"
    # log10 of a tick such as 1e-7 may come out just below -7.
    exponent = math.floor(math.log10(value) + 1e-9)
    mantissa = f"{value / 10.0**exponent:.3g}"
    return power_of_ten(exponent) if mantissa == "1" else f"{mantissa}·{power_of_ten(exponent)}"


def scaled(axis: Axis, largest: float) -> str:
    """Label a linear axis in units of a power of ten; returns the text to append to the axis label."""
    exponent = exponent_of(largest)
    factor = 10.0**exponent
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain(float(f"{value / factor:.6g}"))))
    return f", × {power_of_ten(exponent)}" if exponent else ""


def note(axes: Axes, text: str, at: tuple[float, float], offset: tuple[float, float], **options: Any) -> None:
    """Write a text at an offset, in points, from a place."""
    axes.annotate(text, at, xytext=offset, textcoords="offset points", **options)


def png(plot: Plot) -> bytes:
    """Return the plot as PNG, in the layout of the SVG if that was made before."""
    return _saved(plot, format="png", dpi=PNG_DPI, metadata={"Software": None})


def svg(plot: Plot) -> bytes:
    """Return the plot as an SVG file that stands alone."""
    with mpl.rc_context({"svg.hashsalt": plot.name}):
        drawing = _saved(plot, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    # Laying out takes as long as drawing, and both forms should look alike anyway. None, since "none" leaves a
    # placeholder, for which everything is drawn twice.
    plot.figure.set_layout_engine(None)
    return drawing


def inline_svg(svg_file: bytes) -> str:
    """Turn an SVG file into markup for the page: themed, unnamed, sized by its container."""
    markup = svg_file.decode("utf-8")
    markup = markup[markup.index("<svg") :]
    markup = re.sub(r"<metadata>.*?</metadata>|<style[^>]*>.*?</style>|<!--.*?-->", "", markup, flags=re.DOTALL)
    opening, _, rest = markup.partition(">")
    view_box = re.search(r'viewBox="[^"]*"', opening)
    rest = re.sub(r'<g id="[^"]*"', "<g", rest)
    # matplotlib writes the typeface as `font` or as `font-family`, depending on its version.
    rest = re.sub(r"(font-family:|font: (?:[a-z0-9]+ )*[\d.]+px) [^;\"]*", r"\1 var(--sans)", rest)
    rest = re.sub(r"#[0-9a-f]{6}\b", lambda match: _themed(match.group()), rest)
    return f'<svg {view_box.group() if view_box else ""} aria-hidden="true">{rest.strip()}'


def _themed(colour: str) -> str:
    return f"var(--{CSS_NAMES[colour]})" if colour in CSS_NAMES else colour


def _saved(plot: Plot, **options: Any) -> bytes:
    buffer = io.BytesIO()
    plot.figure.savefig(buffer, **options)
    return buffer.getvalue()
