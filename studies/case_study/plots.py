"""Plots of a study: convergence on the paper's two axes, strata, and tests by method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
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
    PAPER,
    VERMILLION,
    Plot,
    decades,
    new_figure,
    note,
    only_horizontal_grid,
    scaled,
    tick_label,
)
from studies.case_study.counted import CURVES
from studies.case_study.figures import is_settled
from studies.case_study.study import Convergence, Line, Made, Study

_COLOURS = (INK, BLUE, VERMILLION, GREEN)


def plots_of(study: Study, made: Mapping[str, Made], ours: Mapping[str, dict[str, Any]]) -> dict[str, Plot]:
    """All plots that the study's steps give, by name."""
    plots: list[Plot | None] = [tests_plot(study.picture, ours, study.rhw)] if ours else []
    for name, step in study.steps.items():
        if isinstance(step, Convergence):
            plots.append(convergence_plot(name, step, made, study.rhw, study.confidence))
        elif step.kind == "control_variates":
            plots.append(strata_plot(name, made[name].result["strata"]))
        elif step.kind == "theorems":
            plots.append(theorems_plot(name, made[name].result))
    return {plot.name: plot for plot in plots if plot is not None}


def tests_plot(picture: Mapping[str, Line], ours: Mapping[str, dict[str, Any]], rhw: float) -> Plot | None:
    """Tests that each method asks for, on a logarithmic axis, and what the paper reports; arrows for lower limits."""
    if not any(found["value"] or found["low"] for found in ours.values()):
        return None
    figure = new_figure(FULL_WIDTH_IN, 1.1 + 0.36 * len(picture))
    axes = figure.subplots()
    ends = [line.paper for line in picture.values() if line.paper is not None]
    for place, (label, found) in enumerate(ours.items()):
        if (paper := picture[label].paper) is not None:
            axes.plot(paper, place, "D", markerfacecolor="none", color=VERMILLION, markersize=8)
        if not (value := found["value"] or found["low"]):
            axes.text(0.02, place, "not reached", transform=axes.get_yaxis_transform(), va="center", color=MUTED)
            continue
        low, high = found["low"] or value, found["high"] or value
        axes.plot([low, high], [place, place], color=GREY, linewidth=3.0)
        is_limit = found["high"] is None and found["low"] is not None
        axes.plot(value, place, ">" if is_limit else "o", color=BLUE if is_settled(found) else GREY)
        words = tick_label(float(f"{value:.2g}")) + ("" if is_settled(found) else " †")
        beside = paper if paper is not None and high / 1.5 < paper < 6.0 * high else high
        note(axes, words, (beside, place), (9, -3), color=INK)
        ends += [low, high]
    axes.set_xscale("log")
    axes.set_xlim(min(ends) / 3.0, max(ends) * 8.0)
    decades(axes.xaxis, *axes.get_xlim())
    axes.set_yticks(np.arange(len(picture)), list(picture))
    axes.set_ylim(len(picture) - 0.5, -0.5)
    axes.set_xlabel(f"tests until the relative half-width is {rhw:g}")
    for label, marker, face, colour in (
        ("here", "o", BLUE, BLUE),
        ("here, not converged (†)", "o", GREY, GREY),
        ("the paper", "D", "none", VERMILLION),
    ):
        axes.plot([], [], marker, markerfacecolor=face, color=colour, label=label)
    axes.legend(ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=8)
    caption = (
        "Filled: here, with intervals as bars, arrows for lower limits; all by one definition, tests made times the "
        f"square of their relative half-width over {rhw:g}. Hollow: reported in the paper."
    )
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
    right.axhline(rhw, color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
    decades(right.xaxis, max(right.get_xlim()[0], 1.0), right.get_xlim()[1])
    decades(right.yaxis, *right.get_ylim())
    right.set_xlabel("tests")
    right.set_ylabel("relative half-width")
    if right.get_legend_handles_labels()[0]:
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
    shown = [row for row in strata if row["control_steps"] >= 1]
    last = max((row["control_steps"] for row in shown if row["sd_before"]), default=MAX_CONTROL_STEPS)
    if not (shown := [row for row in shown if row["control_steps"] <= last]):
        return None
    steps = [row["control_steps"] for row in shown]
    figure = new_figure(FULL_WIDTH_IN, 3.2)
    left, right = figure.subplots(1, 2, sharex=True)
    for key, label, colour in (
        ("n", "tests", BLUE),
        ("columns", "control variates", VERMILLION),
        ("rank", "rank", GREEN),
    ):
        left.plot(steps, [max(row[key], 0.8) for row in shown], "o-", color=colour, label=label, markersize=3)
    for key, label, colour in (("sd_before", "Y, NADE", BLUE), ("sd_after", "Z, SCV", VERMILLION)):
        right.plot(steps, [row[key] or np.nan for row in shown], "o-", color=colour, label=label, markersize=3)
    for axes, title in ((left, "number in a stratum"), (right, "standard deviation of results")):
        if any(row["sd_before"] for row in shown) or axes is left:
            axes.set_yscale("log")
            decades(axes.yaxis, *axes.get_ylim())
        axes.set_xlabel("control steps l; from 10 on columns are of the first 9")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylabel(title)
        axes.legend(ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=8)
        only_horizontal_grid(axes)
    caption = (
        "Left: tests, control variates and rank of the columns. Right: spread of Y (NADE) and of Z = Y − Hβ (SCV)."
    )
    return Plot(name, figure, "By number of control steps. " + caption, caption)


def theorems_plot(name: str, result: dict[str, Any]) -> Plot:
    """Means and variances on exact chains, and what known and estimated means give where it should be zero."""
    figure = new_figure(FULL_WIDTH_IN, 3.3)
    first, second, third = figure.subplots(1, 3)
    chains = result["chains"]
    looks = {
        "plain": ("NADE", "o", BLUE, 11),
        "best": ("best β, known means", "o", GREEN, 7),
        "any": ("another β", "o", GREY, 3),
    }
    for place, chain in enumerate(chains):
        for key, (_, marker, colour, size) in looks.items():
            first.plot(chain["means"][key], place, marker, color=colour, markersize=size)
        for key, marker, colour in (("plain", "o", BLUE), ("best", "o", GREEN), ("bound", "|", INK)):
            second.plot(chain[key], place, marker, color=colour, markersize=9 if marker == "|" else 5)
    for label, marker, colour, size in (*looks.values(), ("bound", "|", INK, 9)):
        first.plot([], [], marker, color=colour, label=label, markersize=size)
    first.set_xlim(0.9, 1.1)
    first.set_yticks(range(len(chains)), [chain["chain"] for chain in chains])
    first.set_title("Theorem 1: unbiased")
    first.set_xlabel("exact mean / crash rate μ")
    second.set_xscale("log")
    decades(second.xaxis, *second.get_xlim())
    second.set_yticks(range(len(chains)), [])
    second.set_title("Theorem 2: bounded")
    second.set_xlabel("exact variance per test / μ²")
    for axes in (first, second):
        axes.set_ylim(len(chains) - 0.5, -0.5)
    figure.legend(*first.get_legend_handles_labels(), ncols=4, fontsize=8, loc="outside lower left")
    third.hist(np.asarray(result["draws"]["estimated"]) - 1.0, bins=30, color=VERMILLION, label="estimated means")
    third.axvline(0.0, color=GREEN, label="known means: all of them")
    third.set_xlabel("error of an estimate / μ; claimed: 0")
    third.set_ylabel("repetitions")
    third.set_title("Theorem 3: zero variance")
    third.set_ylim(0.0, 1.45 * third.get_ylim()[1])
    third.legend(fontsize=7.5, loc="upper left", frameon=True, framealpha=1.0, facecolor=PAPER, edgecolor=PAPER)
    caption = (
        "Left: exact means, of NADE and with two choices of control parameters. Middle: exact variances, below "
        "Theorem 2's bound. Right: repeated estimates in a world that meets Theorem 3's assumptions, with known "
        "means of the control variates and, as in Algorithm 1, with those of the same tests."
    )
    return Plot(name, figure, caption, caption)
