"""How hard and how soon the AV crashes."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes

from harness.report.fine_histogram import FineHistogram, Floats
from harness.report.number_format import count
from harness.report.plot_style import FULL_WIDTH_IN, GREY, MUTED, VERMILLION, Plot, new_figure, only_horizontal_grid
from harness.report.summary import RunSummary

MOST_BINS = 36


def impact_speed_plot(summary: RunSummary) -> Plot | None:
    """Histogram of impact speeds, weighted and sampled; None without crashes."""
    if summary.n_crashes == 0:
        return None
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    axes = figure.subplots()
    _draw_shares(axes, summary, summary.impact_speed_mps, "impact speed v_AV − v_BV, m/s", "")
    median, high = (summary.impact_speed_mps.weighted_quantile(share) for share in (0.5, 0.95))
    text = "no crash has a weight above zero"
    if not math.isnan(median):
        text = (
            f"weighted to naturalistic driving, half of the crashes are below {median:.1f} m/s "
            f"({3.6 * median:.0f} km/h) and 95 % below {high:.1f} m/s ({3.6 * high:.0f} km/h)"
        )
    caption = f"{_legend(summary)} Here, {text}."
    return Plot("impact_speed", figure, f"Histogram of impact speeds; {text}.", caption)


def crash_time_plot(summary: RunSummary) -> Plot | None:
    """Histograms of the time from cut-in to crash and of the time of the crash; None without crashes."""
    if summary.n_crashes == 0:
        return None
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    since_cut_in, in_test = figure.subplots(1, 2)
    _draw_shares(
        since_cut_in, summary, summary.response_time_s, "from cut-in to crash, s", "Time to crash after the cut-in"
    )
    _draw_shares(in_test, summary, summary.crash_time_s, "from start of the test, s", "Time of the crash in the test")
    median_s = summary.response_time_s.weighted_quantile(0.5)
    alt = f"Histograms of time to crash for {count(summary.n_crashes)} crashes."
    median = "" if math.isnan(median_s) else f" (weighted median {median_s:.1f} s)"
    caption = (
        f"{_legend(summary)} Left, the time that the AV had between the "
        f"cut-in and the crash{median}: short times leave no controller a chance, long ones point to its braking. "
        "Right, when crashes come: a pile-up at the end of the test would mean that its length cuts crashes off."
    )
    return Plot("crash_time", figure, alt, caption)


def _draw_shares(axes: Axes, summary: RunSummary, histogram: FineHistogram, label: str, title: str) -> None:
    bins = histogram.bins(MOST_BINS)
    weighted, sampled = _shares(bins.weight), _shares(bins.count)
    axes.stairs(weighted, bins.edges, fill=True, color=VERMILLION, alpha=0.85, label="weighted (share of the rate)")
    if not summary.all_weights_one:
        axes.stairs(sampled, bins.edges, color=GREY, linewidth=1.4, label="as sampled")
        axes.legend(loc="upper right", fontsize=8, labelcolor=MUTED)
    axes.set_ylim(0.0, 1.3 * max(float(np.max(weighted)), float(np.max(sampled)), 1e-9))
    axes.set_xlim(float(bins.edges[0]), float(bins.edges[-1]))
    axes.set_xlabel(label)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_ylabel("share of crashes, %")
    axes.set_title(title)
    only_horizontal_grid(axes)


def _legend(summary: RunSummary) -> str:
    if summary.all_weights_one:
        return "Share of crashes; tests are naturalistic driving itself, all with weight 1."
    return "Filled: share of the crash rate; outline: crashes as sampled."


def _shares(values: Floats) -> Floats:
    total = float(values.sum())
    return 100.0 * values / total if total > 0.0 else values
