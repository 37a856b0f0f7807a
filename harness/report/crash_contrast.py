"""What crashes have in common: conditions at the cut-in of tests that crashed, against those of tests that did not.

Of tests from shells those outside the library's boundary are compared: they are one stratum, drawn by naturalistic
probability, so that every test counts the same. Under the other methods all cut-ins are, with their likelihood ratios.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.outcomes import CRASH, FAILED, OUTCOMES
from harness.report.cut_in_conditions import COLUMNS, CONDITIONS, cut_in_conditions
from harness.report.fine_histogram import Floats
from harness.report.number_format import MINUS, count, percent
from harness.report.run_folder import RunFolder
from harness.report.shard_tables import episode_batches
from harness.report.shells_result import ShellsResult
from harness.report.telling_bands import Band, telling_bands
from harness.vehicles.kinematics import STEP_S

MOST_CRASHES, MOST_OTHERS = 5_000, 20_000
"""Tests compared, the first of each kind: tests come in random order, so that this is a fair sample."""
FEWEST_CRASHES = 3
"""Fewer have nothing in common that chance would not give them."""


@dataclass(frozen=True)
class Contrast:
    """Two groups of tests and the quantities that tell them apart, the most telling first.

    Attributes
    ----------
    outside : bool
        Whether only tests outside the boundary were compared.
    crashes, others : ndarray, shape (Q, n)
        Values of `CONDITIONS`.
    crash_weight, other_weight : ndarray, shape (n,)
    bands : tuple of Band
        Empty where there is too little to compare.
    """

    outside: bool
    crashes: Floats
    others: Floats
    crash_weight: Floats
    other_weight: Floats
    bands: tuple[Band, ...]

    @property
    def n_crashes(self) -> int:
        """Crashes compared."""
        return self.crash_weight.size

    @property
    def n_others(self) -> int:
        """Tests without a crash compared."""
        return self.other_weight.size

    @property
    def telling(self) -> tuple[Band, ...]:
        """Bands that chance does not explain."""
        return tuple(band for band in self.bands if band.significant)

    @property
    def sentence(self) -> str:
        """What to say about it, in words."""
        where = " outside the boundary" if self.outside else ""
        if not self.bands:
            return self._too_few(where)
        if not self.telling:
            return (
                f"Nothing stands out: no quantity recorded at the cut-in tells {count(self.n_crashes)} crashes{where} "
                f"from {count(self.n_others)} cut-ins{where} without a crash better than chance would (p = "
                f"{self.bands[0].p_value:.2g} for the most telling)."
            )
        first = self.telling[0]
        had = f"{CONDITIONS[first.quantity].phrase} of {band_in_words(first)}"
        if not self.outside:
            return (
                f"{percent(first.crash_share)} of the crash rate comes from cut-ins with {had}; "
                f"{percent(first.other_share)} of all cut-ins without a crash are like that."
            )
        of = "All" if first.n_crashes == self.n_crashes else f"{count(first.n_crashes)} of"
        return (
            f"{of} {count(self.n_crashes)} crashes{where} happened with {had}; {percent(first.other_share)} of the "
            f"{count(self.n_others)} tests there without a crash were like that."
        )

    def _too_few(self, where: str) -> str:
        if not self.n_crashes:
            return f"No test{where} crashed, so there is nothing to compare."
        return (
            f"With {count(self.n_crashes)} crashes{where} and {count(self.n_others)} cut-ins{where} without one, "
            "nothing can be said about what crashes have in common."
        )


def band_in_words(band: Band) -> str:
    """``30.0 to 30.5 m/s``, ``at most 7.9 m``."""
    unit, low, high = CONDITIONS[band.quantity].unit, _tenths(band.low), _tenths(band.high)
    if math.isinf(band.low):
        return f"any {unit}" if math.isinf(band.high) else f"at most {high} {unit}"
    if math.isinf(band.high):
        return f"at least {low} {unit}"
    return f"{low} {unit}" if band.low == band.high else f"{low} to {high} {unit}"


def _tenths(value: float) -> str:
    return f"{value:,.1f}".replace("-", MINUS)


def crash_contrast(run: RunFolder, shells: ShellsResult | None) -> Contrast:
    """Compare the tests of a run.

    Raises
    ------
    RunFolderError
        If a shard is damaged.
    """
    n_inside = 0 if shells is None else sum(shell.inside for shell in shells.shells)
    crashes, others = _Rows(MOST_CRASHES), _Rows(MOST_OTHERS)
    hold_steps = round(float(run.campaign["environment"]["acceleration_hold_s"]) / STEP_S)
    for batch in episode_batches(run, (*COLUMNS, "outcome", "component", "log_weight")):
        compared = _compared(batch, n_inside if shells else None)
        for rows, wanted in ((crashes, True), (others, False)):
            rows.add(batch.filter(pc.and_(compared, _crashed(batch, wanted))), hold_steps, weighted=shells is None)
        if crashes.full and others.full:
            break
    bands: list[Band] = []
    if crashes.n >= FEWEST_CRASHES and others.n >= FEWEST_CRASHES:
        crash = np.arange(crashes.n + others.n) < crashes.n
        bands = telling_bands(np.hstack([crashes.values, others.values]), crash, np.r_[crashes.weight, others.weight])
    return Contrast(shells is not None, crashes.values, others.values, crashes.weight, others.weight, tuple(bands))


class _Rows:
    """The first tests of one kind, with their weights."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.values: Floats = np.zeros((len(CONDITIONS), 0))
        self.weight: Floats = np.zeros(0)

    @property
    def n(self) -> int:
        return self.weight.size

    @property
    def full(self) -> bool:
        return self.n >= self.most

    def add(self, batch: pa.RecordBatch, hold_steps: int, *, weighted: bool) -> None:
        batch = batch.slice(0, self.most - self.n)
        if not batch.num_rows:
            return
        log_weight = batch.column("log_weight").to_numpy(zero_copy_only=False)
        self.values = np.hstack([self.values, cut_in_conditions(batch, hold_steps)])
        self.weight = np.r_[self.weight, np.exp(log_weight) if weighted else np.ones(batch.num_rows)]


def _compared(batch: pa.RecordBatch, first_outside: int | None) -> pa.Array:
    """Rows with a cut-in that did not fail; of tests from shells those outside."""
    valid = pc.and_(pc.is_valid(batch.column("cut_in_step")), pc.invert(_ended(batch, FAILED)))
    return (
        valid if first_outside is None else pc.and_(valid, pc.greater_equal(batch.column("component"), first_outside))
    )


def _crashed(batch: pa.RecordBatch, wanted: bool) -> pa.Array:
    crashed = _ended(batch, CRASH)
    return crashed if wanted else pc.invert(crashed)


def _ended(batch: pa.RecordBatch, outcome: int) -> pa.Array:
    return pc.equal(batch.column("outcome").cast(pa.string()), OUTCOMES[outcome])
