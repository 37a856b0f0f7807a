"""Plots of a study: convergence on the paper's two axes, strata, and tests by method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.ticker import MaxNLocator

from harness.records.folder import read_table
from harness.report.plot_style import (
    BLUE,
    FULL_WIDTH_IN,
    GREEN,
    GREY,
    INK,
    MUTED,
    VERMILLION,
    Plot,
    decades,
    new_figure,
    note,
    only_horizontal_grid,
    scaled,
    tick_label,
)
from harness.studies.case_study.context import Made
from harness.studies.case_study.convergence import CURVES
from harness.studies.case_study.study_file import Convergence, Study

_COLOURS = (INK, BLUE, VERMILLION, GREEN)


def plots_of(study: Study, made: Mapping[str, Made], picture: Mapping[str, dict[str, Any]]) -> dict[str, Plot]:
    """All plots that the study's steps give, by name."""
    plots: list[Plot | None] = [tests_plot(picture, study.rhw)] if picture else []
    for name, step in study.steps.items():
        if isinstance(step, Convergence):
            plots.append(convergence_plot(name, step, made, study.rhw, study.confidence))
        elif step.kind == "control_variates":
            plots.append(strata_plot(name, made[name].result["strata"]))
        elif step.kind == "theorems":
            plots.append(theorems_plot(name, made[name].result))
    return {plot.name: plot for plot in plots if plot is not None}


def tests_plot(picture: Mapping[str, dict[str, Any]], rhw: float) -> Plot | None:
    """Tests that each method asks for, on a logarithmic axis; an arrow where the number is a lower limit."""
    known = {label: found for label, found in picture.items() if (found["value"] or found["low"] or 0.0) > 0.0}
    if not known:
        return None
    figure = new_figure(FULL_WIDTH_IN, 0.9 + 0.36 * len(picture))
    axes = figure.subplots()
    ends: list[float] = []
    for place, (label, found) in enumerate(picture.items()):
        if label not in known:
            axes.text(0.02, place, "not reached", transform=axes.get_yaxis_transform(), va="center", color=MUTED)
            continue
        value = found["value"] or found["low"]
        low, high = found["low"] or value, found["high"] or value
        axes.plot([low, high], [place, place], color=GREY, linewidth=3.0)
        axes.plot(value, place, "o" if found["high"] is not None or found["low"] is None else ">", color=BLUE)
        note(axes, tick_label(float(f"{value:.2g}")), (high, place), (8, -3), color=INK)
        ends += [low, high]
    axes.set_xscale("log")
    axes.set_xlim(min(ends) / 3.0, max(ends) * 8.0)
    decades(axes.xaxis, *axes.get_xlim())
    axes.set_yticks(np.arange(len(picture)), list(picture))
    axes.set_ylim(len(picture) - 0.5, -0.5)
    axes.set_title(f"Tests for a relative half-width of {rhw:g}")
    caption = "Bars are intervals; an arrow is a lower limit."
    return Plot("tests", figure, "Number of tests by method, on a logarithmic axis. " + caption, caption)


