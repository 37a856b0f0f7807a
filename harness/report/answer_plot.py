"""The answer drawn: every estimator's crash rate with its interval, the headline first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis

from harness.report.number_format import exponent_of, interval, number, plain, with_interval
from harness.report.plot_style import BLUE, FULL_WIDTH_IN, GREY, INK, MUTED, Plot, decades, new_figure, note, scaled
from harness.report.run_folder import ShownShells, StoredEstimates

LOG_AXIS_RATIO = 30.0


class Interval(NamedTuple):
    """One estimator's rate and interval, per test."""

    name: str
    rate: float
    low: float
    high: float
    is_headline: bool


def answer_plot(estimates: StoredEstimates, shells: ShownShells | None) -> Plot | None:
    """Draw the intervals of all estimators that have one, the headline first; None when there is none.

    Of a shells run also those of the statements about a boundary, unless its tests have refuted them.
    """
    shown = _intervals(estimates)
    for each in () if shells is None else shells.statements:
        if not each.refuted:
            name = f"given {each.name}"
            shown.append(Interval(name, each.crash_rate, each.ci_low, each.ci_high, is_headline=False))
    if not shown:
        return None
    figure = new_figure(FULL_WIDTH_IN, 1.15 + 0.34 * len(shown))
    axes = figure.subplots()
    on_log = _set_scale(axes, shown)
    left = axes.get_xlim()[0] if on_log else 0.0
    for row, one in enumerate(shown):
        _draw(axes, row, one, left)
    _label(axes, shown, estimates, on_log)
    _add_distance_axis(axes, estimates.distance_per_test_km, on_log)
    headline = shown[0]
    alt = (
        f"Crash rate per test by estimator. {headline.name}: {number(headline.rate)}, interval "
        f"{interval(headline.low, headline.high)}."
    )
    return Plot("answer", figure, alt, _caption(estimates, shown, on_log, of_shells=shells is not None))


def _intervals(estimates: StoredEstimates) -> list[Interval]:
    rows = [
        Interval(name, e.crash_rate, e.ci_low, e.ci_high, name == estimates.headline)
        for name, e in estimates.estimates.items()
        if e.crash_rate is not None and e.ci_low is not None and e.ci_high is not None
    ]
    return sorted(rows, key=lambda row: not row.is_headline)


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
    note(
        axes,
        text,
        (1.0, row),
        (10, 0),
        xycoords=("axes fraction", "data"),
        va="center",
        color=INK if one.is_headline else MUTED,
        fontweight="bold" if one.is_headline else "normal",
        annotation_clip=False,
    )


def _label(axes: Axes, shown: list[Interval], estimates: StoredEstimates, on_log: bool) -> None:
    axes.set_yticks(range(len(shown)), [one.name for one in shown])
    axes.tick_params(axis="y", length=0, pad=8, labelcolor=INK)
    axes.spines["left"].set_visible(False)
    axes.grid(visible=False, axis="y")
    axes.set_ylim(len(shown) - 0.4, -0.6)
    unit = _scaled(axes.xaxis, axes.get_xlim(), max(one.high for one in shown), on_log)
    axes.set_xlabel(f"crash rate per test{unit} (lane-change level {plain(estimates.lane_change_level)})")


def _add_distance_axis(axes: Axes, distance_per_test_km: float | None, on_log: bool) -> None:
    """Second scale on top, per 1e6 km: the same interval in the unit that safety cases use."""
    if distance_per_test_km is None or distance_per_test_km <= 0.0:
        return
    factor = 1e6 / distance_per_test_km
    top = axes.secondary_xaxis("top", functions=(lambda x: np.multiply(x, factor), lambda x: np.divide(x, factor)))
    low, high = (factor * end for end in axes.get_xlim())
    unit = _scaled(top.xaxis, (low, high), high, on_log)
    top.set_xlabel(f"crashes per 10⁶ km of such overtaking driving{unit}")
    top.spines["top"].set_visible(True)


def _scaled(axis: Axis, ends: tuple[float, float], largest: float, on_log: bool) -> str:
    if on_log:
        decades(axis, *ends)
        return ""
    return scaled(axis, largest)


def _caption(estimates: StoredEstimates, shown: list[Interval], on_log: bool, *, of_shells: bool) -> str:
    level = f"{100.0 * estimates.confidence:g} %"
    text = f"Point and {level} interval of each estimator, from the same tests; the headline ({shown[0].name}) in blue."
    if on_log:
        text += " The axis is logarithmic because they differ by orders of magnitude."
    if shown[0].rate == 0.0:
        return text + " No crash was sampled: the interval reaches from zero to the upper bound."
    if len(shown) == 1:
        return text
    if of_shells:
        return text + " The others hold for vehicles that keep to what the statement assumes."
    return text + (
        " Estimators that use the same tests are not independent: agreement among them is expected, not evidence."
    )


def rate_exponent(estimates: StoredEstimates) -> int:
    """Power of ten in which the rates of this run are best written."""
    shown = _intervals(estimates)
    return exponent_of(shown[0].rate or shown[0].high) if shown else 0
