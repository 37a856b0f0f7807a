"""How long BV's lane change shows itself before BV overlaps the AV: the lead of a cut-in.

The hazard is the rate of *crossings*, predicted by the driver who cuts in: R2 and time to collision are taken at the
crossing, beside an AV that goes on as it did. The *onset* of lateral motion is the lead earlier; from then on the AV
may act. The decision precedes the onset: BV does not abort.

The lead is the distance from first lateral motion to overlap over the lateral speed, which is log-normal or gives a
constant lead; it is rounded to whole steps (`harness.vehicles.sideways`). A lead of zero is the cut-in of one step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from harness import elementary
from harness.compiled import compiled_inline
from harness.random_stream import LATERAL, uniform
from harness.vehicles.kinematics import STEP_S
from harness.vehicles.sideways import TO_OVERLAP_M
from harness.vocabulary import FloatArray


class LateralMotion(NamedTuple):
    """``distance_m`` from first lateral motion to overlap, and P(lead ≤ k steps), ``cumulative`` (k + 1,)."""

    distance_m: float
    cumulative: FloatArray

    @property
    def present(self) -> bool:
        """Whether cut-ins may take time here."""
        return self.cumulative.size > 1


def constant_lead(lead_s: float = 0.0, distance_m: float = TO_OVERLAP_M) -> LateralMotion:
    """The same lead for every cut-in; by default none, as in the paper."""
    cumulative = np.zeros(round(lead_s / STEP_S) + 1)
    cumulative[-1] = 1.0
    return LateralMotion(distance_m, cumulative)


def log_normal_speed(distance_m: float, median_mps: float, log_sd: float, longest_s: float) -> LateralMotion:
    """Leads of a log-normal lateral speed; longer ones count as the longest."""
    upto_s = STEP_S * (np.arange(round(longest_s / STEP_S) + 1) + 0.5)
    cumulative = special.ndtr((elementary.log(median_mps) - elementary.log(distance_m / upto_s)) / log_sd)
    cumulative[-1] = 1.0
    return LateralMotion(distance_m, cumulative)


@compiled_inline
def draw_lead(cut: int, seed: int, episode: int, lateral: LateralMotion) -> int:
    """Lead (steps) of the cut-in in step ``cut``."""
    last = lateral.cumulative.size - 1
    if last == 0:
        return 0
    u = uniform(seed, episode, LATERAL, cut)
    lead = 0
    while lead < last and lateral.cumulative[lead] <= u:
        lead += 1
    return lead
