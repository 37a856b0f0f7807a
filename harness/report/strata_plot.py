"""Crashes by stratum: after how many control steps they come, and what each stratum contributes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from harness.report.fine_histogram import Bins, Floats
from harness.report.number_format import percent
from harness.report.plot_style import FULL_WIDTH_IN, GREY, VERMILLION, Plot, new_figure, only_horizontal_grid
from harness.report.summary import RunSummary

MOST_BINS = 40


def strata_plot(summary: RunSummary) -> Plot | None:
    """Draw sampled crashes and share of the estimate per number of control steps; None unless there are several."""
    used = summary.stratum_crash.used()
    if used is None or used[1] - used[0] == 1:
        return None
    bins = summary.stratum_crash.bins(MOST_BINS)
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    counted, weighted = figure.subplots(1, 2, sharex=True)
    share = bins.weight / bins.weight.sum() if bins.weight.sum() > 0.0 else bins.weight
    _draw_bars(counted, bins, bins.count, GREY, "Sampled crashes", "crashes")
    counted.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True, steps=[1, 2, 5, 10]))
    _draw_bars(weighted, bins, 100.0 * share, VERMILLION, "Share of the estimate", "share, %")
    top = int(np.argmax(share))
    where = _steps(bins, top)
    alt = f"Bars of crashes by number of control steps; {where} control steps carry most, {percent(float(share[top]))}."
    caption = (
        "Left, how many crashes were sampled after how many control steps; right, how much of the crash rate they "
        f"stand for. Most comes from {where} control steps ({percent(float(share[top]))}). A stratum that is high on "
        "the right but low on the left is where more tests would help most."
    )
    return Plot("strata", figure, alt, caption)


def _draw_bars(axes: Axes, bins: Bins, heights: Floats, colour: str, title: str, label: str) -> None:
    width = float(bins.edges[1] - bins.edges[0])
    axes.bar(bins.edges[:-1] + 0.5 * width, heights, width=0.86 * width, color=colour)
    axes.set_title(title)
    axes.set_ylabel(label)
    axes.set_xlabel("control steps in the test")
    axes.xaxis.set_major_locator(MaxNLocator(nbins=9, integer=True, steps=[1, 2, 5, 10]))
    axes.set_xlim(float(bins.edges[0]) - 0.2, float(bins.edges[-1]) + 0.2)
    only_horizontal_grid(axes)


def _steps(bins: Bins, index: int) -> str:
    first, last = round(bins.edges[index] + 0.5), round(bins.edges[index + 1] - 0.5)
    return f"{first}" if first == last else f"{first} to {last}"
