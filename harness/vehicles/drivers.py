"""Longitudinal driver models that AVs and surrogates share: as kernels read them, and those without a memory.

These are IDM, FVDM, and one that does not look ahead. `references` has those that remember a danger, and how
a driver lags behind its model: it may react late, change its acceleration slowly, or not look. It keeps its speed until
it reacts to the event; then its model decides, as fast as its jerk limit allows.

Only + − × ÷ √ and explicit products are used (and ``math.tanh``, inside compiled code alone), so that every caller gets
the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from itertools import chain
from typing import NamedTuple, get_args

import numpy as np

from harness.campaign.drivers import NATURAL, BuiltInParameters, Reaction, ReferenceParameters, Reflexes
from harness.campaign.vehicle import AutomatedVehicle
from harness.compiled import compiled_inline
from harness.vocabulary import Record, RecordArray

IDM_KIND, FVDM_KIND, CONSTANT_KIND = 0, 1, 2
CAREFUL_COMPETENT_KIND, FUZZY_SAFETY_KIND = -1, -2
"""Below zero: those that remember a danger."""
SMALLEST_GAP_M = 0.1
"""Gap below which the models see this gap: they divide by it."""

MOST_FOLLOWERS = 62
"""Whether they crash are bits of one integer."""


class Followers(NamedTuple):
    """Drivers (D,) to be put in the AV's place: at most `MOST_FOLLOWERS`, without inattention.

    ``envelope`` is the place of a driver that crashes wherever another one does, so that the others need not be driven
    where it does not; -1 for none. Crashes count with an impact above ``counts_above_mps``, all of them at 0.
    """

    drivers: RecordArray
    envelope: int = -1
    counts_above_mps: float = 0.0


@cache
def driver_dtype() -> np.dtype[np.void]:
    """All parameters of all models, and of how a driver lags; 0 where a model has none, NaN for natural headways."""
    derived = "reaction_steps", "used_up_steps", "max_jerk_mps3", "inattention_probability", "perceives_lateral_m"
    model_fields = (model.model_fields for model in get_args(BuiltInParameters))
    numbers = dict.fromkeys(chain(*model_fields, derived, ("twice_root_mps2",)))
    whole_numbers = "kind", "delay_steps", "inattention_steps", "cruises"
    return np.dtype([(name, np.int64) for name in whole_numbers] + [(name, np.float64) for name in numbers])


def driver_records(
    drivers: Sequence[BuiltInParameters], reactions: Sequence[Reflexes] | None = None, *, see_onset: bool = False
) -> RecordArray:
    """Parameters of driver models as kernels read them, shape (number of drivers,); by default all react at once.

    ``see_onset`` says that cut-ins take time: reference drivers then perceive and evaluate them, and none of their
    delay has been used up before.
    """
    remembering = CAREFUL_COMPETENT_KIND, FUZZY_SAFETY_KIND
    kinds = dict(zip(get_args(BuiltInParameters), (IDM_KIND, FVDM_KIND, CONSTANT_KIND, *remembering), strict=True))
    records: RecordArray = np.zeros(len(drivers), driver_dtype())
    for record, driver, reaction in zip(records, drivers, reactions or [Reflexes()] * len(drivers), strict=True):
        record["kind"], record["cruises"] = kinds[type(driver)], 1
        for name in records.dtype.names or ():
            value = getattr(driver, name, record[name])
            record[name] = math.nan if value == NATURAL else value
        record["reaction_steps"] = 10.0 * record["reaction_time_s"]
        squared = record["acceleration_mps2"] * record["comfortable_deceleration_mps2"]
        record["twice_root_mps2"] = 2.0 * math.sqrt(squared)  # once, as roots are slow in kernels
        record["max_jerk_mps3"] = math.inf if reaction.max_jerk_mps3 is None else reaction.max_jerk_mps3
        record["perceives_lateral_m"] = reaction.perceives_lateral_m
        record["delay_steps"] = round(reaction.delay_s * 10.0)
        if see_onset and isinstance(driver, ReferenceParameters):
            record["used_up_steps"] = 0.0
            record["delay_steps"] += round(10.0 * driver.risk_evaluation_s)
        if isinstance(reaction, Reaction):
            record["inattention_probability"] = reaction.inattention_probability
            record["inattention_steps"] = round(reaction.inattention_delay_s * 10.0)
    return records


def av_records(av: AutomatedVehicle, *, see_onset: bool = False) -> RecordArray:
    """Parameters of a built-in AV, shape (1,); of an AV that something else drives, shape (0,)."""
    if isinstance(av.parameters, BuiltInParameters):
        records = driver_records([av.parameters], [av.reaction], see_onset=see_onset)
        records["cruises"] = av.takes_over == "first_braking"
        return records
    return driver_records([])


@compiled_inline
def idm_acceleration(driver: Record, headway_s: float, speed: float, lead_speed: float, gap: float) -> float:
    """Intelligent driver model, before clipping (m/s²), with the time headway T.

    a = α [1 − (v/v0)⁴ − (s*/s)²], s* = s0 + max(0, v T + v (v − v_lead)/(2 √(α b))).
    """
    closing = (speed * (speed - lead_speed)) / driver.twice_root_mps2
    desired = driver.minimum_gap_m + max(0.0, speed * headway_s + closing)
    ratio = speed / driver.desired_speed_mps
    squared = ratio * ratio
    close = desired / gap
    return float(driver.acceleration_mps2 * (1.0 - squared * squared - close * close))


@compiled_inline
def fvdm_shape(driver: Record, gap: float) -> float:
    """Tanh(C1 s − C2): the part of the optimal velocity that depends on the gap, increasing in it."""
    return math.tanh(driver.c1_per_m * gap - driver.c2)


@compiled_inline
def fvdm_acceleration(driver: Record, speed: float, lead_speed: float, shape: float) -> float:
    """Full velocity difference model, before clipping (m/s²), increasing in ``shape``.

    a = κ (V(s) − v) + λ (v_lead − v), V(s) = v_max [V1 + V2 tanh(C1 s − C2)]/(V1 + V2).
    """
    optimal = (driver.max_speed_mps * (driver.v1 + driver.v2 * shape)) / (driver.v1 + driver.v2)
    return float(driver.kappa_per_s * (optimal - speed) + driver.lambda_per_s * (lead_speed - speed))


@compiled_inline
def driver_acceleration(driver: Record, speed: float, lead_speed: float, gap: float) -> float:
    """Acceleration (m/s²) of a driver behind a leader at a bumper-to-bumper gap (m), clipped to its limits."""
    if driver.kind == CONSTANT_KIND:
        return float(driver.acceleration_mps2)
    limited = max(gap, SMALLEST_GAP_M)
    if driver.kind == IDM_KIND:
        a = idm_acceleration(driver, driver.time_headway_s, speed, lead_speed, limited)
    else:
        a = fvdm_acceleration(driver, speed, lead_speed, fvdm_shape(driver, limited))
    return float(min(max(a, driver.min_acceleration_mps2), driver.max_acceleration_mps2))
