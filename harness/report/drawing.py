"""Panels drawn as SVG: axes that show small rates, lines, bands, dots and boxes, in the colours of the page.

A panel is as wide as a phone shows, so that its text stays readable there; on wider screens panels stand side by side.
Colours are names of the page's CSS variables, and follow its light or dark scheme. The same data give the same bytes.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import ArrayLike

from harness.numbers import exponent_of, plain, power_of_ten
from harness.vocabulary import FloatArray

WIDTH, CHARACTER, LINE = 420.0, 5.9, 15.0
"""Of a panel, and of its text: mean width and height."""
RIGHT, BOTTOM, AXIS = 12.0, 36.0, 54.0
"""Margins right, below, and left where an axis has numbers."""
FEW_DECADES, MOST_TICKS = 1.7, 6


class PlotAxis(NamedTuple):
    """From ``low`` to ``high``; logarithmic, or of rows with ``names`` at 0, 1 and so on."""

    label: str
    low: float
    high: float
    log: bool = False
    names: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The label, with the power of ten that the numbers at the ticks leave out."""
        exponent = 0 if self.log else exponent_of(self.high)
        return f"{self.label}, × {power_of_ten(exponent)}" if exponent else self.label

    def place(self, values: ArrayLike) -> FloatArray:
        """Where values are between the ends, 0 to 1; what is not finite is not there."""
        low, high, numbers = self.low, self.high, np.asarray(values, np.float64)
        if self.log:
            low, high, numbers = math.log10(low), math.log10(high), np.log10(np.maximum(numbers, 1e-300))
        return np.asarray(np.clip((numbers - low) / (high - low), -99.0, 99.0), np.float64)

    def ticks(self) -> list[tuple[float, str]]:
        """Values and texts: powers of ten, also their multiples by 2 and 5 where there are few; or round numbers."""
        if self.names:
            return list(enumerate(self.names))
        if self.log:
            decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            few = math.log10(self.high / self.low) < FEW_DECADES
            step = 1 if few else math.ceil(len(decades) / MOST_TICKS)
            steps = [m * 10.0**k for k in decades[::step] for m in ((1, 2, 5) if few else (1,))]
            within = (value for value in steps if 0.999 <= value / self.low <= 1.001 * self.high / self.low)
            return [(value, tick_label(value)) for value in within]
        rough = (self.high - self.low) / MOST_TICKS
        unit = 10.0 ** math.floor(math.log10(rough))
        step_size = next(m * unit for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * unit >= rough)
        first, last = math.ceil(self.low / step_size - 1e-9), math.floor(self.high / step_size + 1e-9)
        values = step_size * np.arange(first, last + 1)
        scale = 10.0 ** exponent_of(self.high)
        return [(float(value), plain(float(f"{value / scale:.6g}"))) for value in values]


def tick_label(value: float) -> str:
    """Plain digits from 0.01 to 9999, else ``10⁻⁷`` or ``2·10⁻⁷``."""
    if 0.0099 < value < 9_999.5:
        return f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"
    exponent = math.floor(math.log10(value) + 1e-9)  # of a value such as 1e-7 it may come out just below
    mantissa = f"{value / 10.0**exponent:.3g}"
    return power_of_ten(exponent) if mantissa == "1" else f"{mantissa}·{power_of_ten(exponent)}"


Kind = Literal["line", "band", "dots", "boxes", "text"]


class Mark(NamedTuple):
    """What is drawn, by its columns (n,).

    They are x and y of a line; x, low and high of a band; x, y and radius of dots; left, right, low and high of boxes;
    x and y of a text. ``dash`` is of a line, ``opacity`` of the rest.
    """

    kind: Kind
    colour: str
    columns: tuple[ArrayLike, ...]
    label: str = ""
    dash: str = ""
    opacity: float = 1.0
    width: float = 1.8


