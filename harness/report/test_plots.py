"""What tests were like: weights, control steps before a crash, cut-ins, how hard and how soon the AV crashes."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator

from harness.numbers import count, number, power_of_ten, share
from harness.report.style import (
    BLUES,
    FULL_WIDTH_IN,
    GREY,
    MUTED,
    REDS,
    VERMILLION,
    Plot,
    head,
    log_axis,
    new_figure,
    only_horizontal_grid,
    two_panels,
)
from harness.report.summary import RunSummary
from harness.vocabulary import CRASH, FAILED, FloatArray, IntArray

WEIGHT_BINS, STRATUM_BINS, CRASH_BINS = 70, 40, 36
R2DOT_MPS, R2_M = np.arange(-30.0, 20.5, 0.5), np.arange(0.0, 152.5, 2.5)
"""Edges of the cells of maps; a cut-in beyond them is counted in the outermost cell."""
LEVELS_PER_DECADE = 2
"""Each colour step is a factor √10, so that six colours span three decades below the fullest cell."""
TTC_LINES_S = (1.0, 2.0, 4.0, 8.0)


class Bins(NamedTuple):
    """``edges`` (n+1) in the variable's unit, counts (n), and shares of the sum of weights (n) in per cent."""

    edges: FloatArray
    counts: FloatArray
    shares: FloatArray


def binned(values: FloatArray, weights: FloatArray, edges: FloatArray) -> Bins:
    """Values (n,) that are finite in bins, those on an edge in the upper one."""
    known = np.isfinite(values)
    values, weights, lower = values[known], weights[known], edges - 1e-9 * (edges[1] - edges[0])
    counts, sums = np.histogram(values, lower)[0].astype(np.float64), np.histogram(values, lower, weights=weights)[0]
    return Bins(edges, counts, _percent(sums))


def edges_for(values: FloatArray, width: float, most: int) -> FloatArray:
    """Edges of about ``most`` bins that hold all values, multiples of the width times 1, 2 or 5 and powers of ten."""
    ends = (values.min(), values.max()) if values.size else (0.0, 0.0)
    # A value such as 0.3 on bins of 0.1 must not fall below its edge by rounding.
    first, last = (math.floor(end / width + 1e-9) for end in ends)
    return width * np.asarray(MaxNLocator(most, steps=[1, 2, 5, 10], integer=True).tick_values(first, last + 1))


def weighted_quantile(values: FloatArray, weights: FloatArray, quantile: float) -> float:
    """Value up to which this share of the weight lies; NaN without weight."""
    if not weights.any():
        return math.nan
    return float(np.quantile(values, quantile, method="inverted_cdf", weights=weights))


def _percent(values: FloatArray) -> FloatArray:
    total = float(values.sum())
    return 100.0 * values / total if total > 0.0 else values


def weight_plot(summary: RunSummary) -> Plot | None:
    """Draw counts of log10 weights (all tests, crashes) and share of the estimate; None when every weight is one."""
    if summary.all_weights_one:
        return None
    rows, crashes = summary.rows, summary.crashes
    valid = rows["outcome"] != FAILED
    log10 = rows["log_weight"][valid] / math.log(10.0)
    edges = edges_for(log10, 0.02, WEIGHT_BINS)
    everything = binned(log10, rows["weight"][valid], edges)
    crashed = binned(crashes["log_weight"] / math.log(10.0), crashes["weight"], edges)
    figure = new_figure(FULL_WIDTH_IN, 4.2 if summary.n_crashes else 2.7)
    upper, *lower = figure.subplots(2 if summary.n_crashes else 1, 1, sharex=True, squeeze=False)[:, 0]
    # Crashes are drawn over all tests, of which they are a part.
    for bins, colour, label in ((everything, GREY, "all tests"), (crashed, VERMILLION, "crashes")):
        if bins.counts.any():
            upper.stairs(bins.counts, bins.edges, baseline=0.5, fill=True, color=colour, label=label)
    log_axis(upper.yaxis, 0.5, 2.0 * max(float(everything.counts.max()), 1.0))
    upper.set_ylabel("tests per bin")
    head(upper, "How often each weight occurs")
    for axes in lower:
        axes.stairs(crashed.shares, edges, fill=True, color=VERMILLION)
        axes.set_ylim(0.0, 1.15 * max(float(crashed.shares.max()), 1e-9))
        axes.set_ylabel("share, %")
        axes.set_title("What each weight contributes to the estimate")
    last = (upper, *lower)[-1]
    last.xaxis.set_major_formatter(lambda value, _: power_of_ten(round(value)) if value == round(value) else "")
    last.xaxis.set_major_locator(MaxNLocator(nbins=12, integer=True))
    last.set_xlabel("likelihood ratio (weight) of a test")
    alt = (
        f"Histogram of weights from 10^{log10.min():.1f} to 10^{log10.max():.1f}, all tests and crashes, on a "
        "logarithmic axis."
    )
    return Plot("weights", figure, alt, _weight_caption(crashed))


