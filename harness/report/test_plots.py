"""Which cut-ins crash, beside what others avoid."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from harness.compiled import unboxed
from harness.episode.path import empty_trajectory
from harness.numbers import count, share
from harness.pool.replay import StoredPaths, drive_others
from harness.pool.walk import Script
from harness.report.player import OTHERS
from harness.report.style import (
    BLUE,
    FULL_WIDTH_IN,
    GRID,
    INK,
    REDS,
    Plot,
    head,
    new_figure,
)
from harness.report.summary import RunSummary
from harness.traffic.laws import Environment
from harness.vehicles.library import library_records
from harness.vocabulary import CRASH, CUT_IN, FAILED, FloatArray, IntArray, states_from

SHARES = {0.0: GRID, 0.25: REDS[0], 0.5: REDS[1], 0.75: REDS[3], 1.0: REDS[5]}
"""Up to which share of cut-ins that crash a cell of the map has a colour."""
KEEPS_SPEED = 20
"""Index of the maneuver 0 m/s²."""


def where_plot(summary: RunSummary, environment: Environment | None) -> Plot | None:
    """Map of the share of cut-ins that crash, over gap and closing speed, and what others avoid; None without any.

    ``environment`` is that in which others can be driven, None where that is not known any more.
    """
    rows = summary.rows
    cut_in = np.isfinite(rows["cut_in_r2_m"]) & np.isfinite(rows["cut_in_r2dot_mps"]) & (rows["outcome"] != FAILED)
    if not cut_in.any():
        return None
    gap, closing = rows["cut_in_r2_m"][cut_in], np.maximum(-rows["cut_in_r2dot_mps"][cut_in], 0.0)
    weight, crash = rows["weight"][cut_in], rows["outcome"][cut_in] == CRASH
    of = crash if crash.any() else np.ones_like(crash)
    far, fast = 1.4 * float(np.quantile(gap[of], 0.98)) + 1.0, 1.15 * float(np.quantile(closing[of], 0.98)) + 1.0
    cells = int(np.clip(0.7 * math.sqrt(gap.size), 12, 40))  # with few cut-ins each in one of its own
    edges = np.linspace(0.0, far, cells + 1), np.linspace(0.0, fast, cells // 2 + 1)
    every, crashed = (np.histogram2d(gap, closing, edges, weights=w)[0].T for w in (weight, weight * crash))
    shares = np.divide(crashed, every, out=np.full_like(every, -1.0), where=every > 0.0)
    figure = new_figure(FULL_WIDTH_IN, 3.5)
    axes = figure.subplots()
    for low, (high, colour) in zip((-0.5, *SHARES), SHARES.items(), strict=False):
        if (here := (shares > low) & (shares <= high)).any():
            rows_here, columns_here = np.nonzero(here)
            area, label = (
                _cells_path(rows_here, columns_here, *edges[::-1]),
                f"≤ {share(high)}" if high else "tested, none",
            )
            axes.add_patch(PathPatch(area, facecolor=colour, edgecolor="none", label=label))
    known = environment is not None and not environment.lateral.present
    lines = limits_of_others(environment, summary, fast) if environment is not None and known else {}
    for (name, (speeds, gaps)), colour, style in zip(lines.items(), (INK, BLUE), ("-", (0, (4, 2))), strict=False):
        axes.plot(gaps, speeds, color=colour, linestyle=style, label=f"{name}’s limit")
    axes.set(xlim=(0.0, far), ylim=(0.0, fast), xlabel="gap at the cut-in, m", ylabel="closing speed, m/s")
    head(axes, "Share of cut-ins that crash")
    text = (
        f"Each of {count(cut_in.sum())} cut-ins by its gap and closing speed; {count(crash.sum())} of them crashed. "
        "White: not tested."
    )
    if lines:
        text += (
            " Left of its line the competent driver (r157-cc), or the best of brakes (8 m/s² at once), crashes in the "
            "vehicle’s place, too, if the car that cuts in keeps its speed."
        )
    return Plot("where", figure, text, text)


def limits_of_others(
    environment: Environment, summary: RunSummary, fastest_mps: float
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Closing speeds (m/s), and the smallest gap (m) at which each of `OTHERS` avoids a crash, BV keeping its speed."""
    speeds, gaps = np.linspace(0.5, fastest_mps, 40), np.linspace(0.25, 60.0, 240)
    speed, gap = (each.ravel() for each in np.meshgrid(speeds, gaps, indexing="ij"))
    n, draws = speed.size, int(environment.numbers["max_steps"] // environment.numbers["hold_steps"]) + 1
    v_bv = np.full(n, float(np.median(summary.rows["v_bv_mps"])))
    state = states_from((v_bv, np.full(n, 200.0), np.zeros(n), gap, -speed))
    maneuvers = np.full((n, draws + 1), KEEPS_SPEED, np.int8)
    bv = maneuvers.copy()
    bv[:, 1] = CUT_IN
    used, none = np.full(n, draws), np.zeros(n, np.int64)
    script = Script(maneuvers, bv, used, used + 1, none)
    stored = StoredPaths(0, none, state, none, none, script)
    end, start = np.zeros((n, len(OTHERS)), np.int64), np.full((n, 2), np.nan)
    drivers = library_records([driver for _, driver in OTHERS.values()], see_onset=False)
    path = unboxed(empty_trajectory(environment))
    drive_others(unboxed(stored), start, unboxed(environment), drivers, path, end, np.zeros((0, 0, 0)))
    crashes = (end >= 0).reshape(speeds.size, gaps.size, len(OTHERS))
    last = np.where(crashes.any(1), gaps[gaps.size - 1 - np.argmax(crashes[:, ::-1], axis=1)], 0.0)
    return {name: (speeds, last[:, d]) for d, name in enumerate(OTHERS)}


def _cells_path(rows: IntArray, columns: IntArray, y: FloatArray, x: FloatArray) -> Path:
    """One compound path of all cells, neighbours in a row merged into one rectangle."""
    starts = np.flatnonzero(np.r_[True, (np.diff(rows) != 0) | (np.diff(columns) != 1)])
    ends = np.r_[starts[1:], rows.size] - 1
    left, right = x[columns[starts]], x[columns[ends] + 1]
    low, high = y[rows[starts]], y[rows[starts] + 1]
    corners = np.array([[left, low], [right, low], [right, high], [left, high]])
    return Path.make_compound_path_from_polys(corners.transpose(2, 0, 1))
