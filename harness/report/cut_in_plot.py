"""Where in (R2, R2dot) cut-ins happen and crash, as sampled and as weighted to naturalistic driving."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path

from harness.report.number_format import count, number
from harness.report.plot_style import BLUES, FULL_WIDTH_IN, MUTED, REDS, Plot, new_figure, note
from harness.report.summary import RunSummary
from harness.vocabulary import FloatArray, IntArray

LEVELS_PER_DECADE = 2
"""Each colour step is a factor √10, so that six colours span three decades below the fullest cell."""
TTC_LINES_S = (1.0, 2.0, 4.0, 8.0)


def cut_in_plot(summary: RunSummary) -> Plot | None:
    """Four maps of (R2, R2dot) at the cut-in; None when BV never cut in."""
    block = summary.cut_in.used()
    if block is None:
        return None
    r2dot_mps, r2_m = (axis.edges(of.start, of.stop) for axis, of in zip(summary.cut_in.axes, block, strict=True))
    maps = _maps(summary)
    n_rows = len(maps) // 2
    figure = new_figure(FULL_WIDTH_IN, 3.0 * n_rows + 0.4)
    panels = figure.subplots(n_rows, 2, sharex=True, sharey=True, squeeze=False)
    for axes, (values, ramp, title) in zip(panels.flat, maps, strict=True):
        _draw_map(axes, values[block], r2_m, r2dot_mps, ramp)
        axes.set_title(title)
    for axes in panels[:, 0]:
        axes.set_ylabel("R2dot at the cut-in, m/s")
    for axes in panels[-1]:
        axes.set_xlabel("R2 at the cut-in, m")
    _add_key(figure, [ramp for ramp in (BLUES, REDS) if any(used is ramp for _, used, _ in maps)])
    sampled, crashed = float(summary.cut_in.count.sum()), float(summary.cut_in_crash.count.sum())
    alt = (
        f"Maps of gap R2 against its rate R2dot at the cut-in: {count(sampled)} cut-ins, {count(crashed)} of them "
        f"crashed. Panels: {', '.join(title for _, _, title in maps)}."
    )
    return Plot("cut_ins", figure, alt, _caption(summary))


def _maps(summary: RunSummary) -> list[tuple[FloatArray, tuple[str, ...], str]]:
    """Return values, colours and title per panel, row by row, leaving out what would only repeat or be empty."""
    shown = [(summary.cut_in, BLUES, "Cut-ins"), (summary.cut_in_crash, REDS, "Cut-ins that crash")]
    if summary.all_weights_one:
        return [(grid.count, ramp, title) for grid, ramp, title in shown]
    return [
        (values, ramp, f"{title}, {how}")
        for grid, ramp, title in (shown if summary.n_crashes else shown[:1])
        for values, how in ((grid.count, "sampled"), (grid.weight, "weighted"))
    ]


def _draw_map(axes: Axes, values: FloatArray, r2_m: FloatArray, r2dot_mps: FloatArray, ramp: tuple[str, ...]) -> None:
    """Fill the cells of each level as one path: small files, no seams, and colours that can follow the page."""
    level = _levels(values, len(ramp))
    for index, colour in enumerate(ramp):
        rows, columns = np.nonzero(level == index)
        if rows.size:
            path = _cells_path(rows, columns, r2_m, r2dot_mps)
            axes.add_patch(PathPatch(path, facecolor=colour, edgecolor="none"))
    axes.set_xlim(float(r2_m[0]), float(r2_m[-1]))
    axes.set_ylim(float(r2dot_mps[0]), float(r2dot_mps[-1]))
    _draw_ttc_lines(axes)


def _levels(values: FloatArray, n_levels: int) -> FloatArray:
    """Colour index per cell, highest for the fullest cell, -1 for empty ones."""
    top = float(values.max())
    if top <= 0.0:
        return np.full(values.shape, -1.0)
    with np.errstate(divide="ignore"):
        below = np.floor(-np.log10(values / top) * LEVELS_PER_DECADE)
    return np.where(values > 0.0, np.maximum(n_levels - 1 - below, 0), -1.0)


def _cells_path(rows: IntArray, columns: IntArray, r2_m: FloatArray, r2dot_mps: FloatArray) -> Path:
    """One compound path of all cells, neighbours in a row merged into one rectangle."""
    starts = np.flatnonzero(np.r_[True, (np.diff(rows) != 0) | (np.diff(columns) != 1)])
    ends = np.r_[starts[1:], rows.size] - 1
    left, right = r2_m[columns[starts]], r2_m[columns[ends] + 1]
    low, high = r2dot_mps[rows[starts]], r2dot_mps[rows[starts] + 1]
    corners = np.array([[left, low], [right, low], [right, high], [left, high]])
    return Path.make_compound_path_from_polys(corners.transpose(2, 0, 1))


def _draw_ttc_lines(axes: Axes) -> None:
    """Lines of equal time to collision R2/-R2dot, labelled where they leave the panel."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    for ttc_s in TTC_LINES_S:
        axes.plot([0.0, 1e3], [0.0, -1e3 / ttc_s], color=MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
        at_bottom = -low * ttc_s
        x, y = (at_bottom, low) if at_bottom < right else (right, -right / ttc_s)
        if y > high or x <= left:
            continue
        offset, align = ((3, 3), "left") if at_bottom < 0.9 * right else ((-3, 12), "right")
        note(axes, f"{ttc_s:g} s", (x, y), offset, ha=align, color=MUTED, fontsize=8)


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
    figure.legend(
        handles=patches,
        loc="outside lower center",
        title="cell, relative to the fullest cell of its map",
        title_fontsize=8,
        ncols=n,
        fontsize=8,
        labelcolor=MUTED,
        handlelength=1.8,
        columnspacing=1.2,
    )


def _caption(summary: RunSummary) -> str:
    per_test = number(summary.per_test(float(summary.cut_in.weight.sum())))
    text = "Gap R2 and its rate R2dot (BV minus AV) when BV cuts in. "
    if summary.all_weights_one:
        text += f"Tests are naturalistic driving itself; there are {per_test} cut-ins per test."
    else:
        how = (
            "with each shell counted by its probability"
            if summary.from_shells
            else "weighted by their likelihood ratio"
        )
        text += (
            f"Left, where the tests went; right, the same cut-ins {how}, as they occur in naturalistic driving "
            f"({per_test} per test)."
        )
    text += " Dashed lines: equal time to collision. Colours step by a factor √10 below each map's fullest cell."
    if not summary.n_crashes:
        return text + " None of them crashed."
    return text if summary.all_weights_one else text + " The lower right map is where the crash rate comes from."