def _weight_caption(crashed: Bins) -> str:
    if not crashed.counts.any():
        return "Weights of all tests. There was no crash, so none of them contributes to the estimate."
    last = np.flatnonzero(crashed.counts)[-1]
    return (
        "Sound sampling has the two panels overlap: the weights that carry the estimate (below) are also the ones that "
        "crashes often have (above, orange). A contribution far to the right of the bulk of crashes rests on few "
        f"tests. Here the rightmost bin with a crash holds {count(crashed.counts[last])} of "
        f"{count(crashed.counts.sum())} crashes and {share(crashed.shares[last] / 100.0)} of the estimate."
    )


def strata_plot(summary: RunSummary) -> Plot | None:
    """Draw sampled crashes and share of the estimate per number of control steps; None unless there are several."""
    crashes = summary.crashes
    steps = crashes["n_control_steps"]
    if np.unique(steps).size < 2:
        return None
    bins = binned(steps, crashes["weight"], edges_for(steps, 1.0, STRATUM_BINS))
    labels = ("control steps in the test",) * 2
    figure, sampled, weighted = two_panels(2.9, labels, sharex=True)
    width = float(bins.edges[1] - bins.edges[0])
    for axes, heights, colour, title, label in (
        (sampled, bins.counts, GREY, "Sampled crashes", "crashes"),
        (weighted, bins.shares, VERMILLION, "Share of the estimate", "share, %"),
    ):
        axes.bar(bins.edges[:-1] - 0.5 + 0.5 * width, heights, width=0.86 * width, color=colour)
        axes.set_title(title)
        axes.set_ylabel(label)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=9, integer=True, steps=[1, 2, 5, 10]))
        only_horizontal_grid(axes)
    sampled.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True, steps=[1, 2, 5, 10]))
    top = int(np.argmax(bins.shares))
    first, last = round(bins.edges[top]), round(bins.edges[top + 1]) - 1
    where, most = f"{first}" if first == last else f"{first} to {last}", share(bins.shares[top] / 100.0)
    alt = f"Bars of crashes by number of control steps; {where} control steps carry most, {most}."
    caption = (
        "Left, how many crashes were sampled after how many control steps; right, how much of the crash rate they "
        f"stand for. Most comes from {where} control steps ({most}). A stratum that is high on "
        "the right but low on the left is where more tests would help most."
    )
    return Plot("strata", figure, alt, caption)


def impact_speed_plot(summary: RunSummary) -> Plot | None:
    """Histogram of impact speeds, weighted and sampled; None without crashes."""
    if summary.n_crashes == 0:
        return None
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    axes, crashes = figure.subplots(), summary.crashes
    axes.set_xlabel("impact speed v_AV − v_BV, m/s")
    _draw_crashes(axes, summary, crashes["impact_speed_mps"], "")
    median, high = (weighted_quantile(crashes["impact_speed_mps"], crashes["weight"], q) for q in (0.5, 0.95))
    text = "no crash has a weight above zero"
    if not math.isnan(median):
        text = (
            f"weighted to naturalistic driving, half of the crashes are below {median:.1f} m/s "
            f"({3.6 * median:.0f} km/h) and 95 % below {high:.1f} m/s ({3.6 * high:.0f} km/h)"
        )
    caption = f"{_crash_legend(summary)} Here, {text}."
    return Plot("impact_speed", figure, f"Histogram of impact speeds; {text}.", caption)


