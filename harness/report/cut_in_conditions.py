"""What LV, BV and AV were doing when BV decided to cut in, worked out from the stored rows.

A row holds the initial state and LV's and BV's draws, which determine their motion up to the cut-in; the AV's speed
there follows from BV's and the recorded R2dot, whether it kept its speed or not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pyarrow as pa

from harness.arrays import FloatArray, IntArray
from harness.maneuvers import ACCELERATIONS_MPS2, CUT_IN
from harness.report.run_folder import floats
from harness.vehicles.kinematics import STEP_S


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
