"""Histograms of a run: likelihood ratios, control steps before a crash, and how hard and how soon the AV crashes."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from harness.report.histograms import Bins, FineHistogram
from harness.report.number_format import count, percent, power_of_ten
from harness.report.plot_style import (
    FULL_WIDTH_IN,
    GREY,
    MUTED,
    VERMILLION,
    Plot,
    decades,
    new_figure,
    only_horizontal_grid,
)
from harness.report.summary import RunSummary
from harness.vocabulary import FloatArray

WEIGHT_BINS, STRATUM_BINS, CRASH_BINS = 70, 40, 36


def _shares(values: FloatArray) -> FloatArray:
    """Per cent of the sum; zeros where that is zero."""
    total = float(values.sum())
    return 100.0 * values / total if total > 0.0 else values


def weight_plot(summary: RunSummary) -> Plot | None:
    """Draw counts of log10 weights (all tests, crashes) and share of the estimate; None when every weight is one."""
    used = summary.log10_weight.used()
    if used is None or summary.all_weights_one:
        return None
    everything, crashes = (h.bins(WEIGHT_BINS, *used) for h in (summary.log10_weight, summary.log10_weight_crash))
    has_crashes = summary.n_crashes > 0
    figure = new_figure(FULL_WIDTH_IN, 4.2 if has_crashes else 2.7)
    panels = figure.subplots(2 if has_crashes else 1, 1, sharex=True, squeeze=False)[:, 0]
    _draw_weights(panels[0], everything, crashes)
    if has_crashes:
        _draw_weight_shares(panels[1], crashes)
    panels[-1].xaxis.set_major_formatter(lambda value, _: power_of_ten(round(value)) if value == round(value) else "")
    panels[-1].xaxis.set_major_locator(MaxNLocator(nbins=12, integer=True))
    panels[-1].set_xlabel("likelihood ratio (weight) of a test")
    low, high = (value / np.log(10.0) for value in summary.log_weight_range)
    alt = f"Histogram of weights from 10^{low:.1f} to 10^{high:.1f}, all tests and crashes, on a logarithmic axis."
    return Plot("weights", figure, alt, _weight_caption(crashes, has_crashes))


def _draw_weights(axes: Axes, everything: Bins, crashes: Bins) -> None:
    # Crashes are drawn over all tests, of which they are a part.
    for bins, colour, label in ((everything, GREY, "all tests"), (crashes, VERMILLION, "crashes")):
        if bins.counts.any():
            axes.stairs(bins.counts, bins.edges, baseline=0.5, fill=True, color=colour, label=label)
    axes.set_yscale("log")
    axes.set_ylim(0.5, 12.0 * max(float(everything.counts.max()), 1.0))
    decades(axes.yaxis, *axes.get_ylim())
    axes.set_ylabel("tests per bin")
    axes.set_title("How often each weight occurs")
    axes.legend(loc="upper left", fontsize=8, labelcolor=MUTED, ncols=2)


def _draw_weight_shares(axes: Axes, crashes: Bins) -> None:
    share = _shares(crashes.weights)
    axes.stairs(share, crashes.edges, fill=True, color=VERMILLION)
    axes.set_ylim(0.0, 1.15 * max(float(share.max()), 1e-9))
    axes.set_ylabel("share, %")
    axes.set_title("What each weight contributes to the estimate")


def _weight_caption(crashes: Bins, has_crashes: bool) -> str:
    if not has_crashes:
        return "Weights of all tests. There was no crash, so none of them contributes to the estimate."
    last = np.flatnonzero(crashes.counts)[-1]
    return (
        "Sound sampling has the two panels overlap: the weights that carry the estimate (below) are also the ones that "
        "crashes often have (above, orange). A contribution far to the right of the bulk of crashes rests on few "
        f"tests. Here the rightmost bin with a crash holds {count(crashes.counts[last])} of "
        f"{count(crashes.counts.sum())} crashes and {percent(_shares(crashes.weights)[last] / 100.0)} of the estimate."
    )


def strata_plot(summary: RunSummary) -> Plot | None:
    """Draw sampled crashes and share of the estimate per number of control steps; None unless there are several."""
    used = summary.stratum_crash.used()
    if used is None or used[0].stop - used[0].start == 1:
        return None
    bins = summary.stratum_crash.bins(STRATUM_BINS)
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    sampled, weighted = figure.subplots(1, 2, sharex=True)
    share = _shares(bins.weights)
    _draw_strata(sampled, bins, bins.counts, GREY, "Sampled crashes", "crashes")
    sampled.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True, steps=[1, 2, 5, 10]))
    _draw_strata(weighted, bins, share, VERMILLION, "Share of the estimate", "share, %")
    top = int(np.argmax(share))
    first, last = round(bins.edges[top] + 0.5), round(bins.edges[top + 1] - 0.5)
    where, most = f"{first}" if first == last else f"{first} to {last}", percent(float(share[top]) / 100.0)
    alt = f"Bars of crashes by number of control steps; {where} control steps carry most, {most}."
    caption = (
        "Left, how many crashes were sampled after how many control steps; right, how much of the crash rate they "
        f"stand for. Most comes from {where} control steps ({most}). A stratum that is high on "
        "the right but low on the left is where more tests would help most."
    )
    return Plot("strata", figure, alt, caption)


def _draw_strata(axes: Axes, bins: Bins, heights: FloatArray, colour: str, title: str, label: str) -> None:
    width = float(bins.edges[1] - bins.edges[0])
    axes.bar(bins.edges[:-1] + 0.5 * width, heights, width=0.86 * width, color=colour)
    axes.set_title(title)
    axes.set_ylabel(label)
    axes.set_xlabel("control steps in the test")
    axes.xaxis.set_major_locator(MaxNLocator(nbins=9, integer=True, steps=[1, 2, 5, 10]))
    axes.set_xlim(float(bins.edges[0]) - 0.2, float(bins.edges[-1]) + 0.2)
    only_horizontal_grid(axes)


def impact_speed_plot(summary: RunSummary) -> Plot | None:
    """Histogram of impact speeds, weighted and sampled; None without crashes."""
    if summary.n_crashes == 0:
        return None
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    _draw_crashes(figure.subplots(), summary, summary.impact_speed_mps, "impact speed v_AV − v_BV, m/s", "")
    median, high = (summary.impact_speed_mps.weighted_quantile(share) for share in (0.5, 0.95))
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
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    left, right = figure.subplots(1, 2)
    _draw_crashes(left, summary, summary.response_time_s, "from cut-in to crash, s", "Time to crash after the cut-in")
    _draw_crashes(right, summary, summary.crash_time_s, "from start of the test, s", "Time of the crash in the test")
    median_s = summary.response_time_s.weighted_quantile(0.5)
    median = "" if math.isnan(median_s) else f" (weighted median {median_s:.1f} s)"
    caption = (
        f"{_crash_legend(summary)} Left, the time that the AV had between the "
        f"cut-in and the crash{median}: short times leave no controller a chance, long ones point to its braking. "
        "Right, when crashes come: a pile-up at the end of the test would mean that its length cuts crashes off."
    )
    return Plot("crash_time", figure, f"Histograms of time to crash for {count(summary.n_crashes)} crashes.", caption)


def _draw_crashes(axes: Axes, summary: RunSummary, histogram: FineHistogram, label: str, title: str) -> None:
    bins = histogram.bins(CRASH_BINS)
    weighted, sampled = _shares(bins.weights), _shares(bins.counts)
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


def _crash_legend(summary: RunSummary) -> str:
    if summary.all_weights_one:
        return "Share of crashes; tests are naturalistic driving itself, all with weight 1."
    return "Filled: share of the crash rate; outline: crashes as sampled."
