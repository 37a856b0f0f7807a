"""The numbers of the naturalistic driving environment, each with its provenance, from a schema-validated file."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from harness.arrays import Record

SHIPPED_FOLDER = Path(__file__).parent


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Number(_Frozen):
    """A value and where it comes from (the tags are explained in the shipped file)."""

    value: float
    source: Literal["paper", "itsc", "ndd", "cutin", "openacc", "assumed", "fitted", "user"]
    note: str = ""


class Scenario(_Frozen):
    """Time step, horizon and vehicles."""

    step_s: Number
    duration_s: Number
    vehicle_length_m: Number


class FitRange(_Frozen):
    """Where the fits hold; states outside are clamped to it."""

    v_min_mps: Number
    v_max_mps: Number
    v_centre_mps: Number
    v_scale_mps: Number
    r1_min_m: Number
    r1_max_m: Number
    r1_centre_m: Number
    r1_scale_m: Number


class InitialState(_Frozen):
    """Distribution of (v_BV, R1, R1dot, R2, R2dot)."""

    v_location_mps: Number
    v_scale_mps: Number
    v_shape: Number
    r1_shift_m: Number
    r1_shift_u_m: Number
    r1_log_mean: Number
    r1_log_mean_u: Number
    r1_log_sd: Number
    r1_log_sd_u: Number
    r1dot_df: Number
    r1dot_location_mps: Number
    r1dot_location_u: Number
    r1dot_location_w: Number
    r1dot_location_uw: Number
    r1dot_location_uu: Number
    r1dot_log_scale: Number
    r1dot_log_scale_u: Number
    r1dot_log_scale_w: Number
    r1dot_log_scale_ww: Number
    r1dot_min_ttc_s: Number
    r2_min_m: Number
    r2_max_m: Number
    r2dot_min_mps: Number
    r2dot_max_mps: Number


class FreeDriving(_Frozen):
    """Accelerations of LV, and of BV after its cut-in."""

    df: Number
    location_mps2: Number
    log_scale: Number
    log_scale_u: Number
    log_scale_uu: Number
    brake_logit: Number
    brake_logit_u: Number
    brake_slope_s2pm: Number
    brake_max_mps2: Number


class CarFollowing(_Frozen):
    """Accelerations of BV behind LV."""

    gain_rate_per_s: Number
    gain_gap_per_s2: Number
    median_gap_m: Number
    median_gap_v: Number
    median_gap_vv: Number
    standstill_m: Number
    smallest_gap_m: Number
    closing_threshold_mps2: Number
    closing_gain: Number
    near_gap_m: Number
    near_mean_max_mps2: Number
    df: Number
    log_scale: Number
    log_scale_rate: Number
    rate_cap_mps: Number


class Guard(_Frozen):
    """What keeps BV off LV; part of p."""

    lead_braking_mps2: Number
    own_braking_mps2: Number
    horizon_s: Number
    margin_m: Number


class CutIn(_Frozen):
    """Hazard of the cut-in."""

    intercept: Number
    u: Number
    log_gap: Number
    rate: Number
    rate_squared: Number
    u_squared: Number
    rate_scale_mps: Number
    rate_clamp_mps: Number
    ignore_share: Number
    accept_ttc_s: Number
    accept_scale_s: Number
    max_probability_1s: Number


class EnvironmentParameters(_Frozen):
    """All numbers of the environment."""

    format: Literal["ndd-overtaking"]
    version: Literal[1]
    scenario: Scenario
    fit_range: FitRange
    initial_state: InitialState
    free_driving: FreeDriving
    car_following: CarFollowing
    guard: Guard
    cut_in: CutIn

    def values(self) -> dict[str, float]:
        """Flat ``section__name`` → value, without provenance."""
        return {
            f"{section}__{name}": number["value"]
            for section, numbers in self.model_dump().items()
            if isinstance(numbers, dict)
            for name, number in numbers.items()
        }

    def content_hash(self) -> str:
        """Hash of the numbers alone: a corrected note does not change a campaign."""
        return hashlib.sha256(json.dumps(self.values(), sort_keys=True).encode()).hexdigest()[:16]


def parameter_record(parameters: EnvironmentParameters, *, lane_change_level: float, hold_s: float) -> Record:
    """The numbers as the kernels read them.

    Returns
    -------
    record
        One float64 field ``section__name`` per number, and ``level`` (of lane changing), ``hold_steps``, ``max_steps``.
    """
    numbers = parameters.values()
    step_s = numbers["scenario__step_s"]
    extra = {
        "level": lane_change_level,
        "hold_steps": round(hold_s / step_s),
        "max_steps": round(numbers["scenario__duration_s"] / step_s),
    }
    fields = [(name, "f8") for name in (*numbers, "level")] + [("hold_steps", "i8"), ("max_steps", "i8")]
    record: Record = np.zeros(1, dtype=fields)[0]
    for name, value in {**numbers, **extra}.items():
        record[name] = value
    return record
