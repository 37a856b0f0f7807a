"""The crashes worth looking at: the hardest impacts, and those that carry most of the estimate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harness.report.fine_histogram import Floats
from harness.vehicles.kinematics import STEP_S

CANDIDATES = 50
"""Kept per ranking: more than are shown, because with a share of traces only some of the worst have one."""


@dataclass(frozen=True)
class Crash:
    """One crash as its row in ``episodes`` describes it; units as in the schema."""

    episode: int
    impact_speed_mps: float
    crash_time_s: float
    log_weight: float
    cut_in_step: float
    cut_in_r2_m: float
    cut_in_r2dot_mps: float
    v_bv_mps: float
    n_control_steps: float
    component: int

    @property
    def weight(self) -> float:
        """What this one crash adds to the sum that is the estimate: likelihood ratio, or p_s/n_s in a shell."""
        return math.exp(self.log_weight)

    @property
    def cut_in_time_s(self) -> float:
        """Time at the start of the step in which BV cut in."""
        return STEP_S * self.cut_in_step


class WorstCrashes:
    """The first `CANDIDATES` crashes by one key, kept while streaming; ties go to the smaller episode index."""

    def __init__(self, key: str) -> None:
        self.key = key
        self.crashes: list[Crash] = []

    def add(self, columns: dict[str, Floats], is_crash: npt.NDArray[np.bool_]) -> None:
        """Offer a batch: ``columns`` by field name, each of shape (m,)."""
        rows = np.flatnonzero(is_crash & np.isfinite(columns[self.key]))
        best = rows[np.lexsort((columns["episode"][rows], -columns[self.key][rows]))[:CANDIDATES]]
        self.crashes += [_crash(columns, int(row)) for row in best]
        self.crashes.sort(key=lambda crash: (-getattr(crash, self.key), crash.episode))
        del self.crashes[CANDIDATES:]


def _crash(columns: dict[str, Floats], row: int) -> Crash:
    return Crash(
        episode=int(columns["episode"][row]),
        impact_speed_mps=float(columns["impact_speed_mps"][row]),
        crash_time_s=float(columns["crash_time_s"][row]),
        log_weight=float(columns["log_weight"][row]),
        cut_in_step=float(columns["cut_in_step"][row]),
        cut_in_r2_m=float(columns["cut_in_r2_m"][row]),
        cut_in_r2dot_mps=float(columns["cut_in_r2dot_mps"][row]),
        v_bv_mps=float(columns["v_bv_mps"][row]),
        n_control_steps=float(columns["n_control_steps"][row]),
        component=int(columns["component"][row]),
    )
