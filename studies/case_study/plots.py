"""Plots of a study: convergence on the paper's two axes, strata, and tests by method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow.compute as pc
from matplotlib.ticker import MaxNLocator

from harness.estimators.block import MAX_CONTROL_STEPS
from harness.records.folder import read_table
from harness.report.style import (
    BLUE,
    FULL_WIDTH_IN,
    GREEN,
    GREY,
    INK,
    MUTED,
    VERMILLION,
    Plot,
    Row,
    decades,
    head,
    interval_bars,
    new_figure,
    only_horizontal_grid,
    scaled,
    tick_label,
    two_panels,
)
from studies.case_study.counted import CURVES
from studies.case_study.figures import is_settled
from studies.case_study.study import Convergence, Line, Made, Study

_COLOURS = (INK, BLUE, VERMILLION, GREEN)
_DASHED: dict[str, Any] = {"color": MUTED, "linewidth": 0.9, "linestyle": (0, (4, 3))}


def plots_of(study: Study, made: Mapping[str, Made], ours: Mapping[str, dict[str, Any]]) -> dict[str, Plot]:
    """All plots that the study's steps give, by name."""
    plots: list[Plot | None] = [tests_plot(study.picture, ours, study.rhw)] if ours else []
    for name, step in study.steps.items():
        if isinstance(step, Convergence):
            plots.append(convergence_plot(name, step, made, study.rhw, study.confidence))
        elif step.kind == "control_variates":
            plots.append(strata_plot(name, made[name].result["strata"]))
    return {plot.name: plot for plot in plots if plot is not None}


def tests_plot(picture: Mapping[str, Line], ours: Mapping[str, dict[str, Any]], rhw: float) -> Plot | None:
    """Tests that each method asks for, on a logarithmic axis, and what the paper reports."""
    ends = [end for found in ours.values() for end in (found["value"], found["low"], found["high"]) if end]
    if not ends:
        return None
    ends += [line.paper for line in picture.values() if line.paper is not None]
    figure = new_figure(FULL_WIDTH_IN, 1.1 + 0.36 * len(picture))
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_xlim(min(ends) / 3.0, max(ends) * 3.0)
    decades(axes.xaxis, *axes.get_xlim())
    rows = []
    for place, (label, found) in enumerate(ours.items()):
        if (paper := picture[label].paper) is not None:
            axes.plot(paper, place, "D", markerfacecolor="none", color=VERMILLION, markersize=8)
        if not (value := found["value"] or found["low"]):
            rows.append(Row(label, np.nan, GREY, text="not reached"))
            continue
        is_limit = found["high"] is None and found["low"] is not None
        words = ("> " if is_limit else "") + tick_label(float(f"{value:.2g}"))
        colour, mark = (BLUE, "") if is_settled(found) else (GREY, " †")
        rows.append(Row(label, value, colour, found["low"] or value, found["high"] or value, words + mark))
    interval_bars(axes, rows)
    axes.set_xlabel(f"tests until the relative half-width is {rhw:g}")
    caption = (
        "Filled: here, with intervals (grey, †: not converged), > for lower limits; all by one definition, tests made "
        f"times the square of their relative half-width over {rhw:g}. Hollow: reported in the paper."
    )
    return Plot("tests", figure, "Number of tests by method, on a logarithmic axis. " + caption, caption)


def convergence_plot(name: str, step: Convergence, made: Mapping[str, Made], rhw: float, confidence: float) -> Plot:
    """Crash rate with its band, the first curve on the lower axis and the second on the upper; RHW of all."""
    table = read_table(made[name].folder / CURVES)
    top = reference = made[step.reference].result["figures"]["crash_rate"]["value"] or 0.0
    figure, left, right = two_panels(3.6, ("", "tests"))
    left.axhline(reference, **_DASHED)
    for place, (label, colour) in enumerate(zip(step.of, _COLOURS, strict=False)):
        rows = table.filter(pc.equal(table.column("step"), label))
        n, rate, half = (rows.column(column).to_numpy() for column in ("n", "crash_rate", "half_width"))
        axes = left if place == 0 else left.twiny()
        axes.fill_between(n, np.maximum(rate - half, 0.0), rate + half, color=colour, alpha=0.16, linewidth=0)
        axes.plot(n, rate, color=colour, label=label)
        axes.set_xlim(0.0, n[-1])
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.set_xlabel(f"tests, {label}{scaled(axes.xaxis, n[-1])}", color=colour)
        if place:
            axes.grid(visible=False)
            axes.spines["top"].set(visible=True, position=("outward", 34.0 * (place - 1)))
        late = np.isfinite(half) & (n > n[-1] / 10)
        top = max(top, float(np.max((rate + half)[late], initial=0.0)))
        known = (rate > 0.0) & np.isfinite(half)
        if known.any():
            right.plot(n[known], half[known] / rate[known], color=colour, label=label)
    left.set_ylim(0.0, 1.1 * top or 1.0)
    left.set_ylabel(f"crash rate per test{scaled(left.yaxis, 1.1 * top or 1.0)}")
    right.set_xscale("log")
    right.set_yscale("log")
    right.axhline(rhw, **_DASHED)
    decades(right.xaxis, max(right.get_xlim()[0], 1.0), right.get_xlim()[1])
    decades(right.yaxis, *right.get_ylim())
    head(right, "relative half-width")
    caption = (
        f"Left: crash rates with their {confidence:.0%} bands; dashed: that of {step.reference}. Right: relative "
        f"half-widths; dashed: {rhw:g}."
    )
    return Plot(name, figure, f"Convergence of {', '.join(step.of)}. {caption}", caption)


def strata_plot(name: str, strata: list[dict[str, Any]]) -> Plot | None:
    """Tests, columns and rank by number of control steps, and the spread of results before and after adjustment."""
    last = max((row["control_steps"] for row in strata if row["sd_before"]), default=MAX_CONTROL_STEPS)
    if not (shown := [row for row in strata if 1 <= row["control_steps"] <= last]):
        return None
    steps = [row["control_steps"] for row in shown]
    beneath = "control steps l; from 10 on columns are of the first 9"
    figure, left, right = two_panels(3.2, (beneath, beneath), sharex=True)
    counts = (("n", "tests", BLUE), ("columns", "control variates", VERMILLION), ("rank", "rank", GREEN))
    for key, label, colour in counts:
        left.plot(steps, [max(row[key], 0.8) for row in shown], "o-", color=colour, label=label, markersize=3)
    for key, label, colour in (("sd_before", "Y, NADE", BLUE), ("sd_after", "Z, SCV", VERMILLION)):
        right.plot(steps, [row[key] or np.nan for row in shown], "o-", color=colour, label=label, markersize=3)
    for axes, title in ((left, "number in a stratum"), (right, "standard deviation of results")):
        if any(row["sd_before"] for row in shown) or axes is left:
            axes.set_yscale("log")
            decades(axes.yaxis, *axes.get_ylim())
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        head(axes, title)
        only_horizontal_grid(axes)
    caption = (
        "Left: tests, control variates and rank of the columns. Right: spread of Y (NADE) and of Z = Y − Hβ (SCV)."
    )
    return Plot(name, figure, "By number of control steps. " + caption, caption)
