"""Distribution of the likelihood ratios: which weights occur, and which ones carry the estimate."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from harness.report.fine_histogram import Bins
from harness.report.number_format import count, percent, power_of_ten
from harness.report.plot_style import FULL_WIDTH_IN, GREY, MUTED, VERMILLION, Plot, new_figure
from harness.report.rate_axis import decades
from harness.report.summary import RunSummary

MOST_BINS = 70


def weight_plot(summary: RunSummary) -> Plot | None:
    """Draw counts of log10 weights (all tests, crashes) and share of the estimate; None when every weight is one."""
    used = summary.log10_weight.used()
    if used is None or summary.all_weights_one:
        return None
    everything = summary.log10_weight.bins(MOST_BINS, used)
    crashes = summary.log10_weight_crash.bins(MOST_BINS, used)
    has_crashes = summary.n_crashes > 0
    figure = new_figure(FULL_WIDTH_IN, 4.2 if has_crashes else 2.7)
    panels = figure.subplots(2 if has_crashes else 1, 1, sharex=True, squeeze=False)[:, 0]
    _draw_counts(panels[0], everything, crashes)
    if has_crashes:
        _draw_shares(panels[1], crashes)
    panels[-1].xaxis.set_major_formatter(lambda value, _: power_of_ten(round(value)) if value == round(value) else "")
    panels[-1].xaxis.set_major_locator(MaxNLocator(nbins=12, integer=True))
    panels[-1].set_xlabel("likelihood ratio (weight) of a test")
    low, high = (value / np.log(10.0) for value in summary.weights_seen)
    alt = f"Histogram of weights from 10^{low:.1f} to 10^{high:.1f}, all tests and crashes, on a logarithmic axis."
    return Plot("weights", figure, alt, _caption(crashes, has_crashes))


def _draw_counts(axes: Axes, everything: Bins, crashes: Bins) -> None:
    # Crashes are drawn over all tests, of which they are a part.
    for bins, colour, label in ((everything, GREY, "all tests"), (crashes, VERMILLION, "crashes")):
        if bins.count.any():
            axes.stairs(bins.count, bins.edges, baseline=0.5, fill=True, color=colour, label=label)
    axes.set_yscale("log")
    axes.set_ylim(0.5, 12.0 * max(float(everything.count.max()), 1.0))
    decades(axes.yaxis, *axes.get_ylim())
    axes.set_ylabel("tests per bin")
    axes.set_title("How often each weight occurs")
    axes.legend(loc="upper left", fontsize=8, labelcolor=MUTED, ncols=2)


def _draw_shares(axes: Axes, crashes: Bins) -> None:
    total = float(crashes.weight.sum())
    share = 100.0 * crashes.weight / total if total > 0.0 else crashes.weight
    axes.stairs(share, crashes.edges, fill=True, color=VERMILLION)
    axes.set_ylim(0.0, 1.15 * max(float(share.max()), 1e-9))
    axes.set_ylabel("share, %")
    axes.set_title("What each weight contributes to the estimate")


def _caption(crashes: Bins, has_crashes: bool) -> str:
    if not has_crashes:
        return "Weights of all tests. There was no crash, so none of them contributes to the estimate."
    total = float(crashes.weight.sum())
    filled = np.flatnonzero(crashes.count)
    tail = float(crashes.weight[filled[-1]]) / total if total > 0.0 else 0.0
    return (
        "Sound sampling has the two panels overlap: the weights that carry the estimate (below) are also the ones that "
        "crashes often have (above, orange). A contribution far to the right of the bulk of crashes rests on few "
        f"tests. Here the rightmost bin with a crash holds {count(crashes.count[filled[-1]])} of "
        f"{count(crashes.count.sum())} crashes and {percent(tail)} of the estimate."
    )
