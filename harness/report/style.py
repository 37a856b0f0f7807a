"""One look for all plots, axes that show small rates, and its forms: an SVG file, SVG inside the page, PNG for studies.

Inside the page the palette's colours become CSS variables, so that plots follow the page's light or dark scheme, and
text stays text in the page's own typeface. Everything that would make two runs differ (dates, random ids) is fixed.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis, YAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from harness.numbers import exponent_of, plain, power_of_ten

INK, MUTED, GRID, PAPER = "#1c2126", "#5d6873", "#dde2e7", "#ffffff"
BLUE, VERMILLION, GREEN, GREY = "#0067a8", "#c94f0a", "#00795a", "#8b95a0"
BLUES = ("#dceaf5", "#b3d1e8", "#7fb2d7", "#478fc1", "#166ba3", "#083f68")
REDS = ("#fbe5d8", "#f5c3a5", "#ea9a6c", "#d96f36", "#b34a10", "#6f2a05")

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

FULL_WIDTH_IN = 8.6
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
    """A drawn plot with what a reader needs beside it.

    ``name`` is its file's, without suffix, and seeds the ids inside the SVG; ``alt`` says what it shows to those who
    cannot see it, ``caption`` what to read from it.
    """

    name: str
    figure: Figure
    alt: str
    caption: str


class Row(NamedTuple):
    """A row of `interval_bars`; without ``low`` and ``high`` it has no interval."""

    name: str
    value: float
    colour: str
    low: float | None = None
    high: float | None = None
    text: str = ""


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that is not registered anywhere, so that none can leak."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def two_panels(height_in: float, xlabels: Sequence[str], **options: Any) -> tuple[Figure, Axes, Axes]:
    """Two panels side by side; ``options`` are those of `Figure.subplots`."""
    figure = new_figure(FULL_WIDTH_IN, height_in)
    left, right = figure.subplots(1, 2, **options)
    for axes, xlabel in zip((left, right), xlabels, strict=True):
        axes.set_xlabel(xlabel)
    return figure, left, right


def interval_bars(axes: Axes, rows: Sequence[Row], *, filled: bool = False) -> None:
    """Draw a row for each, from the top down, within the axis limits as they are.

    A row is a point, or ``filled`` a bar from zero, with its interval, and its text right of the panel. What lies
    beyond the limits is cut off: an interval then ends without a cap.
    """
    for place, row in enumerate(rows):
        strong = row.colour == BLUE and not filled
        if filled:
            axes.barh(place, row.value, height=0.62, color=row.colour, alpha=0.85)
        if row.low is not None and row.high is not None:
            colour, width = (INK, 1.3) if filled else (row.colour, 3.2 if strong else 1.8)
            ends = [[max(row.value - row.low, 0.0)], [max(row.high - row.value, 0.0)]]
            axes.errorbar(
                row.value, place, xerr=ends, color=colour, elinewidth=width, capsize=4.0, capthick=1.4,
                fmt="none" if filled else "o", markersize=8 if strong else 6,
            )  # fmt: skip
        style = {"color": INK, "fontweight": "bold"} if strong else {"color": MUTED}
        beside = {"xycoords": ("axes fraction", "data"), "annotation_clip": False}
        note(axes, row.text, (1.0, place), (8, 0), va="center", **beside, **style)
    axes.set_yticks(range(len(rows)), [row.name for row in rows])
    axes.tick_params(axis="y", length=0, pad=8, labelcolor=INK)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.spines["left"].set_visible(filled)
    axes.grid(visible=False, axis="y")


def head(axes: Axes, title: str) -> None:
    """Title, and below it the legend in one line: within the panel there is no place where no curve can be."""
    handles, _ = axes.get_legend_handles_labels()
    axes.set_title(title, pad=24.0 if handles else 8.0)
    if handles:
        axes.legend(
            loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, borderpad=0.3, ncols=len(handles),
            fontsize=8, labelcolor=MUTED, columnspacing=1.1, handlelength=1.5,
        )  # fmt: skip


def log_axis(axis: XAxis | YAxis, low: float, high: float) -> None:
    """Make an axis logarithmic from ``low`` to ``high``, with the labels of `decades`."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log", f"{axis.axis_name}lim": (low, high)})
    decades(axis, low, high)


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
    rest = re.sub(r"#[0-9a-f]{6}\b", lambda of: f"var(--{CSS_NAMES[of[0]]})" if of[0] in CSS_NAMES else of[0], rest)
    return f'<svg {view_box.group() if view_box else ""} aria-hidden="true">{rest.strip()}'


def _saved(plot: Plot, **options: Any) -> bytes:
    buffer = io.BytesIO()
    plot.figure.savefig(buffer, **options)
    return buffer.getvalue()
