"""How rate and relative half-width settled as tests came in."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from harness.report.number_format import count, number, percent, plain
from harness.report.plot_style import (
    BLUE,
    FULL_WIDTH_IN,
    GREY,
    INK,
    MUTED,
    VERMILLION,
    Plot,
    decades,
    new_figure,
    note,
    scaled,
)
from harness.report.run_folder import StoredEstimates, StoredPoint
from harness.vocabulary import FloatArray

_WEIGHTED = (
    "Left, the band should narrow around a level line: a rate that still climbs, or drops between jumps, has not "
    "settled. Right, RHW should fall along the dotted line; each jump upwards is a crash with a large weight, and "
    "many late jumps mean that the interval cannot be trusted yet."
)
_SHELLS = (
    "Tests come in rounds, first inside the narrowest boundary. A shell without tests counts as free of crashes in "
    "the estimate (line) and as anything in the interval (band), which is why the band begins wide and one-sided, and "
    "why the line may jump when a shell is first tested. Right, RHW falls faster than the dotted line while what "
    "remains is to see no crash outside, and along it where crashes must be counted."
)
_RHW = "Relative half-width (RHW)"


def convergence_plot(
    estimates: StoredEstimates, target_rhw: float | None, *, of_statement: str | None = None
) -> Plot | None:
    """Rate with its band, and RHW with its target, against tests; None without convergence records.

    ``of_statement``: the target is one for a statement of a shells run about a boundary, which convergence does not
    record.
    """
    curve = _curve(estimates.convergence or [])
    if curve["n"].size < 2:
        return None
    confidence, level = percent(estimates.confidence), plain(estimates.lane_change_level)
    if not np.any(curve["crash_rate"] > 0.0):
        return _plot_without_crash(curve, confidence, level)
    figure = new_figure(FULL_WIDTH_IN, 3.5)
    rate_axes, rhw_axes = figure.subplots(1, 2, sharex=True)
    for axes in (rate_axes, rhw_axes):
        _label_tests(axes, curve)
    _draw_rate(rate_axes, curve, confidence, level)
    _draw_rhw(rhw_axes, curve, None if of_statement else target_rhw)
    alt = (
        f"Left: crash rate against number of tests with its {confidence} band, ending at "
        f"{number(curve['crash_rate'][-1])} after {count(curve['n'][-1])} tests. Right: relative half-width against "
        f"tests, ending at {number(curve['rhw'][-1])}."
    )
    caption = _WEIGHTED if estimates.headline != "shells" else _SHELLS
    if target_rhw is None:
        caption += " No RHW was asked for."
    elif of_statement:
        caption += f" The RHW that was asked for is that of the statement {of_statement}, not of the rate drawn here."
    return Plot("convergence", figure, alt, caption)


def _plot_without_crash(curve: dict[str, FloatArray], confidence: str, level: str) -> Plot:
    """Draw only the upper end of the interval: without a crash it is all that changes, and RHW is not defined."""
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    axes = figure.subplots()
    _label_tests(axes, curve)
    high = curve["ci_high"]
    axes.plot(curve["n"], high, color=BLUE)
    known = high[np.isfinite(high) & (high > 0.0)]
    if known.size:
        axes.set_yscale("log")
        axes.set_ylim(float(known.min()) / 1.6, float(known.max()) * 1.6)
        decades(axes.yaxis, *axes.get_ylim())
    axes.set_ylabel(f"crash rate per test (level {level})")
    axes.set_title(f"Upper end of the {confidence} interval")
    alt = f"Upper end of the {confidence} interval against tests, ending at {number(high[-1])}; no crash was sampled."
    caption = (
        "No crash was sampled: the estimate stays at zero and only the upper end of its interval falls as tests come "
        "in. The relative half-width is not defined without a crash."
    )
    return Plot("convergence", figure, alt, caption)


def _label_tests(axes: Axes, curve: dict[str, FloatArray]) -> None:
    axes.set_xscale("log")
    axes.set_xlim(curve["n"][0], curve["n"][-1])
    decades(axes.xaxis, *axes.get_xlim())
    axes.set_xlabel("tests")


def _curve(points: list[StoredPoint]) -> dict[str, FloatArray]:
    """Columns of the convergence records, shape (m,), missing values as NaN, sorted by tests."""
    names = ("n", "crash_rate", "ci_low", "ci_high", "rhw")
    table = np.array([[getattr(point, name) for name in names] for point in points], np.float64).reshape(-1, len(names))
    table = table[np.argsort(table[:, 0], kind="stable")]
    return dict(zip(names, table.T, strict=True))


def _draw_rate(axes: Axes, curve: dict[str, FloatArray], confidence: str, level: str) -> None:
    n, rate, low, high = (curve[name] for name in ("n", "crash_rate", "ci_low", "ci_high"))
    axes.fill_between(n, low, high, color=BLUE, alpha=0.16, linewidth=0, label=f"{confidence} interval")
    axes.plot(n, rate, color=BLUE, label="estimate")
    axes.axhline(rate[-1], color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)), label="at the end")
    top = _rate_limit(curve)
    axes.set_ylim(0.0, top)
    unit = scaled(axes.yaxis, top)
    axes.set_ylabel(f"crash rate per test{unit} (level {level})")
    _head(axes, "Crash rate")


def _head(axes: Axes, title: str) -> None:
    """Title, and below it the legend in one line: within the panel there is no place where no curve can be."""
    axes.set_title(title, pad=24.0)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(
            loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, borderpad=0.3, ncols=3, fontsize=8,
            labelcolor=MUTED, columnspacing=1.3, handlelength=1.8,
        )  # fmt: skip


def _rate_limit(curve: dict[str, FloatArray]) -> float:
    """Upper end of the rate axis: the last half of the curve fills it, the first wild intervals may leave it."""
    high = curve["ci_high"][np.isfinite(curve["ci_high"])]
    if not high.size:
        return 1.0
    settled = float(np.max(high[high.size // 3 :]))
    return 1.15 * max(min(settled, 3.0 * float(high[-1])), float(np.nanmax(curve["crash_rate"][-2:])), 1e-300)


def _draw_rhw(axes: Axes, curve: dict[str, FloatArray], target_rhw: float | None) -> None:
    axes.set_ylabel("RHW")
    known = np.isfinite(curve["rhw"]) & (curve["rhw"] > 0.0)
    if not known.any():
        _head(axes, _RHW)
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", color=MUTED)
        return
    n, rhw = curve["n"][known], curve["rhw"][known]
    axes.set_yscale("log")
    axes.plot(n, rhw[-1] * np.sqrt(n[-1] / n), color=GREY, linewidth=1.0, linestyle=(0, (1, 2)), label="∝ 1/√tests")
    axes.plot(n, rhw, color=BLUE, label="RHW")
    low, high = float(rhw.min()), float(rhw.max())
    if target_rhw is not None:
        axes.axhline(target_rhw, color=VERMILLION, linewidth=1.1, linestyle=(0, (5, 2)), label=f"target {target_rhw:g}")
        low, high = min(low, target_rhw), max(high, target_rhw)
    # The last value is written below its point, which must not be on the edge however many decades are shown.
    axes.set_ylim(low / max(1.5, (high / low) ** 0.15), high * 1.6)
    decades(axes.yaxis, *axes.get_ylim())
    _head(axes, _RHW)
    axes.plot(n[-1:], rhw[-1:], "o", color=BLUE, markersize=5, clip_on=False)
    note(axes, f"{rhw[-1]:.3g}", (n[-1], rhw[-1]), (-7, -11), ha="right", color=INK)