def crash_time_plot(summary: RunSummary) -> Plot | None:
    """Histograms of the time from cut-in to crash and of the time of the crash; None without crashes."""
    if summary.n_crashes == 0:
        return None
    crashes = summary.crashes
    figure, left, right = two_panels(2.9, ("from cut-in to crash, s", "from start of the test, s"))
    _draw_crashes(left, summary, crashes["response_s"], "Time to crash after the cut-in")
    _draw_crashes(right, summary, crashes["crash_time_s"], "Time of the crash in the test")
    median_s = weighted_quantile(crashes["response_s"], crashes["weight"], 0.5)
    median = "" if math.isnan(median_s) else f" (weighted median {median_s:.1f} s)"
    caption = (
        f"{_crash_legend(summary)} Left, the time that the AV had between the "
        f"cut-in and the crash{median}: short times leave no controller a chance, long ones point to its braking. "
        "Right, when crashes come: a pile-up at the end of the test would mean that its length cuts crashes off."
    )
    return Plot("crash_time", figure, f"Histograms of time to crash for {count(summary.n_crashes)} crashes.", caption)


def _draw_crashes(axes: Axes, summary: RunSummary, values: FloatArray, title: str) -> None:
    bins = binned(values, summary.crashes["weight"], edges_for(values[np.isfinite(values)], 0.1, CRASH_BINS))
    axes.stairs(
        bins.shares, bins.edges, fill=True, color=VERMILLION, alpha=0.85,
        label=None if summary.all_weights_one else "weighted (share of the rate)",
    )  # fmt: skip
    if not summary.all_weights_one:
        axes.stairs(_percent(bins.counts), bins.edges, color=GREY, linewidth=1.4, label="as sampled")
    axes.set_xlim(float(bins.edges[0]), float(bins.edges[-1]))
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_ylabel("share of crashes, %")
    only_horizontal_grid(axes)
    head(axes, title)


def _crash_legend(summary: RunSummary) -> str:
    if summary.all_weights_one:
        return "Share of crashes; tests are naturalistic driving itself, all with weight 1."
    return "Filled: share of the crash rate; outline: crashes as sampled."


