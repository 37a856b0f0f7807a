"""What crashes have in common: conditions at the cut-in of tests that crashed, against those of tests that did not.

Of tests from shells those outside the library's boundary are compared: they are one stratum, drawn by naturalistic
probability, so that every test counts the same. Under the other methods all cut-ins are, with their likelihood ratios.

What LV, BV and AV were doing when BV decided to cut in is worked out from the stored rows. A row holds the initial
state and LV's and BV's draws, which determine their motion up to the cut-in; the AV's speed there follows from BV's and
the recorded R2dot, whether it kept its speed or not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes

from harness.maneuvers import ACCELERATIONS_MPS2, CUT_IN
from harness.report.number_format import count, decimal, percent
from harness.report.plot_style import FULL_WIDTH_IN, GREY, MUTED, VERMILLION, Plot, new_figure, only_horizontal_grid
from harness.report.run_folder import RunFolder, floats
from harness.report.telling_bands import Band, telling_bands
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import CRASH, FAILED, OUTCOMES, FloatArray, IntArray

MOST_CRASHES, MOST_OTHERS = 5_000, 20_000
"""Tests compared, the first of each kind: tests come in random order, so that this is a fair sample."""
FEWEST_CRASHES = 3
"""Fewer have nothing in common that chance would not give them."""
PANELS = 3
BARS = 40
TICKED_CRASHES = 60
"""Up to so many crashes each get a mark of their own below the bars."""
OTHERS_SHOWN, CRASHES_SHOWN = (0.005, 0.995), (0.25, 0.75)
"""Quantiles that a panel reaches at least; of crashes fewer, because some need a braking of hundreds of m/s²."""


class Condition(NamedTuple):
    """A quantity at the cut-in: its name in a table, and in a sentence after «had»."""

    name: str
    phrase: str
    unit: str


CONDITIONS = (
    Condition("AV speed", "an AV speed", "m/s"),
    Condition("BV speed", "a BV speed", "m/s"),
    Condition("R2, gap BV–AV", "a gap R2", "m"),
    Condition("R2dot", "a rate R2dot", "m/s"),
    Condition("time to collision R2/−R2dot", "a time to collision", "s"),
    Condition("braking needed R2dot²/(2 R2)", "a needed braking", "m/s²"),
    Condition("R1, gap LV–BV", "a gap R1", "m"),
    Condition("R1dot", "a rate R1dot", "m/s"),
    Condition("time of the cut-in", "a cut-in time", "s"),
    Condition("BV acceleration at the cut-in", "a BV acceleration at the cut-in", "m/s²"),
    Condition("BV acceleration after the cut-in", "a BV acceleration right after the cut-in", "m/s²"),
)
NUMBERS = ("v_bv_mps", "r1_m", "r1dot_mps", "cut_in_r2_m", "cut_in_r2dot_mps")
COLUMNS = (*NUMBERS, "cut_in_step", "lv_maneuvers", "bv_maneuvers")


def cut_in_conditions(batch: pa.RecordBatch, hold_steps: int) -> FloatArray:
    """Values of `CONDITIONS`, shape (Q, n), in rows of the episodes table that all have a cut-in.

    LV and BV hold an acceleration for ``hold_steps``. NaN where there is no such value: the acceleration after a cut-in
    that ended the test at once.
    """
    v_bv0, r1_0, r1dot0, r2, r2dot = (floats(batch.column(name)) for name in NUMBERS)
    cut = batch.column("cut_in_step").to_numpy(zero_copy_only=False).astype(np.int64)
    lv, bv = (_draws(batch.column(name)) for name in ("lv_maneuvers", "bv_maneuvers"))
    x_lv, v_lv = _moved(np.maximum(v_bv0 + r1dot0, 0.0), lv, cut, hold_steps)
    x_bv, v_bv = _moved(v_bv0, bv, cut, hold_steps)
    closing = np.maximum(-r2dot, 0.0)
    with np.errstate(divide="ignore"):
        ttc = np.where(closing > 0.0, r2 / closing, np.inf)
        needed = np.where(closing > 0.0, closing * closing / (2.0 * r2), 0.0)
    held = cut // hold_steps  # the draw that the cut-in falls into; the mark of the cut-in and BV's next draw follow it
    at, after = (_accelerations(bv, held + ahead) for ahead in (0, 2))
    return np.stack(
        [v_bv - r2dot, v_bv, r2, r2dot, ttc, needed, r1_0 + x_lv - x_bv, v_lv - v_bv, STEP_S * cut, at, after]
    )


def _draws(column: pa.ListArray) -> IntArray:
    """Maneuver indices, shape (n, most draws), -1 beyond the last of a row."""
    lengths = column.value_lengths().to_numpy(zero_copy_only=False).astype(np.int64)
    drawn = np.full((lengths.size, int(lengths.max(initial=0)) + 1), -1, np.int64)
    drawn[np.arange(drawn.shape[1]) < lengths[:, None]] = column.flatten().to_numpy(zero_copy_only=False)
    return drawn


def _accelerations(draws: IntArray, which: IntArray) -> FloatArray:
    """Acceleration (m/s²) of one draw per row; NaN where it is none."""
    draw = np.take_along_axis(draws, np.minimum(which, draws.shape[1] - 1)[:, None], axis=1)[:, 0]
    known = (draw >= 0) & (draw < CUT_IN)
    return np.where(known, ACCELERATIONS_MPS2[np.where(known, draw, 0)], np.nan)


def _moved(v: FloatArray, draws: IntArray, steps: IntArray, hold_steps: int) -> tuple[FloatArray, FloatArray]:
    """Distance (m) and speed (m/s) after ``steps`` steps, a draw held for ``hold_steps`` of them; nobody reverses."""
    x = np.zeros_like(v)
    for period in range(int(steps.max(initial=0)) // hold_steps + 1):
        seconds = STEP_S * np.clip(steps - period * hold_steps, 0, hold_steps)
        a = np.where(seconds > 0.0, _accelerations(draws, np.full(v.size, period)), 0.0)
        moving = np.where(a < 0.0, np.minimum(seconds, v / np.maximum(-a, 1e-12)), seconds)
        x += (v + 0.5 * a * moving) * moving
        v = np.maximum(v + a * moving, 0.0)
    return x, v


class Group:
    """Tests of one kind: values of `CONDITIONS`, shape (Q, n), and what each stands for, shape (n,)."""

    def __init__(self) -> None:
        self.values: FloatArray = np.zeros((len(CONDITIONS), 0))
        self.weight: FloatArray = np.zeros(0)

    @property
    def n(self) -> int:
        """Number of tests."""
        return self.weight.size

    def add(self, rows: pa.RecordBatch, hold_steps: int, *, weighted: bool) -> None:
        """Add rows of the episodes table, all of them with a cut-in."""
        self.values = np.hstack([self.values, cut_in_conditions(rows, hold_steps)])
        self.weight = np.r_[
            self.weight, np.exp(floats(rows.column("log_weight"))) if weighted else np.ones(rows.num_rows)
        ]


@dataclass(frozen=True)
class Contrast:
    """Two groups of tests, all or only those outside the boundary, and the quantities that tell them apart.

    The most telling comes first; there is none where there is too little to compare.
    """

    outside: bool
    crashes: Group
    others: Group
    bands: tuple[Band, ...]

    @property
    def telling(self) -> tuple[Band, ...]:
        """Bands that chance does not explain."""
        return tuple(band for band in self.bands if band.significant)

    @property
    def sentence(self) -> str:
        """What to say about it, in words."""
        where = " outside the boundary" if self.outside else ""
        if not self.crashes.n:
            return f"No test{where} crashed, so there is nothing to compare."
        if not self.bands:
            return (
                f"With {count(self.crashes.n)} crashes{where} and {count(self.others.n)} cut-ins{where} without one, "
                "nothing can be said about what crashes have in common."
            )
        if not self.telling:
            return (
                f"Nothing stands out: no quantity recorded at the cut-in tells {count(self.crashes.n)} crashes{where} "
                f"from {count(self.others.n)} cut-ins{where} without a crash better than chance would (p = "
                f"{self.bands[0].p_value:.2g} for the most telling)."
            )
        first = self.telling[0]
        had = f"{CONDITIONS[first.quantity].phrase} of {band_in_words(first)}"
        if not self.outside:
            return (
                f"{percent(first.crash_share)} of the crash rate comes from cut-ins with {had}; "
                f"{percent(first.other_share)} of all cut-ins without a crash are like that."
            )
        of = "All" if first.n_crashes == self.crashes.n else f"{count(first.n_crashes)} of"
        return (
            f"{of} {count(self.crashes.n)} crashes{where} happened with {had}; {percent(first.other_share)} of the "
            f"{count(self.others.n)} tests there without a crash were like that."
        )


def band_in_words(band: Band) -> str:
    """``30.0 to 30.5 m/s``, ``at most 7.9 m``."""
    unit, low, high = CONDITIONS[band.quantity].unit, decimal(band.low), decimal(band.high)
    if math.isinf(band.low):
        return f"any {unit}" if math.isinf(band.high) else f"at most {high} {unit}"
    if math.isinf(band.high):
        return f"at least {low} {unit}"
    return f"{low} {unit}" if band.low == band.high else f"{low} to {high} {unit}"


def crash_contrast(run: RunFolder) -> Contrast:
    """Compare the tests of a run."""
    first_outside = None if run.shells is None else run.shells.n_inside
    crashes, others = Group(), Group()
    hold_steps = round(run.campaign.environment.acceleration_hold_s / STEP_S)
    for batch in run.episodes(*COLUMNS, "outcome", "component", "log_weight"):
        compared = pc.and_(pc.is_valid(batch.column("cut_in_step")), pc.invert(_ended(batch, FAILED)))
        if first_outside is not None:
            compared = pc.and_(compared, pc.greater_equal(batch.column("component"), first_outside))
        crashed = _ended(batch, CRASH)
        for tests, most, wanted in ((crashes, MOST_CRASHES, crashed), (others, MOST_OTHERS, pc.invert(crashed))):
            rows = batch.filter(pc.and_(compared, wanted)).slice(0, most - tests.n)
            if rows.num_rows:
                tests.add(rows, hold_steps, weighted=first_outside is None)
        if crashes.n == MOST_CRASHES and others.n == MOST_OTHERS:
            break
    bands: list[Band] = []
    if min(crashes.n, others.n) >= FEWEST_CRASHES:
        crash = np.arange(crashes.n + others.n) < crashes.n
        bands = telling_bands(np.hstack([crashes.values, others.values]), crash, np.r_[crashes.weight, others.weight])
    return Contrast(first_outside is not None, crashes, others, tuple(bands))


def _ended(batch: pa.RecordBatch, outcome: int) -> pa.Array:
    return pc.equal(batch.column("outcome").cast(pa.string()), OUTCOMES[outcome])


def contrast_plot(contrast: Contrast) -> Plot | None:
    """Draw one panel for each of the most telling quantities, its distribution among crashes and others with the band.

    None where none stands out.
    """
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
    ticks = " Each mark at the foot is a crash." if contrast.crashes.n <= TICKED_CRASHES else ""
    weighted = "" if contrast.outside else " Both are weighted to naturalistic driving."
    caption = (
        f"Orange: {count(contrast.crashes.n)} crashes; grey: {count(contrast.others.n)} tests without one. Shaded: the "
        f"band in which crashes are most over-represented.{weighted}{ticks} What lies beyond a panel counts in its "
        "outermost bar."
    )
    return Plot("contrast", figure, alt, caption)


def _draw(axes: Axes, contrast: Contrast, band: Band) -> None:
    crashes, others = (tests.values[band.quantity] for tests in (contrast.crashes, contrast.others))
    edges = np.linspace(*_range(crashes, others, band), BARS + 1)
    axes.axvspan(max(band.low, edges[0]), min(band.high, edges[-1]), color=VERMILLION, alpha=0.15, linewidth=0)
    grey = _shares(others, contrast.others.weight, edges)
    axes.stairs(grey, edges, fill=True, color=GREY, alpha=0.6, label="no crash")
    axes.stairs(_shares(crashes, contrast.crashes.weight, edges), edges, color=VERMILLION, linewidth=1.5, label="crash")
    if contrast.crashes.n <= TICKED_CRASHES:
        seen = np.clip(crashes, edges[0], edges[-1])
        axes.plot(seen, np.zeros_like(seen), "|", color=VERMILLION, markersize=7, clip_on=False)
    axes.set_xlim(float(edges[0]), float(edges[-1]))
    axes.set_ylim(0.0, 1.35 * axes.get_ylim()[1])
    condition = CONDITIONS[band.quantity]
    axes.set_xlabel(f"{condition.name}, {condition.unit}")
    only_horizontal_grid(axes)


def _range(crashes: FloatArray, others: FloatArray, band: Band) -> tuple[float, float]:
    """From and to which value a panel shows: nearly all tests without a crash, most crashes, and the band."""
    ends = [end for end in (band.low, band.high) if np.isfinite(end)]
    for values, shown in ((others, OTHERS_SHOWN), (crashes, CRASHES_SHOWN)):
        known = values[np.isfinite(values)]
        if known.size:
            ends += np.quantile(known, shown).tolist()
    low, high = min(ends), max(ends)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _shares(values: FloatArray, weight: FloatArray, edges: FloatArray) -> FloatArray:
    known = ~np.isnan(values)
    held, _ = np.histogram(np.clip(values[known], edges[0], edges[-1]), edges, weights=weight[known])
    return 100.0 * held / max(float(weight.sum()), np.finfo(float).tiny)
