"""One look for all plots, and their three forms: PNG, SVG file, and SVG inside the page.

Inside the page the palette's colours become CSS variables, so that plots follow the page's light or dark scheme, and
text stays text in the page's own typeface. Everything that would make two runs differ (dates, random ids) is fixed.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

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
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.unicode_minus": True,
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
    "figure.facecolor": PAPER,
    "axes.facecolor": "none",
    "savefig.facecolor": PAPER,
    "legend.frameon": False,
    "svg.fonttype": "none",
}


@dataclass(frozen=True)
class Plot:
    """A drawn plot with what a reader needs beside it.

    Attributes
    ----------
    name : str
        File name without suffix; also seeds the ids inside the SVG.
    alt : str
        What the plot shows, in words, for those who cannot see it.
    caption : str
        What to read from it.
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


def only_horizontal_grid(axes: Axes) -> None:
    """For bars and lines over a categorical or wide axis: vertical lines would add nothing."""
    axes.grid(visible=False, axis="x")


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