@dataclass(frozen=True)
class PlotPanel:
    """Axes with marks in them, in the order in which they are drawn; labels of marks make the legend."""

    title: str
    x: PlotAxis
    y: PlotAxis
    marks: list[Mark] = field(default_factory=list)
    height: float = 250.0

    def add(self, kind: Kind, colour: str, *columns: ArrayLike, **options: Any) -> None:
        """Draw one more `Mark`."""
        self.marks.append(Mark(kind, colour, columns, **options))

    @property
    def svg(self) -> Markup:
        """The panel as an SVG element that is as wide as its place."""
        legend = list(self._legend())
        rows = 1 + max((row for _, row, _ in legend), default=-1)
        top = 20.0 + LINE * rows + (8.0 if rows else 0.0)  # below it the uppermost tick reaches over the axes
        left, width = self._left, WIDTH - self._left - RIGHT
        height = self.height - top - BOTTOM
        bottom, middle = top + height, left + width / 2.0
        parts = [f'<text y="12" style="fill:var(--ink);font-weight:600">{escape(self.title)}</text>']
        for mark, row, x in legend:
            place = f"translate({x:.0f},{28.0 + LINE * row:.0f})"
            label = escape(mark.label)
            parts.append(f'<g transform="{place}">{_swatch(mark)}<text x="20" y="4">{label}</text></g>')
        for value, text in self.x.ticks():
            x = left + width * float(self.x.place(value))
            parts.append(f'<path class="grid" d="M{x:.1f} {top:.0f}V{bottom:.1f}"/>')
            parts.append(f'<text x="{x:.1f}" y="{bottom + 14.0:.1f}" class="mid">{escape(text)}</text>')
        for value, text in self.y.ticks():
            y = bottom - height * float(self.y.place(value))
            if not self.y.names:
                parts.append(f'<path class="grid" d="M{left:.1f} {y:.1f}h{width:.1f}"/>')
            parts.append(f'<text x="{left - 6.0:.1f}" y="{y + 4.0:.1f}" class="end">{escape(text)}</text>')
        inner = "".join(_drawn(mark, self, width, height) for mark in self.marks)
        parts.append(f'<svg x="{left:.1f}" y="{top:.0f}" width="{width:.1f}" height="{height:.1f}">{inner}</svg>')
        parts.append(f'<path class="axis" d="M{left:.1f} {top:.0f}V{bottom:.1f}h{width:.1f}"/>')
        parts.append(f'<text x="{middle:.1f}" y="{self.height - 4.0:.0f}" class="mid">{escape(self.x.title)}</text>')
        turned = f'transform="translate(11,{top + height / 2.0:.0f}) rotate(-90)"'
        parts.append(f'<text {turned} class="mid">{escape(self.y.title)}</text>' if self.y.label else "")
        head = f'<svg viewBox="0 0 {WIDTH:.0f} {self.height:.0f}" aria-hidden="true" class="panel">'
        return Markup(f"{head}{''.join(parts)}</svg>")  # noqa: S704 - every text in it is escaped

    @property
    def _left(self) -> float:
        return AXIS if not self.y.names else 14.0 + 1.05 * CHARACTER * max(map(len, self.y.names))

    def room_before(self, label: str) -> float:
        """Share of the width that a text at the right edge leaves free; below 0 where it is too long."""
        return 1.0 - (CHARACTER * len(label) + 8.0) / (WIDTH - self._left - RIGHT)

    def _legend(self) -> Iterator[tuple[Mark, int, float]]:
        """Marks with a label, in which row and where in it they stand."""
        row, x = 0, 0.0
        for mark in self.marks:
            if mark.label and mark.kind != "text":
                needs = 20.0 + CHARACTER * len(mark.label)
                if x and x + needs > WIDTH:
                    row, x = row + 1, 0.0
                yield mark, row, x
                x += needs + 12.0


