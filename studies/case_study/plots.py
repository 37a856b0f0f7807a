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

from harness.estimators.block import MAX_CONTROL_STEPS
from harness.records.folder import read_table
from harness.report.drawing import tick_label
from studies.case_study.counted import CURVES, SPREAD
from studies.case_study.figures import is_settled
from studies.case_study.study import Convergence, Line, Made, Study, Variants

INK, BLUE, VERMILLION, GREEN, GREY = "#1c2126", "#0067a8", "#c94f0a", "#00795a", "#8b95a0"
STYLE: list[Any] = ["default", "seaborn-v0_8-whitegrid", {"font.size": 9.0, "axes.titlelocation": "left"}]
MOST_RATE, LEAST_GAIN = 3.0, 0.1
"""Times the known rate up to which rates are drawn; the least gain: worse ones are on the axis."""
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
                plots[f"{name}_growth"] = growth_plot(made[name].result["looks"], study.rhw)
                if strata := made[name].result["strata"]:
                    plots[name] = strata_plot(strata)
                    plots[f"{name}_results"] = spread_plot(read_table(made[name].folder / SPREAD))
    return {name: plot for name, plot in plots.items() if plot is not None}


def _figure(height_in: float, *titles: str) -> tuple[Figure, list[Axes]]:
    """Panels side by side."""
    figure = Figure(figsize=(8.6, height_in), layout="constrained")
    panels = figure.subplots(1, len(titles), squeeze=False)[0].tolist()
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title)
    return figure, panels


def _drawn(figure: Figure, caption: str, legend: Literal["best", "lower left"] = "best") -> Plot:
    for axes in figure.axes:
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, loc=legend)
    figure.savefig(buffer := io.BytesIO(), format="png", dpi=160, metadata={"Software": None})
    return Plot(caption, buffer.getvalue())


def tests_plot(picture: Mapping[str, Line], ours: Mapping[str, dict[str, Any]], rhw: float) -> Plot | None:
    """Tests that each method asks for, on a logarithmic axis, and what the paper reports."""
    if not any(found["value"] or found["low"] for found in ours.values()):
        return None
    figure, (axes,) = _figure(3.6, f"tests for a relative half-width of {rhw:g}")
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
        at_offset: dict[str, Any] = {
            "xytext": (0, -18 if is_limit else 7),
            "textcoords": "offset points",
            "ha": "center",
        }
        axes.annotate(
            words, (place, found["high"] or value), **at_offset, fontsize=8, bbox={"color": "white", "pad": 0.5}
        )
    axes.margins(y=0.15)
    axes.set_xticks(range(len(ours)), list(ours), fontsize=8)
    axes.grid(visible=False, axis="x")
    caption = "Tests by method. Filled: here (triangles: lower limits; grey, †: not converged). Hollow: the paper's."
    return _drawn(figure, caption)


def convergence_plot(name: str, step: Convergence, made: Mapping[str, Made], rhw: float, confidence: float) -> Plot:
    """Crash rate with its band, and RHW, against tests."""
    table = read_table(made[name].folder / CURVES)
    reference = made[step.reference].result["figures"]["crash_rate"]["value"] or 0.0
    figure, (left, right) = _figure(3.4, "crash rate per test", "RHW")
    for label in step.of:
        colour = next(colour for name, colour in _COLOURS.items() if name in label)
        rows = table.filter(pc.equal(table.column("step"), label))
        n, rate, half = (rows.column(column).to_numpy() for column in ("n", "crash_rate", "half_width"))
        known = (rate > 0.0) & np.isfinite(half)
        left.fill_between(n, np.maximum(rate - half, 0.0), rate + half, color=colour, alpha=0.16, linewidth=0)
        left.plot(n, rate, color=colour, label=label)
        right.plot(n[known], half[known] / rate[known], color=colour, label=label)
    left.axhline(reference, **_DASHED)
    left.set(xlabel="tests", xscale="log", ylim=(0.0, MOST_RATE * reference or 1.0))
    right.axhline(rhw, **_DASHED)
    right.set(xlabel="tests", xscale="log", yscale="log")
    caption = f"Crash rates with {confidence:.0%} bands (dashed: {step.reference}), and RHW, by tests."
    return _drawn(figure, caption)


def strata_plot(strata: list[dict[str, Any]]) -> Plot | None:
    """Tests, columns and rank by number of control steps, and the spread of results before and after adjustment."""
    last = max((row["control_steps"] for row in strata if row["sd_before"]), default=MAX_CONTROL_STEPS)
    if not (shown := [row for row in strata if 1 <= row["control_steps"] <= last]):
        return None
    steps, most = [row["control_steps"] for row in shown], max(row["sd_before"] for row in shown)
    figure, (left, right) = _figure(3.2, "number in a stratum", "standard deviation of results")
    for key, label, colour in (("n", "tests", INK), ("columns", "control variates", GREY), ("rank", "rank", GREEN)):
        left.plot(steps, [max(row[key], 0.8) for row in shown], "o-", color=colour, label=label, markersize=3)
    for key, label, colour, width in (("sd_before", "Y, NADE", BLUE, 4.0), ("sd_after", "Z, SCV", VERMILLION, 1.4)):
        spread = [row[key] if row[key] > most / 1e4 else np.nan for row in shown]  # beneath it is what rounding left
        right.plot(steps, spread, "o-", color=colour, label=label, markersize=3, linewidth=width)
    beneath = "control steps l; from 10 on columns are of the first 9"
    left.set(xlabel=beneath, yscale="log")
    right.set(xlabel=beneath, yscale="log" if most else "linear")
    return _drawn(figure, "By control steps: tests, columns and their rank; spread of results of NADE (Y) and SCV (Z).")


