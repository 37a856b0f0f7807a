"""Plots of a study: convergence on the paper's two axes, strata, and tests by method."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import matplotlib.style
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from harness.estimators.block import MAX_CONTROL_STEPS
from harness.records.folder import read_table
from harness.report.drawing import tick_label
from studies.case_study.counted import CURVES, SPREAD
from studies.case_study.figures import is_settled
from studies.case_study.study import Convergence, Line, Made, Study, Variants

INK, BLUE, VERMILLION, GREEN, GREY = "#1c2126", "#0067a8", "#c94f0a", "#00795a", "#8b95a0"
STYLE: list[Any] = ["default", "seaborn-v0_8-whitegrid", {"font.size": 9.0, "axes.titlelocation": "left"}]
WIDTH_IN = 7.6
"""Of the text on a page, so that letters are as large as its own."""
MOST_RATE, LEAST_GAIN = 3.0, 0.1
"""Times the known rate up to which rates are drawn; the least gain that is: where there is more, captions say so."""
_COLOURS = {"low": GREY, "nade": BLUE, "scv": VERMILLION, "nde": INK, "": GREEN}
"""Of a method in all plots, by what its step or label contains."""
_HOLLOW: dict[str, Any] = {"markerfacecolor": "none", "markersize": 7, "linewidth": 0.9}
_DASHED: dict[str, Any] = {"color": INK, "linewidth": 0.9, "linestyle": (0, (4, 3))}


class Plot(NamedTuple):
    """A PNG file, and what it shows, in words."""

    caption: str
    png: bytes


def plots_of(study: Study, made: Mapping[str, Made], ours: Mapping[str, dict[str, Any]]) -> dict[str, Plot]:
    """All plots that the study's steps give, by name."""
    with matplotlib.style.context(STYLE):
        plots = {"tests": tests_plot(study.picture, ours, study.rhw)} if ours else {}
        for name, step in study.steps.items():
            if isinstance(step, Convergence):
                plots[name] = convergence_plot(name, step, made, study.rhw, study.confidence)
            elif isinstance(step, Variants) and step.epsilons and step.reference:
                known = made[step.reference].result["figures"]["crash_rate"]["value"]
                plots[name] = settings_plot(made[name].result["variants"], known, study.rhw)
            elif step.kind == "control_variates":
                plots[f"{name}_growth"] = growth_plot(made[name].result, study.rhw)
                if strata := made[name].result["strata"]:
                    plots[name] = strata_plot(strata)
                    plots[f"{name}_results"] = spread_plot(read_table(made[name].folder / SPREAD))
    return {name: plot for name, plot in plots.items() if plot is not None}


