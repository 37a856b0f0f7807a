"""Where the crash rate comes from and where its uncertainty lies, shell by shell."""

from __future__ import annotations

from matplotlib.axes import Axes

from harness.estimators.shells import Shell
from harness.report.number_format import coarse_percent, number, percent
from harness.report.plot_style import BLUE, FULL_WIDTH_IN, GREY, INK, MUTED, VERMILLION, Plot, new_figure, note, scaled
from harness.report.run_folder import ShownShells

POOL = "pool’s own error"
BAR = 0.62
VISIBLE = 0.005
"""Smallest share of an axis that a bar must have to show a colour."""


def shells_plot(found: ShownShells) -> Plot:
    """Draw contribution with its limits (left) and half-width (right), from careful to careless."""
    n_rows = len(found.shells) + 1
    figure = new_figure(FULL_WIDTH_IN, 1.2 + 0.36 * n_rows)
    rates, widths = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    # An untested shell may hold anything up to its probability: it would flatten all others, and runs out instead.
    tested = [shell for shell in found.shells if shell.n_episodes] or list(found.shells)
    limit = 1.12 * max(shell.high for shell in tested)
    for row, shell in enumerate(found.shells):
        _draw_rate(rates, row, shell, limit)
    half_widths = [*(shell.half_width for shell in found.shells), found.pool_half_width]
    widest = 1.4 * max(*(shell.half_width for shell in tested), found.pool_half_width)
    for row, half_width in enumerate(half_widths):
        _draw_width(widths, row, half_width, widest, found)
    _draw_boundary((rates, widths), found)
    names = [*(shell.shell for shell in found.shells), POOL]
    rates.set_yticks(range(n_rows), names)
    rates.set_ylim(n_rows - 0.4, -0.6)
    _label(rates, limit, "Where the rate comes from", "contribution to the crash rate")
    _label(widths, widest, "Where the uncertainty lies", "half-width")
    source, open_question = _source(found), _open_question(found, names, half_widths)
    alt = (
        f"Bars per shell from {found.shells[0].shell} to {found.shells[-1].shell}: contribution to the crash rate with "
        f"limits, and half-width. {source} {open_question}"
    )
    caption = (
        "From careful (top) to careless. Left: what each shell adds to the crash rate, with its "
        f"limits{_colours(found, limit)}. {source} Right: probability × half-width of the crash share, with its share "
        f"of the sum of squares, which is what makes the interval. {open_question}"
    )
    return Plot("shells", figure, alt, caption)


def _draw_rate(axes: Axes, row: int, shell: Shell, limit: float) -> None:
    colour = BLUE if shell.inside else VERMILLION
    axes.barh(row, min(shell.contribution, limit), height=BAR, color=colour, alpha=0.85)
    high = min(shell.high, limit)
    axes.plot([shell.low, high], [row, row], color=INK, linewidth=1.3, solid_capstyle="butt")
    for end in (shell.low, high) if shell.high <= limit else (shell.low,):
        axes.plot([end, end], [row - 0.14, row + 0.14], color=INK, linewidth=1.3, solid_capstyle="butt")
    if shell.high > limit:
        axes.plot([limit], [row], ">", color=INK, markersize=6, clip_on=False)
        text = f"not tested: up to {number(shell.high)}"
        note(axes, text, (limit, row), (-9, 5), ha="right", color=MUTED, fontsize=8)


def _draw_width(axes: Axes, row: int, half_width: float, widest: float, found: ShownShells) -> None:
    axes.barh(row, min(half_width, widest), height=BAR, color=GREY)
    beyond = half_width > widest
    share = coarse_percent(found.share_of_uncertainty(half_width))
    offset, align = ((-5, 0), "right") if beyond else ((5, 0), "left")
    note(axes, share, (min(half_width, widest), row), offset, va="center", ha=align, color=INK, fontsize=8)


def _draw_boundary(panels: tuple[Axes, Axes], found: ShownShells) -> None:
    """Lines at the boundary of each statement, and between the shells and the pool."""
    for axes in panels:
        axes.axhline(len(found.shells) - 0.5, color=MUTED, linewidth=0.6)
    for each in found.statements:
        if each.n_shells == len(found.shells):
            continue
        boundary = each.n_shells - 0.5
        for axes in panels:
            axes.axhline(boundary, color=MUTED, linewidth=1.0, linestyle=(0, (4, 3)))
        text, place = f"outside {each.boundary} ({each.name}) ↓", ("axes fraction", "data")
        note(panels[0], text, (1.0, boundary), (-2, 2), xycoords=place, ha="right", color=MUTED, fontsize=8)


def _label(axes: Axes, limit: float, title: str, label: str) -> None:
    axes.set_xlim(0.0, limit)
    axes.set_title(title)
    axes.set_xlabel(f"{label}, per test{scaled(axes.xaxis, limit)}")
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0, pad=8, labelcolor=INK)


def _colours(found: ShownShells, limit: float) -> str:
    """Name the colours that can be seen, none where all bars have one because there is no outside."""
    seen = {shell.inside for shell in found.shells if shell.contribution > VISIBLE * limit}
    if not found.has_outside or not seen:
        return ""
    if seen == {True, False}:
        return "; blue inside the widest boundary, orange outside"
    return (
        "; all that can be seen (blue) lies inside the widest boundary"
        if True in seen
        else "; all lies outside (orange)"
    )


def _source(found: ShownShells) -> str:
    if found.rate == 0.0:
        return "No shell contributes: no crash was sampled."
    most = max(found.shells, key=lambda shell: shell.contribution)
    return f"Most of the rate comes from {most.shell} ({percent(most.contribution / found.rate)})."


def _open_question(found: ShownShells, names: list[str], half_widths: list[float]) -> str:
    widest = max(half_widths)
    name, share = names[half_widths.index(widest)], percent(found.share_of_uncertainty(widest))
    if name == POOL:
        return (
            f"Most of what is not known is the pool’s own error ({share}): only a pool of more paths would narrow it."
        )
    return f"Most of what is not known lies in {name} ({share}): further tests do most there."