def growth_plot(looks: list[dict[str, Any]], rhw: float) -> Plot | None:
    """RHW of NADE and of SCV against tests, and the gain that SCV claims, corrected, and between parts of the run."""
    known = [row for row in looks if row["nade_rhw"] and row["scv_rhw"] and row["gain_claimed"]]
    if not known:
        return None
    n = [row["n"] for row in known]
    figure, (left, right) = _figure(3.4, "relative half-width", "NADE's variance over SCV's")
    for key, label, width in (("nade", "NADE", 4.0), ("scv", "SCV, as it claims", 1.4)):
        values = [row[f"{key}_rhw"] for row in known]
        left.plot(n, values, "o-", label=label, color=_COLOURS[key], linewidth=width, markersize=3)
    for key, colour in (("claimed", _COLOURS["scv"]), ("degrees_of_freedom", INK), ("leave_one_out", GREEN)):
        gains = [max(row[f"gain_{key}"] or np.nan, LEAST_GAIN) for row in known]
        right.plot(n, gains, "o-", color=colour, markersize=3, label=key.replace("_", " "))
    again = [row["gain_replicated"]["value"] or np.nan for row in known]
    right.plot(n, again, "D", color=BLUE, label="replication", **_HOLLOW)
    left.axhline(rhw, **_DASHED)
    right.axhline(1.0, **_DASHED)
    for axes in (left, right):
        axes.set(xlabel="tests", xscale="log", yscale="log")
    caption = "By tests: RHW, and SCV's gain as claimed, corrected and replicated."
    return _drawn(figure, caption, "lower left")


def spread_plot(results: pa.Table) -> Plot | None:
    """Distributions of results before and after adjustment, by number of control steps and of all."""
    steps, y, z = (results.column(key).to_numpy() for key in ("control_steps", "y", "z"))
    if not np.any(y > 0.0):
        return None
    y, z = y / (scale := np.median(y[y > 0.0])), z / scale
    side = np.geomspace(1e-2, 2.0 * max(np.abs(y).max(), np.abs(z).max()), 25)
    figure = Figure(figsize=(8.6, 3.4), layout="constrained")
    panels = figure.subplots(2, 5, sharex=True, sharey=True).ravel()
    for level, axes in enumerate(panels, start=1):
        rows = steps == level if level <= MAX_CONTROL_STEPS else np.full(len(steps), True)
        for values, key, label in ((y, "nade", "Y, NADE"), (z, "scv", "Z, SCV")):
            axes.hist(
                values[rows],
                [*-side[::-1], *side],
                label=label if level == 1 else None,
                histtype="step",
                color=_COLOURS[key],
            )
        axes.set_title(f"l = {level}" if level <= MAX_CONTROL_STEPS else "all")
        axes.set_xscale("symlog", linthresh=1e-2, linscale=0.5)
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_xticks([-1.0, 0.0, 1.0], ["-1", "0", "1"])
    panels[0].set_ylabel("tests")
    return _drawn(figure, "By control steps l: results over the median crash, of NADE (Y) and SCV (Z); zeros left out.")


def settings_plot(variants: list[dict[str, Any]], known_rate: float, rhw: float) -> Plot:
    """Of each setting tests as claimed, by replication and over shuffles; mean weight and rate over the known one."""
    figure, (left, right) = _figure(3.4, f"tests for a relative half-width of {rhw:g}", "should be 1")
    looks = (("claimed", "as claimed", "o", GREY), ("rnot", "RNoT", "s", GREEN), ("true", "by replication", "o", BLUE))
    for key, label, marker, colour in looks:
        style: dict[str, Any] = {"color": colour, "linestyle": "none", "markersize": 8 if key == "claimed" else 5}
        left.plot([row[key]["value"] or np.nan for row in variants], marker, label=label, **style)
        left.plot([np.nan if row[key]["value"] else row[key]["low"] or np.nan for row in variants], "^", **style)
    left.set_yscale("log")
    right.plot([row["mean_weight"] for row in variants], "o-", color=INK, label="mean weight", markersize=4)
    rates = [(row["nade_rate"]["value"] or np.nan) / known_rate for row in variants]
    right.plot(rates, "o-", color=BLUE, label="rate / known rate", markersize=4)
    right.axhline(1.0, **_DASHED)
    right.set_ylim(bottom=0.0)
    for axes in (left, right):
        axes.set_xticks(range(len(variants)), [row["variant"] for row in variants], fontsize=8, rotation=30)
    return _drawn(figure, "By ε: tests (triangles: lower limits); mean weight, and rate over the known one.")
