"""The quantities that tell crashes from other tests: their distributions among both, with the telling band marked."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from harness.report.crash_contrast import Contrast
from harness.report.cut_in_conditions import CONDITIONS
from harness.report.fine_histogram import Floats
from harness.report.number_format import count
from harness.report.plot_style import FULL_WIDTH_IN, GREY, MUTED, VERMILLION, Plot, new_figure, only_horizontal_grid
from harness.report.telling_bands import Band

PANELS = 3
BARS = 40
TICKED_CRASHES = 60
"""Up to so many crashes each get a mark of their own below the bars."""
OTHERS_SHOWN, CRASHES_SHOWN = (0.005, 0.995), (0.25, 0.75)
"""Quantiles that a panel reaches at least; of crashes fewer, because some need a braking of hundreds of m/s²."""


def contrast_plot(contrast: Contrast) -> Plot | None:
    """Draw one panel for each of the most telling quantities; None where none stands out."""
    bands = contrast.telling[:PANELS]
    if not bands:
        return None
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    panels = figure.subplots(1, max(len(bands), 2), squeeze=False)[0]
    for axes, band in zip(panels, bands, strict=False):
        _draw(axes, contrast, band)
    for axes in panels[len(bands) :]:
        axes.set_visible(False)
    panels[0].set_ylabel("share, %")
    panels[0].legend(loc="upper left", fontsize=8, labelcolor=MUTED, bbox_to_anchor=(0.0, 1.0))
    names = ", ".join(CONDITIONS[band.quantity].name for band in bands)
    alt = f"Histograms among crashes and among tests without a crash: {names}. {contrast.sentence}"
    ticks = " Each mark at the foot is a crash." if contrast.n_crashes <= TICKED_CRASHES else ""
    ticks += " What lies beyond a panel counts in its outermost bar."
    weighted = "" if contrast.outside else " Both are weighted to naturalistic driving."
    caption = (
        f"Orange: {count(contrast.n_crashes)} crashes; grey: {count(contrast.n_others)} tests without one. Shaded: the "
        f"band in which crashes are most over-represented.{weighted}{ticks}"
    )
    return Plot("contrast", figure, alt, caption)


def _draw(axes: Axes, contrast: Contrast, band: Band) -> None:
    crashes, others = contrast.crashes[band.quantity], contrast.others[band.quantity]
    edges = np.linspace(*_range(crashes, others, band), BARS + 1)
    axes.axvspan(max(band.low, edges[0]), min(band.high, edges[-1]), color=VERMILLION, alpha=0.15, linewidth=0)
    axes.stairs(
        _shares(others, contrast.other_weight, edges), edges, fill=True, color=GREY, alpha=0.6, label="no crash"
    )
    axes.stairs(_shares(crashes, contrast.crash_weight, edges), edges, color=VERMILLION, linewidth=1.5, label="crash")
    if contrast.n_crashes <= TICKED_CRASHES:
        seen = np.clip(crashes, edges[0], edges[-1])
        axes.plot(seen, np.zeros_like(seen), "|", color=VERMILLION, markersize=7, clip_on=False)
    axes.set_xlim(float(edges[0]), float(edges[-1]))
    axes.set_ylim(0.0, 1.35 * axes.get_ylim()[1])
    condition = CONDITIONS[band.quantity]
    axes.set_xlabel(f"{condition.name}, {condition.unit}")
    only_horizontal_grid(axes)


def _range(crashes: Floats, others: Floats, band: Band) -> tuple[float, float]:
    """From and to which value a panel shows: nearly all tests without a crash, most crashes, and the band."""
    ends = [end for end in (band.low, band.high) if np.isfinite(end)]
    for values, shown in ((others, OTHERS_SHOWN), (crashes, CRASHES_SHOWN)):
        known = values[np.isfinite(values)]
        if known.size:
            ends += np.quantile(known, shown).tolist()
    low, high = min(ends), max(ends)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _shares(values: Floats, weight: Floats, edges: Floats) -> Floats:
    known = ~np.isnan(values)
    held, _ = np.histogram(np.clip(values[known], edges[0], edges[-1]), edges, weights=weight[known])
    return 100.0 * held / max(float(weight.sum()), np.finfo(float).tiny)
