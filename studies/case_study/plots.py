"""Plots of a study: convergence on the paper's two axes, strata, and tests by method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow.compute as pc
from matplotlib.axis import XAxis, YAxis
from matplotlib.ticker import MaxNLocator

from harness.estimators.block import MAX_CONTROL_STEPS
from harness.records.folder import read_table
from harness.report.drawing import tick_label
from studies.case_study.counted import CURVES
from studies.case_study.figures import is_settled
from studies.case_study.study import Convergence, Line, Made, Study
from studies.case_study.style import (
    BLUE,
    FULL_WIDTH_IN,
    GREEN,
    GREY,
    INK,
    MUTED,
    VERMILLION,
    Plot,
    decades,
    head,
    new_figure,
    note,
    scaled,
    two_panels,
)

_COLOURS = {"low": GREY, "nade": BLUE, "scv": VERMILLION, "nde": INK, "": GREEN}
"""Of a method in all plots, by what its step or label contains."""
_HOLLOW: dict[str, Any] = {"markerfacecolor": "none", "markersize": 7, "linewidth": 0.9}
MOST_RATE, LEAST_GAIN = 3.0, 0.1
"""Times the known rate up to which rates are drawn; the least gain: worse ones are on the axis."""
_DASHED: dict[str, Any] = {"color": MUTED, "linewidth": 0.9, "linestyle": (0, (4, 3))}


def plots_of(study: Study, made: Mapping[str, Made], ours: Mapping[str, dict[str, Any]]) -> dict[str, Plot]:
    """All plots that the study's steps give, by name."""
    plots: list[Plot | None] = [tests_plot(study.picture, ours, study.rhw)] if ours else []
    for name, step in study.steps.items():
        if isinstance(step, Convergence):
            plots.append(convergence_plot(name, step, made, study.rhw, study.confidence))
        elif step.kind == "control_variates":
            plots.append(growth_plot(f"{name}_growth", made[name].result["looks"], study.rhw))
            if made[name].result["strata"]:
                plots.append(strata_plot(name, made[name].result["strata"]))
    return {plot.name: plot for plot in plots if plot is not None}


def tests_plot(picture: Mapping[str, Line], ours: Mapping[str, dict[str, Any]], rhw: float) -> Plot | None:
    """Tests that each method asks for, on a logarithmic axis, and what the paper reports."""
    if not any(found["value"] or found["low"] for found in ours.values()):
        return None
    figure = new_figure(FULL_WIDTH_IN, 3.6)
    axes = figure.subplots()
    axes.set_yscale("log")
    for line in ("NDE", "NADE", "SCV claims"):
        at = [place for place, label in enumerate(ours) if label.partition("\n")[0] == line]
        axes.plot(at, [picture[list(ours)[place]].paper or np.nan for place in at], ":D", color=INK, **_HOLLOW)
        axes.plot(at, [found["value"] or np.nan for found in (list(ours.values())[place] for place in at)], color=BLUE)
    for place, (label, found) in enumerate(ours.items()):
        if (value := found["value"] or found["low"]) is None:
            continue
        colour = GREY if not is_settled(found) else next(c for name, c in _COLOURS.items() if name in label.lower())
        ends = [[value - (found["low"] or value)], [(found["high"] or value) - value]]
        is_limit = found["high"] is None and found["low"] is not None
        axes.errorbar(place, value, yerr=ends, fmt="^" if is_limit else "o", color=colour, capsize=4.0, markersize=7)
        words = ("> " if is_limit else "") + tick_label(float(f"{value:.2g}")) + (" †" if colour == GREY else "")
        beneath: dict[str, Any] = {"ha": "center", "color": INK, "fontsize": 8}
        note(axes, words, (place, found["high"] or value), (0, -18 if is_limit else 7), **beneath)
    low, high = axes.get_ylim()
    axes.set_ylim(low / 2.0, high * 4.0)
    decades(axes.yaxis, *axes.get_ylim())
    axes.set_xticks(range(len(ours)), list(ours), fontsize=8)
    axes.grid(visible=False, axis="x")
    axes.set_ylabel(f"tests for a relative half-width of {rhw:g}")
    caption = "Tests by method. Filled: here (triangles: lower limits; grey, †: not converged). Hollow: the paper's."
    return Plot("tests", figure, caption, caption)


def _by_decades(*of: XAxis | YAxis) -> None:
    """Make axes logarithmic, from end to end of what is drawn."""
    for axis in of:
        axis.axes.set(**{f"{axis.axis_name}scale": "log"})
        decades(axis, *axis.get_view_interval())