def cut_in_plot(summary: RunSummary) -> Plot | None:
    """Maps of (R2, R2dot) at the cut-in, as sampled and as weighted; None when BV never cut in."""
    rows = summary.rows
    cut_in = np.isfinite(rows["cut_in_r2_m"]) & np.isfinite(rows["cut_in_r2dot_mps"]) & (rows["outcome"] != FAILED)
    crash = cut_in & (rows["outcome"] == CRASH)
    if not cut_in.any():
        return None
    maps = []
    for which, ramp, title in ((cut_in, BLUES, "Cut-ins"), (crash, REDS, "Cut-ins that crash")):
        r2dot_mps, r2_m = (
            np.clip(rows["cut_in_r2dot_mps"][which], -30.0, 19.9),
            np.clip(rows["cut_in_r2_m"][which], 0.0, 149.9),
        )
        edges = [R2DOT_MPS - 1e-9, R2_M - 1e-9]
        sampled, _, _ = np.histogram2d(r2dot_mps, r2_m, bins=edges)
        weighted, _, _ = np.histogram2d(r2dot_mps, r2_m, bins=edges, weights=rows["weight"][which])
        if summary.all_weights_one:
            maps.append((sampled, ramp, title))
        elif which is cut_in or crash.any():
            maps += [(sampled, ramp, f"{title}, sampled"), (weighted, ramp, f"{title}, weighted")]
    used = tuple(slice(int(i.min()), int(i.max()) + 2) for i in np.nonzero(maps[0][0]))
    cells = tuple(slice(of.start, of.stop - 1) for of in used)
    figure = new_figure(FULL_WIDTH_IN, 1.5 * len(maps) + 0.4)
    panels = figure.subplots(len(maps) // 2, 2, sharex=True, sharey=True, squeeze=False)
    for axes, (values, ramp, title) in zip(panels.flat, maps, strict=True):
        _draw_map(axes, values[cells], R2DOT_MPS[used[0]], R2_M[used[1]], ramp)
        axes.set_title(title)
    for axes in panels[:, 0]:
        axes.set_ylabel("R2dot at the cut-in, m/s")
    for axes in panels[-1]:
        axes.set_xlabel("R2 at the cut-in, m")
    _add_key(figure, [ramp for ramp in (BLUES, REDS) if any(shown is ramp for _, shown, _ in maps)])
    alt = (
        f"Maps of gap R2 against its rate R2dot at the cut-in: {count(cut_in.sum())} cut-ins, {count(crash.sum())} of "
        f"them crashed. Panels: {', '.join(title for _, _, title in maps)}."
    )
    return Plot("cut_ins", figure, alt, _cut_in_caption(summary, float(rows["weight"][cut_in].sum())))


def _draw_map(axes: Axes, values: FloatArray, r2dot_mps: FloatArray, r2_m: FloatArray, ramp: tuple[str, ...]) -> None:
    """Fill the cells of each level as one path: small files, no seams, and colours that can follow the page."""
    top = float(values.max(initial=0.0)) or 1.0
    with np.errstate(divide="ignore"):
        below = np.floor(-np.log10(values / top) * LEVELS_PER_DECADE)
    level = np.where(values > 0.0, np.maximum(len(ramp) - 1 - below, 0), -1.0)
    for index, colour in enumerate(ramp):
        rows, columns = np.nonzero(level == index)
        if rows.size:
            axes.add_patch(PathPatch(_cells_path(rows, columns, r2dot_mps, r2_m), facecolor=colour, edgecolor="none"))
    axes.set_xlim(float(r2_m[0]), float(r2_m[-1]))
    axes.set_ylim(float(r2dot_mps[0]), float(r2dot_mps[-1]))
    r2, r2dot = np.meshgrid(np.linspace(*axes.get_xlim(), 200), np.linspace(*axes.get_ylim(), 200))
    with np.errstate(divide="ignore", invalid="ignore"):
        ttc_s = np.where(r2dot < 0.0, -r2 / r2dot, np.inf)
    style: dict[str, Any] = {"colors": MUTED, "linewidths": 0.8, "linestyles": "dashed"}
    lines = axes.contour(r2, r2dot, np.minimum(ttc_s, 2.0 * TTC_LINES_S[-1]), levels=TTC_LINES_S, **style)
    axes.clabel(lines, fmt="%g s", fontsize=8)


def _cells_path(rows: IntArray, columns: IntArray, r2dot_mps: FloatArray, r2_m: FloatArray) -> Path:
    """One compound path of all cells, neighbours in a row merged into one rectangle."""
    starts = np.flatnonzero(np.r_[True, (np.diff(rows) != 0) | (np.diff(columns) != 1)])
    ends = np.r_[starts[1:], rows.size] - 1
    left, right = r2_m[columns[starts]], r2_m[columns[ends] + 1]
    low, high = r2dot_mps[rows[starts]], r2dot_mps[rows[starts] + 1]
    corners = np.array([[left, low], [right, low], [right, high], [left, high]])
    return Path.make_compound_path_from_polys(corners.transpose(2, 0, 1))


def _add_key(figure: Figure, ramps: list[tuple[str, ...]]) -> None:
    """Add one legend row per colour ramp, with the labels in the last."""
    n = len(BLUES)
    labels = ["less", *(f"over 1/{10 ** ((n - level) / LEVELS_PER_DECADE):.0f}" for level in range(1, n))]
    # Legends fill column by column.
    patches = [
        Patch(facecolor=ramp[level], edgecolor="none", label=labels[level] if ramp is ramps[-1] else " ")
        for level in range(n)
        for ramp in ramps
    ]
    title = "cell, relative to the fullest cell of its map"
    style = {"fontsize": 8, "title_fontsize": 8, "labelcolor": MUTED, "handlelength": 1.8, "columnspacing": 1.2}
    figure.legend(handles=patches, loc="outside lower center", title=title, ncols=n, **style)


def _cut_in_caption(summary: RunSummary, weight: float) -> str:
    per_test = number(summary.per_test(weight))
    text = "Gap R2 and its rate R2dot (BV minus AV) when BV cuts in. "
    if summary.all_weights_one:
        text += f"Tests are naturalistic driving itself; there are {per_test} cut-ins per test."
    else:
        weighted, of_shells = "weighted by their likelihood ratio", "with each shell counted by its probability"
        how = of_shells if summary.from_shells else weighted
        text += (
            f"Left, where the tests went; right, the same cut-ins {how}, as they occur in naturalistic driving "
            f"({per_test} per test)."
        )
    text += " Dashed lines: equal time to collision. Colours step by a factor √10 below each map's fullest cell."
    if not summary.n_crashes:
        return text + " None of them crashed."
    return text if summary.all_weights_one else text + " The lower right map is where the crash rate comes from."