@dataclass(frozen=True)
class Plot:
    """Panels with what a reader needs beside them.

    ``name`` is its file's, without suffix; ``alt`` says what it shows, ``caption`` what to read from it.
    """

    name: str
    panels: Sequence[PlotPanel]
    alt: str
    caption: str

    @property
    def markup(self) -> Markup:
        """What stands on the page."""
        return Markup("").join(panel.svg for panel in self.panels)

    def file(self, style: str) -> bytes:
        """An SVG file that stands alone, with the panels below each other in a ``style`` sheet."""
        panels, y = "", 0.0
        for panel in self.panels:
            panels += f'<svg y="{y:.0f}" width="{WIDTH:.0f}" height="{panel.height:.0f}">{panel.svg}</svg>'
            y += panel.height
        head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-8 -8 {WIDTH + 16.0:.0f} {y + 16.0:.0f}">'
        return f"{head}<style>{style}</style>{panels}</svg>\n".encode()


def _drawn(mark: Mark, panel: PlotPanel, width: float, height: float) -> str:
    """A mark in its panel's inner part, which cuts off what is beyond its edges."""
    first, *rest = (np.atleast_1d(np.asarray(column, np.float64)) for column in mark.columns)
    xs = [first, rest[0]] if mark.kind == "boxes" else [first]
    ys = rest[1:] if mark.kind == "boxes" else rest[: 2 if mark.kind == "band" else 1]
    x, y = [width * panel.x.place(each) for each in xs], [height * (1.0 - panel.y.place(each)) for each in ys]
    if mark.kind == "text":
        anchor, dx = ("end", -4.0) if x[0][0] > 0.9 * width else ("start", 5.0)
        style = f"text-anchor:{anchor};fill:var(--{mark.colour})"
        place = f'x="{x[0][0] + dx:.1f}" y="{y[0][0] + 4.0:.1f}"'
        return f'<text {place} class="on" style="{style}">{escape(mark.label)}</text>'
    if mark.kind == "dots":
        discs = zip(x[0], y[0], np.broadcast_to(rest[1], x[0].shape), strict=True)
        arc = "a{0:.1f} {0:.1f} 0 1 0 {1:.1f} 0"
        path = "".join(f"M{a - r:.1f} {b:.1f}{arc.format(r, 2 * r)}{arc.format(r, -2 * r)}" for a, b, r in discs)
    elif mark.kind == "boxes":
        path = "".join(f"M{a:.1f} {c:.1f}H{b:.1f}V{d:.1f}H{a:.1f}z" for a, b, c, d in zip(*x, *y, strict=True))
    elif mark.kind == "band":
        path = _joined(np.append(x[0], x[0][::-1]), np.append(y[0], y[1][::-1])) + "z"
    else:
        path = _joined(x[0], y[0])
    return f'<path style="{_style(mark)}" d="{path}"/>'


def _joined(x: FloatArray, y: FloatArray) -> str:
    finite = np.isfinite(x) & np.isfinite(y)
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x[finite], y[finite], strict=True))


def _style(mark: Mark) -> str:
    if mark.kind == "line":
        dash = f";stroke-dasharray:{mark.dash}" if mark.dash else ""
        return f"fill:none;stroke:var(--{mark.colour});stroke-width:{mark.width:g}{dash}"
    return f"fill:var(--{mark.colour})" + (f";fill-opacity:{mark.opacity:g}" if mark.opacity < 1.0 else "")


def _swatch(mark: Mark) -> str:
    form = {"line": "M0 0h15", "dots": "M4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0"}.get(mark.kind, "M1 -5h14v10h-14z")
    return f'<path style="{_style(mark)}" d="{form}"/>'


def style_of_plots() -> str:
    """What the page's style sheet says of plots."""
    css = (Path(__file__).parent / "report.css").read_text(encoding="utf-8")
    return "".join(re.findall(r"^:root \{.*?^\}$|^\.panel.*?$", css, flags=re.DOTALL | re.MULTILINE))


def shown_with(text: str, plot: Plot | None) -> str:
    """HTML of a text with a plot below it, as a notebook shows results: the plot keeps its style to itself."""
    image = "" if plot is None else base64.b64encode(plot.file(style_of_plots())).decode()
    shown = f'<img width="440" alt="{plot.alt}" src="data:image/svg+xml;base64,{image}">' if plot else ""
    return f"<pre>{escape(text)}</pre>{shown}"
