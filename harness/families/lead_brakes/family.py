"""The vehicle ahead brakes: how hard, for how long, and how abruptly; what follows is motion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
from scipy.special import ndtri

from harness import elementary
from harness.campaign.sections import Section
from harness.families.following.family import START_FACTS, FollowingFamily
from harness.families.following.parameters import FollowingParameters, grid_of
from harness.families.lead_brakes.words import HEADWAY, HELD, PEAK, WORDS
from harness.families.numbers import Number, Share, ordered, within
from harness.families.protocol import Column
from harness.vocabulary import FloatArray, RecordArray

PEAK_BIN_MPS2 = 0.2
N_HELD = 11
"""Quantiles of the time that a peak is held; the last cell is a stop."""
_Peak = Annotated[Number, within(0.2, 15.0)]


class Braking(Section):
    """Law of the peak, of the time for which it is held, and of the jerk, which do not depend on each other."""

    lowest_peak_mps2: _Peak
    highest_peak_mps2: _Peak
    peak_scale_mps2: Annotated[Number, within(0.01, 10.0)]
    held_median_s: Annotated[Number, within(0.1, 30.0)]
    held_log_sd: Annotated[Number, within(0.01, 3.0)]
    stop_share: Share
    gentle_jerk_mps3: Annotated[Number, within(0.1, 1000.0)]
    abrupt_jerk_mps3: Annotated[Number, within(0.1, 1000.0)]

    _ranges = ordered(("lowest_peak_mps2", "highest_peak_mps2"), equal=False)


class LeadBrakesParameters(FollowingParameters):
    """All numbers of the family."""

    format: Literal["lead-brakes"]
    version: Literal[1]
    braking: Braking

    folder, blocks = Path(__file__).parent, {**FollowingParameters.blocks, "peak": ("braking",)}

    def grid(self) -> tuple[RecordArray, FloatArray]:
        """Peaks exponential above the lowest, in bins, the tail in the last; log-normal times; two jerks."""
        b = self.braking
        low, high, scale = b.lowest_peak_mps2.value, b.highest_peak_mps2.value, b.peak_scale_mps2.value
        n_bins = max(round((high - low) / PEAK_BIN_MPS2), 1)
        edges = np.asarray(low + PEAK_BIN_MPS2 * np.arange(n_bins + 1), np.float64)
        beyond = np.append(elementary.exp(-(edges[:-1] - low) / scale), 0.0)
        peaks, of_peak = edges[:-1] + 0.5 * PEAK_BIN_MPS2, -np.diff(beyond)
        quantiles = (np.arange(N_HELD) + 0.5) / N_HELD
        held = np.append(b.held_median_s.value * elementary.exp(b.held_log_sd.value * ndtri(quantiles)), math.inf)
        of_held = np.append(np.full(N_HELD, (1.0 - b.stop_share.value) / N_HELD), b.stop_share.value)
        jerks = np.array([b.gentle_jerk_mps3.value, b.abrupt_jerk_mps3.value])
        return grid_of(peak_mps2=(peaks, of_peak), held_s=(held, of_held), jerk_mps3=(jerks, np.full(2, 0.5)))


class LeadBrakes(FollowingFamily):
    """See `harness.families.following.family`."""

    name = "lead_brakes"
    vehicles = ("LV", "AV")
    principal, ahead = 0, -1
    columns = (
        *START_FACTS,
        Column("peak_mps2", pa.float64(), "m/s²", "how hard the vehicle ahead brakes"),
        Column("held_s", pa.float64(), "s", "for how long so hard, infinite: to standstill"),
        Column("jerk_mps3", pa.float64(), "m/s³", "how abruptly"),
    )
    ladders = {False: "ladder-lead-1"}
    default_parameters = "lead-brakes-1"
    fitter = "harness.families.lead_brakes.fitting:BrakingFitter"
    crosses, words = -1, WORDS
    maps = ((HEADWAY, PEAK), (HELD, PEAK))
    stride = 37  # of 840 events; each stride that divides them meets one jerk alone
    model = LeadBrakesParameters

    def told(self, facts: Mapping[str, Any]) -> str:
        held = f"for {facts['held_s']:.1f} s" if facts["held_s"] < math.inf else "to a standstill"
        return f"with {facts['peak_mps2']:.1f} m/s² {held}"


LEAD_BRAKES = LeadBrakes()