def convergence_plot(name: str, step: Convergence, made: Mapping[str, Made], rhw: float, confidence: float) -> Plot:
    """Crash rate with its band, and RHW, against tests."""
    table = read_table(made[name].folder / CURVES)
    reference = made[step.reference].result["figures"]["crash_rate"]["value"] or 0.0
    figure, left, right = two_panels(3.4, ("tests", "tests"))
    for label in step.of:
        colour = next(colour for name, colour in _COLOURS.items() if name in label)
        rows = table.filter(pc.equal(table.column("step"), label))
        n, rate, half = (rows.column(column).to_numpy() for column in ("n", "crash_rate", "half_width"))
        known = (rate > 0.0) & np.isfinite(half)
        left.fill_between(n, np.maximum(rate - half, 0.0), rate + half, color=colour, alpha=0.16, linewidth=0)
        left.plot(n, rate, color=colour, label=label)
        right.plot(n[known], half[known] / rate[known], color=colour, label=label)
    left.axhline(reference, **_DASHED)
    left.set_ylim(0.0, MOST_RATE * reference or 1.0)
    right.axhline(rhw, **_DASHED)
    _by_decades(left.xaxis, right.xaxis, right.yaxis)
    head(left, f"crash rate per test{scaled(left.yaxis, MOST_RATE * reference or 1.0)}")
    head(right, "RHW")
    caption = f"Crash rates with {confidence:.0%} bands (dashed: {step.reference}), and relative half-widths, by tests."
    return Plot(name, figure, caption, caption)


def strata_plot(name: str, strata: list[dict[str, Any]]) -> Plot | None:
    """Tests, columns and rank by number of control steps, and the spread of results before and after adjustment."""
    last = max((row["control_steps"] for row in strata if row["sd_before"]), default=MAX_CONTROL_STEPS)
    if not (shown := [row for row in strata if 1 <= row["control_steps"] <= last]):
        return None
    steps = [row["control_steps"] for row in shown]
    beneath = "control steps l; from 10 on columns are of the first 9"
    figure, left, right = two_panels(3.2, (beneath, beneath), sharex=True)
    counts = (("n", "tests", INK), ("columns", "control variates", GREY), ("rank", "rank", GREEN))
    for key, label, colour in counts:
        left.plot(steps, [max(row[key], 0.8) for row in shown], "o-", color=colour, label=label, markersize=3)
    least = max(row["sd_before"] for row in shown) / 1e4  # beneath it is what rounding has left
    for key, label, colour, width in (("sd_before", "Y, NADE", BLUE, 4.0), ("sd_after", "Z, SCV", VERMILLION, 1.4)):
        spread = [row[key] if row[key] > least else np.nan for row in shown]
        right.plot(steps, spread, "o-", color=colour, label=label, markersize=3, linewidth=width)
    for axes, title in ((left, "number in a stratum"), (right, "standard deviation of results")):
        if any(row["sd_before"] for row in shown) or axes is left:
            _by_decades(axes.yaxis)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        head(axes, title)
        axes.grid(visible=False, axis="x")
    caption = "By control steps: tests, columns and their rank; spread of results of NADE (Y) and SCV (Z)."
    return Plot(name, figure, caption, caption)


def growth_plot(name: str, looks: list[dict[str, Any]], rhw: float) -> Plot | None:
    """RHW of NADE and of SCV against tests, and the gain that SCV claims, corrected, and between parts of the run."""
    known = [row for row in looks if row["nade_rhw"] and row["scv_rhw"] and row["gain_claimed"]]
    if not known:
        return None
    n = [row["n"] for row in known]
    figure, left, right = two_panels(3.4, ("tests", "tests"))
    for key, label in (("nade", "NADE"), ("scv", "SCV, as it claims")):
        style: dict[str, Any] = {"color": _COLOURS[key], "linewidth": 4.0 if key == "nade" else 1.4, "markersize": 3}
        left.plot(n, [row[f"{key}_rhw"] for row in known], "o-", label=label, **style)
    for key, colour in (("claimed", _COLOURS["scv"]), ("degrees_of_freedom", INK), ("leave_one_out", GREEN)):
        gains = [max(row[f"gain_{key}"] or np.nan, LEAST_GAIN) for row in known]
        right.plot(n, gains, "o-", color=colour, markersize=3, label=key.replace("_", " "))
    again = [row["gain_replicated"]["value"] or np.nan for row in known]
    right.plot(n, again, "D", color=BLUE, markersize=5, markerfacecolor="none", label="replication")
    right.set_ylim(bottom=max(right.get_ylim()[0], LEAST_GAIN))
    left.axhline(rhw, **_DASHED)
    right.axhline(1.0, **_DASHED)
    _by_decades(left.xaxis, left.yaxis, right.xaxis, right.yaxis)
    head(left, "relative half-width")
    head(right, "NADE's variance over SCV's")
    caption = "By tests: relative half-widths; and SCV's gain as claimed, corrected in two ways, and replicated."
    return Plot(name, figure, caption, caption)