def convergence_plot(name: str, step: Convergence, made: Mapping[str, Made], rhw: float, confidence: float) -> Plot:
    """Crash rate with its band, the first curve on the lower axis and the second on the upper; RHW of all."""
    of, table = step.of, read_table(made[name].folder / CURVES)
    reference = made[step.reference].result["figures"]["crash_rate"]["value"] or 0.0
    figure = new_figure(FULL_WIDTH_IN, 3.6)
    left, right = figure.subplots(1, 2)
    curves = [_curve(table, each) for each in of]
    top = reference
    left.axhline(reference, color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
    for place, (label, (n, rate, half)) in enumerate(zip(of, curves, strict=True)):
        colour, axes = _COLOURS[place], left if place == 0 else left.twiny()
        axes.fill_between(n, np.maximum(rate - half, 0.0), rate + half, color=colour, alpha=0.16, linewidth=0)
        axes.plot(n, rate, color=colour, label=label)
        axes.set_xlim(0.0, n[-1])
        axes.set_xlabel(f"tests, {label}{scaled(axes.xaxis, n[-1])}", color=colour)
        if place:
            axes.grid(visible=False)
            axes.spines["top"].set(visible=True, position=("outward", 34.0 * (place - 1)))
        late = np.isfinite(half) & (n > n[-1] / 10)
        top = max(top, float(np.max((rate + half)[late], initial=0.0)))
        known = (rate > 0.0) & np.isfinite(half)
        right.plot(n[known], half[known] / rate[known], color=colour, label=label)
    left.set_ylim(0.0, 1.1 * top or 1.0)
    left.set_ylabel(f"crash rate per test{scaled(left.yaxis, 1.1 * top or 1.0)}")
    right.set_xscale("log")
    right.set_yscale("log")
    right.axhline(rhw, color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
    decades(right.xaxis, max(right.get_xlim()[0], 1.0), right.get_xlim()[1])
    decades(right.yaxis, *right.get_ylim())
    right.set_xlabel("tests")
    right.set_ylabel("relative half-width")
    right.legend()
    caption = (
        f"Left: crash rates with their {confidence:.0%} bands; dashed: that of {step.reference}. Right: relative "
        f"half-widths; dashed: {rhw:g}."
    )
    return Plot(name, figure, f"Convergence of {', '.join(of)}. {caption}", caption)


def _curve(table: pa.Table, step: str) -> tuple[np.ndarray, ...]:
    rows = table.filter(pc.equal(table.column("step"), step))
    return tuple(rows.column(column).to_numpy() for column in ("n", "crash_rate", "half_width"))


def strata_plot(name: str, strata: list[dict[str, Any]]) -> Plot | None:
    """Tests, columns and rank by number of control steps, and the spread of results before and after adjustment."""
    shown = [row for row in strata if 1 <= row["n_control_steps"] <= 20]
    if not shown:
        return None
    steps = [row["n_control_steps"] for row in shown]
    figure = new_figure(FULL_WIDTH_IN, 3.2)
    left, right = figure.subplots(1, 2)
    for key, label, colour in (
        ("n", "tests", BLUE),
        ("columns", "control variates", VERMILLION),
        ("rank", "rank", GREEN),
    ):
        left.plot(steps, [max(row[key], 0.8) for row in shown], "o-", color=colour, label=label, markersize=4)
    for key, label, colour in (("sd_before", "NADE", BLUE), ("sd_after", "SCV", VERMILLION)):
        right.plot(steps, [row[key] or np.nan for row in shown], "o-", color=colour, label=label, markersize=4)
    for axes, title in ((left, "Strata"), (right, "Standard deviation of Y and Z")):
        if any(row["sd_before"] for row in shown) or axes is left:
            axes.set_yscale("log")
            decades(axes.yaxis, *axes.get_ylim())
        axes.set_xlabel("control steps")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_title(title)
        axes.legend()
        only_horizontal_grid(axes)
    caption = (
        "Left: tests, control variates and rank of the columns. Right: spread of Y (NADE) and of Z = Y − Hβ (SCV)."
    )
    return Plot(name, figure, "By number of control steps. " + caption, caption)


def theorems_plot(name: str, result: dict[str, Any]) -> Plot:
    """Variances under their bound on exact chains, and what known and estimated means give where it should be zero."""
    figure = new_figure(FULL_WIDTH_IN, 3.0)
    left, right = figure.subplots(1, 2)
    chains = result["chains"]
    for place, chain in enumerate(chains):
        for key, marker, colour in (("plain", "o", BLUE), ("best", "o", GREEN), ("bound", "|", INK)):
            left.plot(chain[key], place, marker, color=colour, markersize=9 if marker == "|" else 5)
    for label, colour, marker in (
        ("NADE", BLUE, "o"),
        ("best β, known means", GREEN, "o"),
        ("bound", INK, "|"),
    ):
        left.plot([], [], marker, color=colour, label=label)
    left.set_xscale("log")
    decades(left.xaxis, *left.get_xlim())
    left.set_yticks(range(len(chains)), [chain["chain"] for chain in chains])
    left.set_ylim(len(chains) - 0.5, -0.5 - 0.6)
    left.set_title("Theorem 2: variance over μ²")
    left.legend(ncols=3, fontsize=7.5, loc="upper left")
    draws = np.asarray(result["draws"]["estimated"]) - 1.0
    right.hist(draws, bins=30, color=VERMILLION, alpha=0.7, label="estimated means")
    right.axvline(0.0, color=GREEN, label="known means: all of them")
    right.set_xlabel("error relative to μ; claimed: 0")
    right.set_title("Theorem 3: repeated estimates")
    right.legend(fontsize=7.5)
    caption = (
        "Left: exact variances of NADE and with the best control parameters, below Theorem 2's bound. Right: repeated "
        "estimates in a world that meets Theorem 3's assumptions."
    )
    return Plot(name, figure, caption, caption)
