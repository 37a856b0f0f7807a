"""The answer drawn: every estimator's crash rate with its interval, the headline first."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from harness.report.number_format import exponent_of, interval, number, plain, with_interval
from harness.report.plot_style import BLUE, FULL_WIDTH_IN, GREY, INK, MUTED, Plot, new_figure
from harness.report.rate_axis import decades, scaled
from harness.report.shells_result import shells_result

LOG_AXIS_RATIO = 30.0


@dataclass(frozen=True)
class Interval:
    """One estimator's rate and interval, per test."""

    name: str
    rate: float
    low: float
    high: float
    is_headline: bool


def answer_plot(estimates: dict[str, Any]) -> Plot | None:
    """Draw the intervals of all estimators that have one; None when there is none."""
    shown = _intervals(estimates)
    if not shown:
        return None
    figure = new_figure(FULL_WIDTH_IN, 1.15 + 0.34 * len(shown))
    axes = figure.subplots()
    on_log = _set_scale(axes, shown)
    left = axes.get_xlim()[0]
    for row, one in enumerate(shown):
        _draw(axes, row, one, left if on_log else 0.0)
    _label(axes, shown, estimates, on_log)
    _add_distance_axis(axes, estimates, on_log)
    headline = shown[0]
    alt = (
        f"Crash rate per test by estimator. {headline.name}: {number(headline.rate)}, interval "
        f"{interval(headline.low, headline.high)}."
    )
    return Plot("answer", figure, alt, _caption(estimates, shown, on_log))


def _intervals(estimates: dict[str, Any]) -> list[Interval]:
    headline = estimates["headline"]
    rows = [
        Interval(name, float(e["crash_rate"]), float(e["ci_low"]), float(e["ci_high"]), name == headline)
        for name, e in estimates["estimates"].items()
        if all(
            isinstance(e.get(key), int | float) and math.isfinite(e[key]) for key in ("crash_rate", "ci_low", "ci_high")
        )
    ]
    return [*sorted(rows, key=lambda row: not row.is_headline), *_conditional(estimates)]


def _conditional(estimates: dict[str, Any]) -> list[Interval]:
    """Return the interval of the conditional statement of a shells run, unless its tests have refuted it."""
    found = shells_result(estimates)
    if found is None or found.conditional.refuted:
        return []
    inside = found.conditional
    return [Interval("if none outside", inside.rate, inside.low, inside.high, is_headline=False)]


def _set_scale(axes: Axes, shown: list[Interval]) -> bool:
    """Logarithmic when estimators differ by orders of magnitude, else linear; returns whether logarithmic.

    Lower ends do not decide: one that touches zero would stretch a logarithmic axis without end.
    """
    high = max(one.high for one in shown)
    rates = [one.rate for one in shown if one.rate > 0.0]
    if rates and high / min(rates) > LOG_AXIS_RATIO:
        axes.set_xscale("log")
        axes.set_xlim(min(rates) / 5.0, high * 2.0)
        return True
    low = min(one.low for one in shown)
    margin = 0.12 * max(high - low, 1e-300)
    axes.set_xlim(max(low - margin, 0.0) if low > 0.0 else 0.0, high + margin)
    return False


def _draw(axes: Axes, row: int, one: Interval, left: float) -> None:
    colour = BLUE if one.is_headline else GREY
    width = 3.2 if one.is_headline else 1.8
    low = max(one.low, left)
    axes.plot([low, one.high], [row, row], color=colour, linewidth=width, solid_capstyle="butt")
    # An end beyond a logarithmic axis gets no cap: the line runs out of the plot.
    for end in (low, one.high) if one.low >= left else (one.high,):
        axes.plot([end, end], [row - 0.16, row + 0.16], color=colour, linewidth=1.4, solid_capstyle="butt")
    if one.rate >= left and (one.rate > 0.0 or left == 0.0):
        axes.plot([one.rate], [row], "o", color=colour, markersize=8 if one.is_headline else 6, clip_on=False, zorder=3)
    text = with_interval(one.rate, one.low, one.high) if one.rate > 0.0 else f"0 (to {number(one.high)})"
    axes.annotate(
        text,
        xy=(1.0, row),
        xycoords=("axes fraction", "data"),
        xytext=(10, 0),
        textcoords="offset points",
        va="center",
        color=INK if one.is_headline else MUTED,
        fontweight="bold" if one.is_headline else "normal",
        annotation_clip=False,
    )


def _label(axes: Axes, shown: list[Interval], estimates: dict[str, Any], on_log: bool) -> None:
    axes.set_yticks(range(len(shown)), [one.name for one in shown])
    axes.tick_params(axis="y", length=0, pad=8, labelcolor=INK)
    axes.spines["left"].set_visible(False)
    axes.grid(visible=False, axis="y")
    axes.set_ylim(len(shown) - 0.4, -0.6)
    unit = ""
    if on_log:
        decades(axes.xaxis, *axes.get_xlim())
    else:
        unit = scaled(axes.xaxis, max(one.high for one in shown))
    axes.set_xlabel(f"crash rate per test{unit} (lane-change level {plain(estimates['lane_change_level'])})")


def _add_distance_axis(axes: Axes, estimates: dict[str, Any], on_log: bool) -> None:
    """Second scale on top, per 1e6 km: the same interval in the unit that safety cases use."""
    distance_km = estimates.get("distance_per_test_km")
    if not isinstance(distance_km, int | float) or not distance_km > 0.0:
        return
    factor = 1e6 / distance_km
    top = axes.secondary_xaxis("top", functions=(lambda x: np.multiply(x, factor), lambda x: np.divide(x, factor)))
    unit = ""
    if on_log:
        decades(top.xaxis, *(factor * end for end in axes.get_xlim()))
    else:
        unit = scaled(top.xaxis, axes.get_xlim()[1] * factor)
    top.set_xlabel(f"crashes per 10⁶ km of such overtaking driving{unit}")
    top.spines["top"].set_visible(True)


def _caption(estimates: dict[str, Any], shown: list[Interval], on_log: bool) -> str:
    level = f"{100.0 * float(estimates['confidence']):g} %"
    text = f"Point and {level} interval of each estimator, from the same tests; the headline ({shown[0].name}) in blue."
    if on_log:
        text += " The axis is logarithmic because they differ by orders of magnitude."
    if shown[0].rate == 0.0:
        text += " No crash was sampled: the interval reaches from zero to the upper bound."
    elif shells_result(estimates) is not None:
        if len(shown) > 1:
            text += " The other one holds if there are no crashes outside the boundary."
    elif len(shown) > 1:
        text += (
            " Estimators that use the same tests are not independent: agreement among them is expected, not evidence."
        )
    return text


def rate_exponent(estimates: dict[str, Any]) -> int:
    """Power of ten in which the rates of this run are best written."""
    shown = _intervals(estimates)
    return exponent_of(shown[0].rate or shown[0].high) if shown else 0
