"""One look for all plots of a study, axes that show small rates, and the files."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from harness.numbers import exponent_of, plain, power_of_ten
from harness.report.drawing import tick_label

INK, MUTED, GRID = "#1c2126", "#5d6873", "#dde2e7"
BLUE, VERMILLION, GREEN, GREY = "#0067a8", "#c94f0a", "#00795a", "#8b95a0"

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
}


@dataclass(frozen=True)
class Plot:
    """A drawn plot with what a reader needs beside it.

    ``name`` is its file's, without suffix; ``alt`` says what it shows to those who cannot see it, ``caption`` what to
    read from it.
    """

    name: str
    figure: Figure
    alt: str
    caption: str


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


def head(axes: Axes, title: str) -> None:
    """Title, and below it the legend in one line: within the panel there is no place where no curve can be."""
    handles, _ = axes.get_legend_handles_labels()
    axes.set_title(title, pad=24.0 if handles else 8.0)
    if handles:
        axes.legend(
            loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, borderpad=0.3, ncols=len(handles),
            fontsize=8, labelcolor=MUTED, columnspacing=1.1, handlelength=1.5,
        )  # fmt: skip


def decades(axis: Axis, low: float, high: float) -> None:
    """Label a logarithmic axis from ``low`` to ``high`` by powers of ten; also by 2 and 5 where it spans few."""
    few = math.log10(high / low) < FEW_DECADES
    axis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=9))
    axis.set_minor_locator(LogLocator(base=10.0, subs=tuple(range(2, 10)), numticks=99 if few else 9))
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(FuncFormatter(lambda value, _: tick_label(value)))


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
    """Return the plot as PNG."""
    buffer = io.BytesIO()
    plot.figure.savefig(buffer, format="png", dpi=PNG_DPI, metadata={"Software": None})
    return buffer.getvalue()
