"""What pages draw: the rate, where it comes from, which events crash, and on which of them only one vehicle does."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np

from harness.estimators.answer import Estimates
from harness.estimators.traffic import Sensitivity
from harness.families.protocol import Family
from harness.families.words import Shown
from harness.numbers import count, number, plain, share
from harness.report.drawing import Plot, PlotAxis, PlotPanel
from harness.report.rows import not_moved_words
from harness.report.summary import RunFolder, RunSummary, ShownShells, summarise
from harness.strata import ASSUMPTION_FREE
from harness.vocabulary import CRASH, FAILED, BoolArray, FloatArray, IntArray

POOL = "pool’s own error"
WEIGHTED = (
    "The band should narrow around a level line. RHW should fall along the dotted line; each jump upwards is a crash "
    "with a large weight, and many late jumps mean that the interval cannot be trusted yet."
)
IN_ROUNDS = (
    "Tests come in rounds, first inside the boundary. A shell without tests counts as free of crashes in the "
    "line and as anything in the band, which begins wide and one-sided. RHW falls faster than the dotted line while "
    "what remains is to see no crash outside."
)
DASHED, DOTTED = "4 3", "1 3"
SHARES = {0.0: "grid", 0.25: "red-1", 0.5: "red-2", 0.75: "red-4", 1.0: "red-6"}
"""Up to which share of events that crash a cell of the map has a colour."""
WHO = {"both": "grey", "only A": "blue", "only B": "reference"}
"""Who crashes, and the colour: on the page the player draws B in that of reference drivers."""
KNOWN = {"fitted": "blue", "counted": "green", "assumed": "vermillion"}
MOST_BARS = 16
LARGEST = 9.0


def severity_plot(estimates: Estimates) -> Plot | None:
    """Draw the rate of crashes above each impact speed with its band; None without a crash."""
    severity = estimates.severity
    if severity is None:
        return None
    rows = [(row.above_mps, row.crash_rate, row.ci_low, row.ci_high) for row in severity.exceedance]
    above, rate, low, high = np.array(rows, np.float64).T
    seen = rate > 0.0
    shown = slice(0, min(int(seen.sum()) + 1, rate.size))
    bottom, top = 0.3 * float(rate[seen].min()), 2.0 * float(high[shown].max())
    x = PlotAxis("impact speed (closing speed at contact), m/s", 0.0, float(above[shown][-1]))
    panel = PlotPanel("Rate of crashes above an impact speed", x, PlotAxis("crashes per test", bottom, top, log=True))
    band = f"{share(estimates.confidence)} band, at each speed"
    panel.add("band", "blue", above[shown], np.maximum(low[shown], bottom), high[shown], opacity=0.16, label=band)
    panel.add("line", "blue", above[seen], rate[seen], label="rate of harder crashes")
    panel.add("dots", "blue", above[seen], rate[seen], 2.5)
    median = [severity.median_mps] * 2
    panel.add("line", "muted", median, [bottom, top], dash=DASHED, width=1.0, label="median impact")
    half, most = (f"{v:.1f} m/s ({3.6 * v:.0f} km/h)" for v in (severity.median_mps, severity.p95_mps))
    text = f"Half of the crashes are below {half}, 95 % below {most}, as they would happen in this traffic."
    return Plot("severity", [panel], f"Rate of crashes above each impact speed. {text}", text)


def convergence_plot(run: RunFolder) -> Plot | None:
    """Rate with its band, and RHW with its target, against tests; None without a crash, or a course to draw."""
    estimates, campaign = run.estimates, run.campaign
    target = None if campaign.accept is not None else campaign.stop.rhw  # a limit to decide looks at no width
    of_library = run.shells is not None and campaign.testing.shells.statement != ASSUMPTION_FREE
    points = sorted(estimates.convergence, key=lambda point: point.n)
    if len(points) < 2 or not points[-1].crash_rate:
        return None
    columns = [(point.n, point.crash_rate, point.ci_low, point.ci_high, point.rhw) for point in points]
    n, rate, low, high, rhw = np.array(columns, np.float64).T
    confidence, level = share(estimates.confidence), plain(estimates.lane_change_level)
    tests = PlotAxis("tests", float(n[0]), float(n[-1]), log=True)
    left = PlotPanel("Crash rate", tests, PlotAxis(f"per test (level {level})", 0.0, _rate_limit(rate, high)))
    left.add("band", "blue", n, low, high, opacity=0.16, label=f"{confidence} interval")
    left.add("line", "blue", n, rate, label="estimate")
    left.add("line", "muted", n[[0, -1]], rate[[-1, -1]], dash=DASHED, width=1.0, label="at the end")
    right = _rhw_panel(tests, n, rhw, None if of_library else target)
    caption = WEIGHTED if estimates.headline != "shells" else IN_ROUNDS
    ending = f", ending at {number(rhw[-1])}"
    if right is None:
        caption, ending = caption.partition(" RHW")[0], ": not known"
    elif target is None:
        caption += " No RHW was asked for."
    elif of_library:
        caption += " The RHW that was asked for is that of the statement library, not of the rate drawn here."
    alt = (
        f"Crash rate against number of tests with its {confidence} band, ending at {number(rate[-1])} after "
        f"{count(n[-1])} tests. Relative half-width against tests{ending}."
    )
    return Plot("convergence", [left, *([] if right is None else [right])], alt, caption)


def _rate_limit(rate: FloatArray, high: FloatArray) -> float:
    """Upper end of the rate axis: the last half of the curve fills it, the first wild intervals may leave it."""
    high = high[np.isfinite(high)]
    if not high.size:
        return 1.0
    settled = float(np.max(high[high.size // 3 :]))
    return 1.15 * max(min(settled, 3.0 * float(high[-1])), float(np.nanmax(rate[-2:])), 1e-300)


def _rhw_panel(tests: PlotAxis, n: FloatArray, rhw: FloatArray, target: float | None) -> PlotPanel | None:
    finite = np.isfinite(rhw) & (rhw > 0.0)
    if not finite.any():
        return None
    n, rhw = n[finite], rhw[finite]
    shown = rhw if target is None else np.append(rhw, target)
    y = PlotAxis("RHW", float(shown.min()) / 1.5, float(shown.max()) * 1.6, log=True)
    panel = PlotPanel("Relative half-width (RHW)", tests, y)
    panel.add("line", "blue", n, rhw, label=f"RHW, {rhw[-1]:.3g} at the end")
    if target is not None:
        panel.add("line", "vermillion", [tests.low, tests.high], [target] * 2, dash="6 3", label=f"target {target:g}")
    panel.add("line", "grey", n, rhw[-1] * np.sqrt(n[-1] / n), dash=DOTTED, width=1.2, label="∝ 1/√tests")
    return panel


def shells_plot(shown: ShownShells) -> Plot:
    """Draw contribution with its limits (left) and half-width (right), from careful to careless."""
    shells = shown.shells
    names = (*(shell.shell for shell in shown.shells), POOL)
    pool = float(np.nan_to_num(shown.pool_half_width))  # NaN where it is not known: there is no interval then
    half_widths = np.array([*(shell.half_width for shell in shells), pool])
    # An untested shell may hold anything up to its probability: it would flatten all others, and runs out instead.
    tested = [shell for shell in shells if shell.n_episodes] or list(shells)
    limit = 1.12 * max(shell.high for shell in tested)
    widest = 1.3 * max(*(shell.half_width for shell in tested), pool)
    rows = np.arange(len(names))
    y = PlotAxis("", len(names) - 0.4, -0.6, names=names)
    height = 62.0 + 26.0 * len(names)
    adds = PlotAxis("contribution to the crash rate, per test", 0.0, limit)
    left = PlotPanel("Where the rate comes from", adds, y, height=height)
    right = PlotPanel("Where the uncertainty lies", PlotAxis("half-width, per test", 0.0, widest), y, height=height)
    places, inside = rows[:-1], np.array([shell.inside for shell in shells])
    low, rate, high = np.array([(shell.low, shell.contribution, shell.high) for shell in shells]).T
    for kind, colour in ((inside, "blue"), (~inside, "vermillion")):
        left.add("boxes", colour, 0.0 * places[kind], rate[kind], places[kind] - 0.3, places[kind] + 0.3, opacity=0.85)
    left.add("boxes", "ink", low, high, places - 0.04, places + 0.04)
    for row, shell in enumerate(shells):
        if shell.high > limit:
            left.add("text", "muted", 0.1 * limit, row - 0.26, label=f"not tested: up to {number(shell.high)}")
    right.add("boxes", "grey", 0.0 * rows, half_widths, rows - 0.3, rows + 0.3, opacity=0.85)
    for row, width in enumerate(half_widths.tolist()):
        text = share(shown.share_of_uncertainty(width), least=0.001) + " →" * (width > widest)
        right.add("text", "muted", min(width, widest / 1.3), row, label=text)
    if (boundary := shown.within.n_shells - 0.5) < len(shells) - 0.5:
        label = "outside ↓"  # the boundary is the row above
        for panel, end in ((left, limit * max(left.room_before(label), 0.0)), (right, right.x.high)):
            panel.add("line", "muted", [0.0, end], [boundary] * 2, dash=DASHED, width=1.0)
        left.add("text", "muted", limit, boundary, label=label)
    source, open_question = _source(shown), _open_question(shown, names, half_widths.tolist())
    alt = (
        f"Bars per shell from {shells[0].shell} to {shells[-1].shell}: contribution to the crash rate with limits, and "
        f"half-width. {source} {open_question}"
    )
    orange = " (orange outside the boundary)" if (rate[~inside] > 0.0).any() else ""
    caption = (
        "A shell holds the events on which its driver crashes and no more careful one does (top: careful). "
        f"The rate: what each shell adds, with its limits{orange}. {source} The "
        "uncertainty: how wide each shell alone would leave the interval; the per cent add up to the whole. "
        f"{open_question}"
    )
    return Plot("shells", [left, right], alt, caption)


def sensitivity_plot(sensitivity: Sensitivity) -> Plot:
    """Draw how far rate and ratio move if a number of the traffic is another one: one bar each, the longest first."""
    shown = sensitivity.shown[:MOST_BARS]
    names = tuple(bar.what for bar in shown)
    moved = [[*factors, 1.0] for bar in shown for factors in (bar.rate, bar.ratio)]
    ends = np.array([[np.nanmin(factors), np.nanmax(factors)] for factors in moved])
    rate, ratio = ends[0::2].T, ends[1::2].T
    low, high = 0.9 * float(max(ends[:, 0].min(), 1e-3)), 1.1 * float(ends[:, 1].max())
    rows, provenance = np.arange(len(names)), np.array([bar.known for bar in shown])
    across, down = PlotAxis("times", low, high, log=True), PlotAxis("", len(names) - 0.4, -0.6, names=names)
    panel = PlotPanel("What moves the answer", across, down, height=76.0 + 22.0 * len(names))
    for name, colour in KNOWN.items():
        if (kind := provenance == name).any():
            left, y = np.maximum(rate[0][kind], low), rows[kind]
            panel.add("boxes", colour, left, rate[1][kind], y - 0.3, y + 0.3, opacity=0.85, label=f"rate, {name}")
    thin = rows - 0.06, rows + 0.06
    # What moves the rate most need not move the ratio most.
    first, most = (int(np.abs(np.log(np.maximum(factors, low))).max(axis=0).argmax()) for factors in (rate, ratio))
    panel.add("boxes", "ink", np.maximum(ratio[0], low), ratio[1], *thin, label=f"its ratio to {sensitivity.driver}")
    panel.add("line", "muted", [1.0, 1.0], [down.low, down.high], dash=DASHED, width=1.0)
    open_end = " (the other end is not known from these tests)"
    of_rate, of_ratio = (open_end * bool(np.isnan(factors).any()) for factors in (shown[first].rate, shown[most].ratio))
    text = (
        "Fitted and counted numbers move over nine tenths of what their data leave open, assumed ones over the stated "
        f"range. The rate depends most on {names[first]}: × {number(rate[0][first], 2)} to × "
        f"{number(rate[1][first], 2)}{of_rate}; its ratio to {sensitivity.driver} on {names[most]}: × "
        f"{number(ratio[0][most], 3)} to × {number(ratio[1][most], 3)}{of_ratio}."
    )
    text = " ".join([text, *map(not_moved_words, sensitivity.not_moved)])
    return Plot("sensitivity", [panel], text, text)


def _source(shown: ShownShells) -> str:
    if shown.rate == 0.0:
        return "No shell contributes: no crash was sampled."
    most = max(shown.shells, key=lambda shell: shell.contribution)
    return f"The largest part of the rate comes from {most.shell} ({share(most.contribution / shown.rate)})."


def _open_question(shown: ShownShells, names: tuple[str, ...], half_widths: list[float]) -> str:
    if math.isnan(shown.pool_half_width):
        return "The pool’s own error is not known: its paths are too few."
    widest = max(half_widths)
    name, most = names[half_widths.index(widest)], share(shown.share_of_uncertainty(widest))
    if name == POOL:
        return f"Most of what is not known is the pool’s own error ({most}): only a pool of more paths would narrow it."
    kept = zip(shown.shells, shown.design.available, strict=False)
    used_up = name in [shell.shell for shell, available in kept if shell.n_episodes >= available]
    remedy = "the pool has no further event of it" if used_up else "further tests help most there"
    return f"Most of what is not known lies in {name} ({most}): {remedy}."


def where_plot(run: RunFolder, summary: RunSummary | None = None) -> Plot | None:
    """Maps of the share of events that crash, over the family's axes; None without any."""
    rows, family, words = (summary or summarise(run)).rows, run.family, run.family.words
    met = np.isfinite(rows["event_gap_m"]) & np.isfinite(rows["event_rate_mps"]) & (rows["outcome"] != FAILED)
    if not met.any():
        return None
    panels = [_map(axes, rows, met, words.events) for axes in family.maps]
    x, y = (re.split(" (?:at|of|when) ", each.words)[0] for each in family.maps[0])  # without when
    n_crashes = count(int(np.count_nonzero(rows["outcome"][met] == CRASH)))
    text = (
        f"Each of {count(met.sum())} {words.events} by its {x} and {y}; {n_crashes} of them crashed. "
        "Where these axes have no cell, nothing was tested."
    )
    return Plot("where", panels, text, text)