def _figure(height_in: float, *titles: str) -> tuple[Figure, list[Axes]]:
    """Panels side by side."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    panels = figure.subplots(1, len(titles), squeeze=False)[0].tolist()
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title)
    return figure, panels


def _drawn(figure: Figure, caption: str, legend: Literal["best", "lower left", "upper right"] = "best") -> Plot:
    for axes in figure.axes:
        axes.xaxis.set_minor_formatter(NullFormatter())
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, loc=legend)
    figure.savefig(buffer := io.BytesIO(), format="png", dpi=180, metadata={"Software": None})
    return Plot(caption, buffer.getvalue())


def tests_plot(picture: Mapping[str, Line], ours: Mapping[str, dict[str, Any]], rhw: float) -> Plot | None:
    """Tests that each method asks for, on a logarithmic axis, and what the paper reports."""
    if not any(found["value"] or found["low"] for found in ours.values()):
        return None
    figure, (axes,) = _figure(3.6, f"tests for a relative half-width of {rhw:g}")
    axes.set_yscale("log")
    method = [label.partition("\n")[0] for label in ours]
    for line, paper in dict.fromkeys(zip(method, (picture[label].paper for label in ours), strict=True)):
        if paper is not None:  # one number of theirs beside all of ours that it stands for
            at = [place for place, label in enumerate(ours) if (method[place], picture[label].paper) == (line, paper)]
            axes.plot(at, [paper] * len(at), ":", color=INK, linewidth=0.9)
            axes.plot(np.mean(at), paper, "D", color=INK, **_HOLLOW)
    at = [place for place, line in enumerate(method) if line == "NADE"]
    axes.plot(at, [found["value"] or np.nan for found in (list(ours.values())[place] for place in at)], color=BLUE)
    for place, (label, found) in enumerate(ours.items()):
        if (value := found["value"] or found["low"]) is None:
            continue
        colour = GREY if not is_settled(found) else next(c for name, c in _COLOURS.items() if name in label.lower())
        ends = [[value - (found["low"] or value)], [(found["high"] or value) - value]]
        is_limit = found["high"] is None and found["low"] is not None
        axes.errorbar(place, value, yerr=ends, fmt="^" if is_limit else "o", color=colour, capsize=4.0, markersize=7)
        words = ("> " if is_limit else "") + tick_label(float(f"{value:.2g}")) + (" †" if colour == GREY else "")
        put: dict[str, Any] = {"xytext": (0, -18 if is_limit else 7), "textcoords": "offset points", "ha": "center"}
        axes.annotate(words, (place, found["high"] or value), **put, fontsize=8, bbox={"color": "white", "pad": 0.5})
    axes.margins(y=0.15)
    axes.set_xticks(range(len(ours)), list(ours), fontsize=8)
    axes.set_xlabel("method")
    axes.grid(visible=False, axis="x")
    axes.plot([], "o", color=INK, markersize=7, label="here")
    axes.plot([], "^", color=INK, markersize=7, label="here, at least")
    axes.plot([], "D", color=INK, label="the paper, whose ε is not published", **_HOLLOW)
    return _drawn(figure, "Tests by method, AV = SM-I. Grey, †: not converged.", "upper right")


def convergence_plot(name: str, step: Convergence, made: Mapping[str, Made], rhw: float, confidence: float) -> Plot:
    """Crash rate with its band, and RHW, against tests."""
    table = read_table(made[name].folder / CURVES)
    reference = made[step.reference].result["figures"]["crash_rate"]["value"] or 0.0
    figure, (left, right) = _figure(3.2, "crash rate per test", "relative half-width")
    for label in step.of:
        colour = next(colour for name, colour in _COLOURS.items() if name in label)
        rows = table.filter(pc.equal(table.column("step"), label))
        n, rate, half = (rows.column(column).to_numpy() for column in ("n", "crash_rate", "half_width"))
        known = (rate > 0.0) & np.isfinite(half)
        left.fill_between(n, np.maximum(rate - half, 0.0), rate + half, color=colour, alpha=0.16, linewidth=0)
        left.plot(n, rate, color=colour)
        right.plot(n[known], half[known] / rate[known], color=colour, label=step.words.get(label, label))
    known_by = step.words.get(step.reference, step.reference)
    left.axhline(reference, **_DASHED, label=known_by)
    left.set(xlabel="tests", xscale="log", ylim=(0.0, MOST_RATE * reference or 1.0))
    right.axhline(rhw, **_DASHED, label=f"asked: {rhw:g}")
    right.set(xlabel="tests", xscale="log", yscale="log")
    cut = f"what is above {MOST_RATE:g} times the rate of {known_by} is cut off"
    return _drawn(figure, f"By tests: crash rates with {confidence:.0%} bands ({cut}), and relative half-widths.")


def strata_plot(strata: list[dict[str, Any]]) -> Plot | None:
    """Tests, columns and rank by number of control steps, and the spread of results before and after adjustment."""
    last = max((row["control_steps"] for row in strata if row["sd_before"]), default=MAX_CONTROL_STEPS)
    if not (shown := [row for row in strata if 1 <= row["control_steps"] <= last]):
        return None
    steps, most = [row["control_steps"] for row in shown], max(row["sd_before"] for row in shown)
    figure, (left, right) = _figure(3.2, "number in a stratum", "standard deviation of results")
    kinds = ("n", "tests", INK), ("columns", "control variates", GREY), ("rank", "their rank", GREEN)
    for key, label, colour in kinds:
        left.plot(steps, [row[key] for row in shown], "o-", color=colour, label=label, markersize=2.5)
    for key, label, colour, width in (("sd_before", "Y, NADE", BLUE, 4.0), ("sd_after", "Z, SCV", VERMILLION, 1.4)):
        spread = [row[key] if row[key] > most / 1e4 else np.nan for row in shown]  # beneath it is what rounding left
        right.plot(steps, spread, "o-", color=colour, label=label, markersize=3, linewidth=width)
    left.set_yscale("symlog", linthresh=1.0)  # with a place for a rank of 0
    left.set(xlabel="control steps l", ylim=(-0.2, None))
    right.set(xlabel="control steps l", yscale="log" if most else "linear")
    columns = f"tests, control variates (of the first {MAX_CONTROL_STEPS} steps) and their rank"
    return _drawn(figure, f"By control steps: {columns}; spread of results of NADE (Y) and of SCV (Z).")


_GAINS = {"claimed": ("as claimed", _COLOURS["scv"]), "degrees_of_freedom": ("by degrees of freedom", INK)}


def growth_plot(result: Mapping[str, Any], rhw: float) -> Plot | None:
    """RHW of NADE and of SCV against tests, and the gain that SCV claims, corrected, and between parts of the run."""
    known = [row for row in result["looks"] if row["nade_rhw"] and row["scv_rhw"] and row["gain_claimed"]]
    if not known:
        return None
    n = [row["n"] for row in known]
    figure, (left, right) = _figure(3.2, "relative half-width", "NADE's variance over SCV's")
    for key, label, width in (("nade", "NADE", 4.0), ("scv", "SCV, as it claims", 1.4)):
        values = [row[f"{key}_rhw"] for row in known]
        left.plot(n, values, "o-", label=label, color=_COLOURS[key], linewidth=width, markersize=3)
    caption = "By tests: relative half-widths; SCV's gain as claimed, corrected, and replicated."
    for key, (label, colour) in _GAINS.items():
        gains = np.array([row[f"gain_{key}"] or np.nan for row in known])
        below = gains < LEAST_GAIN
        right.plot(n, np.maximum(gains, LEAST_GAIN), "-", color=colour)
        right.plot(n, np.where(below, np.nan, gains), "o", color=colour, markersize=3)
        right.plot(n, np.where(below, LEAST_GAIN, np.nan), "v", color=colour, markersize=5)
        right.plot([], "o-", color=colour, markersize=3, label=label)
        caption += f" Triangles: below {LEAST_GAIN:g}." if below.any() else ""
    again = [(row["n"], row["gain_replicated"]["value"]) for row in result["sizes"] if row["gain_replicated"]["value"]]
    right.plot(*np.transpose(again or [(np.nan, np.nan)]), "D", color=BLUE, label="by replication", **_HOLLOW)
    left.axhline(rhw, **_DASHED, label=f"asked: {rhw:g}")
    right.axhline(1.0, **_DASHED)
    for axes in (left, right):
        axes.set(xlabel="tests", xscale="log", yscale="log")
    return _drawn(figure, caption, "lower left")


def spread_plot(results: pa.Table) -> Plot | None:
    """Distributions of results before and after adjustment, by number of control steps and of all."""
    steps, y, z = (results.column(key).to_numpy() for key in ("control_steps", "y", "z"))
    if not np.any(y > 0.0):
        return None
    y, z = y / (scale := np.median(y[y > 0.0])), z / scale
    side = np.geomspace(1e-2, 2.0 * max(np.abs(y).max(), np.abs(z).max()), 25)
    levels = {f"l = {level}": steps == level for level in range(1, MAX_CONTROL_STEPS + 1)}
    shown = {title: rows for title, rows in levels.items() if rows.any()} | {"all": np.full(len(steps), True)}
    figure, across = Figure(figsize=(WIDTH_IN, 3.6), layout="constrained"), -(-len(shown) // 2)
    panels = figure.subplots(2, across, sharey=True, squeeze=False).ravel()
    for (title, rows), axes in zip(shown.items(), panels, strict=False):
        for values, key in ((y, "nade"), (z, "scv")):
            axes.hist(values[rows], [*-side[::-1], *side], histtype="step", color=_COLOURS[key])
        axes.set_title(title)
        axes.set_xscale("symlog", linthresh=1e-2, linscale=0.5)
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_xticks([-1.0, 0.0, 1.0], ["-1", "0", "1"])
    for axes in panels[len(shown) :]:
        axes.remove()
    figure.supxlabel("result over the median crash", fontsize=9)
    figure.supylabel("tests", fontsize=9)
    lines = [Line2D([], [], color=_COLOURS[key]) for key in ("nade", "scv")]
    figure.legend(lines, ["Y, NADE", "Z, SCV"], loc="outside upper right", ncols=2, fontsize=8)
    left_out = "numbers of steps without a result, and results that are 0, are left out"
    return _drawn(figure, f"By control steps l: results of NADE (Y) and SCV (Z); {left_out}.")


def settings_plot(variants: list[dict[str, Any]], known_rate: float, rhw: float) -> Plot:
    """Of each setting tests as claimed, by replication and over shuffles; mean weight and rate over the known one."""
    figure, (left, right) = _figure(3.2, f"tests for a relative half-width of {rhw:g}", "should be 1")
    ways = ("claimed", "as claimed", "o", GREY), ("rnot", "RNoT", "s", GREEN), ("true", "by replication", "o", BLUE)
    for key, label, marker, colour in ways:
        style: dict[str, Any] = {"color": colour, "linestyle": "none", "markersize": 8 if key == "claimed" else 5}
        left.plot([row[key]["value"] or np.nan for row in variants], marker, label=label, **style)
        left.plot([np.nan if row[key]["value"] else row[key]["low"] or np.nan for row in variants], "^", **style)
    left.plot([], "^", color=INK, markersize=5, linestyle="none", label="at least")
    left.set_yscale("log")
    right.plot([row["mean_weight"] for row in variants], "o-", color=INK, label="mean weight", markersize=4)
    rates = [(row["nade_rate"]["value"] or np.nan) / known_rate for row in variants]
    right.plot(rates, "o-", color=BLUE, label="rate / known rate", markersize=4)
    right.axhline(1.0, **_DASHED)
    right.set_ylim(bottom=0.0)
    for axes in (left, right):
        axes.set_xticks(range(len(variants)), [row["variant"].rpartition(" ")[2] for row in variants])
        axes.set_xlabel("ε")
    return _drawn(figure, "By ε, AV = SM-I: tests; mean weight, and rate over the known one.")
