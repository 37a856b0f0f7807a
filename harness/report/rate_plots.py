"""The rate drawn: above each impact speed, as tests came in, and (of shells) where it comes from."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from harness.estimators.answer import Estimates
from harness.numbers import count, number, plain, share
from harness.report.style import (
    BLUE,
    FULL_WIDTH_IN,
    GREY,
    MUTED,
    VERMILLION,
    Plot,
    Row,
    head,
    interval_bars,
    log_axis,
    new_figure,
    note,
    scaled,
    two_panels,
)
from harness.report.summary import ShownShells
from harness.vocabulary import FloatArray

POOL = "pool’s own error"
WEIGHTED = (
    "Left, the band should narrow around a level line. Right, RHW should fall along the dotted line; each jump upwards "
    "is a crash with a large weight, and many late jumps mean that the interval cannot be trusted yet."
)
IN_ROUNDS = (
    "Tests come in rounds, first inside the narrowest boundary. A shell without tests counts as free of crashes in the "
    "line and as anything in the band, which begins wide and one-sided. Right, RHW falls faster than the dotted line "
    "while what remains is to see no crash outside."
)


def severity_plot(estimates: Estimates) -> Plot | None:
    """Draw the rate of crashes above each impact speed with its band; None without a crash."""
    severity = estimates.severity
    if severity is None:
        return None
    rows = [(row.above_mps, row.crash_rate, row.ci_low, row.ci_high) for row in severity.exceedance]
    above, rate, low, high = np.array(rows, np.float64).T
    seen = rate > 0.0
    shown = slice(0, min(int(seen.sum()) + 1, rate.size))
    figure = new_figure(FULL_WIDTH_IN, 2.9)
    axes, confidence = figure.subplots(), share(estimates.confidence)
    bottom = 0.3 * float(rate[seen].min())
    axes.fill_between(
        above[shown], np.maximum(low[shown], bottom), high[shown], color=BLUE, alpha=0.16, linewidth=0,
        label=f"{confidence} band, at each speed",
    )  # fmt: skip
    axes.plot(above[seen], rate[seen], color=BLUE, marker="o", markersize=4, label="rate of harder crashes")
    axes.axvline(severity.median_mps, color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)), label="median impact")
    log_axis(axes.yaxis, bottom, 2.0 * float(high[shown].max()))
    axes.set_xlim(0.0, float(above[shown][-1]))
    axes.set_xlabel("impact speed (closing speed at contact) above which crashes count, m/s")
    axes.set_ylabel("crashes per test")
    head(axes, "How hard it crashes")
    half = f"{severity.median_mps:.1f} m/s ({3.6 * severity.median_mps:.0f} km/h)"
    most = f"{severity.p95_mps:.1f} m/s ({3.6 * severity.p95_mps:.0f} km/h)"
    text = f"Half of the crashes are below {half}, 95 % below {most}, as they would happen in this traffic."
    return Plot("severity", figure, f"Rate of crashes above each impact speed. {text}", text)


def convergence_plot(estimates: Estimates, target_rhw: float | None, *, of_statement: str | None = None) -> Plot | None:
    """Rate with its band, and RHW with its target, against tests; None without a crash, or a course to draw.

    ``of_statement``: the target is one for a statement of a shells run about a boundary, which convergence does not
    record.
    """
    points = sorted(estimates.convergence, key=lambda point: point.n)
    if len(points) < 2 or not points[-1].crash_rate:
        return None
    columns = [(each.n, each.crash_rate, each.ci_low, each.ci_high, each.rhw) for each in points]
    n, rate, low, high, rhw = np.array(columns, np.float64).T
    confidence, level = share(estimates.confidence), plain(estimates.lane_change_level)
    figure, left, right = two_panels(3.5, ("tests", "tests"), sharex=True)
    for axes in (left, right):
        log_axis(axes.xaxis, n[0], n[-1])
    left.fill_between(n, low, high, color=BLUE, alpha=0.16, linewidth=0, label=f"{confidence} interval")
    left.plot(n, rate, color=BLUE, label="estimate")
    left.axhline(rate[-1], color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)), label="at the end")
    left.set_ylim(0.0, _rate_limit(rate, high))
    left.set_ylabel(f"crash rate per test{scaled(left.yaxis, left.get_ylim()[1])} (level {level})")
    head(left, "Crash rate")
    _draw_rhw(right, n, rhw, None if of_statement else target_rhw)
    alt = (
        f"Left: crash rate against number of tests with its {confidence} band, ending at {number(rate[-1])} after "
        f"{count(n[-1])} tests. Right: relative half-width against tests, ending at {number(rhw[-1])}."
    )
    caption = WEIGHTED if estimates.headline != "shells" else IN_ROUNDS
    if target_rhw is None:
        caption += " No RHW was asked for."
    elif of_statement:
        caption += f" The RHW that was asked for is that of the statement {of_statement}, not of the rate drawn here."
    return Plot("convergence", figure, alt, caption)


def _rate_limit(rate: FloatArray, high: FloatArray) -> float:
    """Upper end of the rate axis: the last half of the curve fills it, the first wild intervals may leave it."""
    high = high[np.isfinite(high)]
    if not high.size:
        return 1.0
    settled = float(np.max(high[high.size // 3 :]))
    return 1.15 * max(min(settled, 3.0 * float(high[-1])), float(np.nanmax(rate[-2:])), 1e-300)


def _draw_rhw(axes: Axes, n: FloatArray, rhw: FloatArray, target_rhw: float | None) -> None:
    axes.set_ylabel("RHW")
    known = np.isfinite(rhw) & (rhw > 0.0)
    if not known.any():
        axes.set_title("Relative half-width (RHW)")
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", color=MUTED)
        return
    n, rhw = n[known], rhw[known]
    shown = rhw if target_rhw is None else np.append(rhw, target_rhw)
    log_axis(axes.yaxis, float(shown.min()) / 1.5, float(shown.max()) * 1.6)
    axes.plot(n, rhw, color=BLUE, label=f"RHW, {rhw[-1]:.3g} at the end")
    if target_rhw is not None:
        axes.axhline(target_rhw, color=VERMILLION, linewidth=1.1, linestyle=(0, (5, 2)), label=f"target {target_rhw:g}")
    axes.plot(n, rhw[-1] * np.sqrt(n[-1] / n), color=GREY, linewidth=1.0, linestyle=(0, (1, 2)), label="∝ 1/√tests")
    head(axes, "Relative half-width (RHW)")


def shells_plot(found: ShownShells) -> Plot:
    """Draw contribution with its limits (left) and half-width (right), from careful to careless."""
    shells, names = found.shells, [*(shell.shell for shell in found.shells), POOL]
    half_widths = [*(shell.half_width for shell in shells), found.pool_half_width]
    # An untested shell may hold anything up to its probability: it would flatten all others, and runs out instead.
    tested = [shell for shell in shells if shell.n_episodes] or list(shells)
    limit = 1.12 * max(shell.high for shell in tested)
    widest = 1.12 * max(*(shell.half_width for shell in tested), found.pool_half_width)
    figure, left, right = two_panels(1.2 + 0.36 * len(names), ("", ""), sharey=True, width_ratios=(3, 2))
    for axes, end, title, label in (
        (left, limit, "Where the rate comes from", "contribution to the crash rate"),
        (right, widest, "Where the uncertainty lies", "half-width"),
    ):
        axes.set_xlim(0.0, end)
        axes.set_title(title)
        axes.set_xlabel(f"{label}, per test{scaled(axes.xaxis, end)}")
    rates = [
        Row(
            shell.shell if shell.high <= limit else f"{shell.shell}\nnot tested: up to {number(shell.high)}",
            shell.contribution, BLUE if shell.inside else VERMILLION, shell.low, shell.high,
        )
        for shell in shells
    ]  # fmt: skip
    interval_bars(left, [*rates, Row(POOL, 0.0, GREY)], filled=True)
    shares = (share(found.share_of_uncertainty(half_width), least=0.001) for half_width in half_widths)
    widths = [Row(name, width, GREY, text=text) for name, width, text in zip(names, half_widths, shares, strict=True)]
    interval_bars(right, widths, filled=True)
    left.set_yticks(range(len(names)), [*(row.name for row in rates), POOL])  # shared: the right has the names alone
    for each in found.statements:
        if (boundary := each.n_shells) < len(shells):
            for axes in (left, right):
                axes.axhline(boundary - 0.5, color=MUTED, linewidth=1.0, linestyle=(0, (4, 3)))
            text, beside = f"outside {each.boundary} ({each.name}) ↓", ("axes fraction", "data")
            note(left, text, (1.0, boundary - 0.5), (-2, 2), xycoords=beside, ha="right", color=MUTED, fontsize=8)
    source, open_question = _source(found), _open_question(found, names, half_widths)
    alt = (
        f"Bars per shell from {shells[0].shell} to {shells[-1].shell}: contribution to the crash rate with limits, and "
        f"half-width. {source} {open_question}"
    )
    caption = (
        "From careful (top) to careless. Left: what each shell adds to the crash rate, with its "
        f"limits (orange outside every boundary). {source} Right: probability × half-width of the crash share, and its "
        f"share of the sum of squares, which is what makes the interval. {open_question}"
    )
    return Plot("shells", figure, alt, caption)


def _source(found: ShownShells) -> str:
    if found.rate == 0.0:
        return "No shell contributes: no crash was sampled."
    most = max(found.shells, key=lambda shell: shell.contribution)
    return f"Most of the rate comes from {most.shell} ({share(most.contribution / found.rate)})."


def _open_question(found: ShownShells, names: list[str], half_widths: list[float]) -> str:
    widest = max(half_widths)
    name, most = names[half_widths.index(widest)], share(found.share_of_uncertainty(widest))
    if name == POOL:
        return f"Most of what is not known is the pool’s own error ({most}): only a pool of more paths would narrow it."
    return f"Most of what is not known lies in {name} ({most}): further tests do most there."