def _map(axes: tuple[Shown, Shown], rows: Mapping[str, FloatArray], met: BoolArray, events: str) -> PlotPanel:
    """Share of events that crash in cells, of the rows that ``met`` one."""
    weight, crash = rows["weight"][met], rows["outcome"][met] == CRASH
    among, n = crash if crash.any() else np.ones_like(crash), crash.size
    cells = int(np.clip(0.7 * math.sqrt(n), 12, 40))  # with few events each in one of its own
    values, edges = list[FloatArray](), list[FloatArray]()
    for axis, number_of in zip(axes, (cells, cells // 2), strict=True):
        value = np.maximum(axis.of(rows)[met], 0.0)
        values.append(value)
        if axis.edges.size:
            last = np.searchsorted(axis.edges, axis.beyond * float(value[among].max())) + 1
            edges.append(axis.edges[max(int(np.searchsorted(axis.edges, value.min())) - 1, 0) : int(last)])
        else:
            most = axis.beyond * float(np.quantile(value[among], 1.0 if crash.any() else 0.98)) + 1.0
            edges.append(np.linspace(0.0, most, number_of + 1))
    (gap, closing), (x, y) = values, edges
    every, crashed = (np.histogram2d(gap, closing, (x, y), weights=w)[0].T for w in (weight, weight * crash))
    shares = np.divide(crashed, every, out=np.full_like(every, -1.0), where=every > 0.0)
    across, up = (PlotAxis(axis.axis, float(edge[0]), float(edge[-1])) for axis, edge in zip(axes, edges, strict=True))
    panel = PlotPanel(f"Share of {events} that crash", across, up, height=300.0)
    for low, (high, colour) in zip((-0.5, *SHARES), SHARES.items(), strict=False):
        row, column = np.nonzero((shares > low) & (shares <= high))
        label = f"≤ {share(high)}" if high else "tested, none"
        panel.add("boxes", colour, x[column], x[column + 1], y[row], y[row + 1], label=label)
    return panel


def pairs_plot(who: IntArray, weight: FloatArray, values: FloatArray, family: Family) -> Plot | None:
    """Map of events (n,) that crash, by ``who`` of `WHO`, at ``values`` (2, n) of the family's first map; or None."""
    (first, second), words = family.maps[0], family.words
    met = np.isfinite(values).all(axis=0)  # one that crashes before the event has met none
    if not met.any():
        return None
    weight, values = weight[met], values[:, met]
    cells = np.stack((who[met], values[0] // first.cell, values[1] // second.cell))
    (kind, *_), place = np.unique(cells, axis=1, return_inverse=True)
    place = place.ravel()  # numpy 2.0 gives it another axis
    adds = np.bincount(place, weight)
    gap, closing = (np.bincount(place, weight * x) / adds for x in values)
    ends = ((axis, max(1.1 * float(x.max()), axis.cell)) for x, axis in ((gap, first), (closing, second)))
    across, up = (PlotAxis(axis.axis, 0.0, end) for axis, end in ends)
    panel = PlotPanel(f"{words.events.capitalize()} that crash, by who crashes", across, up, height=300.0)
    shares = []
    for code, (name, colour) in enumerate(WHO.items()):
        own = kind == code
        n = count(int(np.count_nonzero(who == code)))
        radius = LARGEST * np.sqrt(adds[own] / adds.max())
        panel.add("dots", colour, gap[own], closing[own], radius, opacity=0.7, label=f"{name} ({n})")
        shares.append(f"{name} on {n}")
    text = (
        f"{words.events.capitalize()} on which a vehicle crashes: {', '.join(shares)}. A disc’s area is what "
        f"{words.events} within {first.cell:g} {first.unit} and {second.cell:g} {second.unit} add to the rate, "
        f"{number(float(adds.max()))} per test for the largest."
    )
    return Plot("pairs", [panel], text, text)
