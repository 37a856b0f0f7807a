"""The numbers of the naturalistic driving environment, each with its provenance, from a schema-validated file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, model_validator

from harness.campaign.drivers import MAX_CONFIGURED_SPEED_MPS
from harness.campaign.problems import broken_rule
from harness.campaign.sections import Section
from harness.traffic.lateral import LateralMotion, constant_lead, log_normal_speed
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M
from harness.vocabulary import ACCELERATIONS_MPS2, Record

SHIPPED_FOLDER = Path(__file__).parent
FIXED = {"step_s": STEP_S, "vehicle_length_m": VEHICLE_LENGTH_M}
"""What the compiled motion and SUMO's network are made for: no file can change it, but campaigns' hashes contain it."""
LONGEST_LEAD_S = 10.0
_SPEED = ("speed_median_mps", "speed_log_sd", "longest_lead_s")


class Number(Section):
    """A value and where it comes from (the tags are explained in the shipped file).

    ``se`` is the standard error of a fitted one, ``range`` says where an assumed one may lie; neither changes a test.
    """

    value: float
    source: Literal[
        "paper", "itsc", "ndd", "cutin", "openacc", "published", "assumed", "fitted", "derived", "measured", "user"
    ]
    note: str = ""
    se: Annotated[float, Field(ge=0.0)] | None = None
    range: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None

    @model_validator(mode="after")
    def _range_holds_the_value(self) -> Self:
        if self.range is not None and not self.range[0] <= self.value <= self.range[1]:
            mend = "Name the lower end first, and one that the value is not outside of."
            raise broken_rule("range", f"{self.range}, with the value {self.value:g}", "two ends around it", mend)
        return self


def _within(low: float, high: float) -> AfterValidator:
    """Refuse a value outside of [low, high]."""

    def checked(number: Number) -> Number:
        if not low <= number.value <= high:
            expected = f"a number from {low:g} to {high:g}"
            raise broken_rule("value", f"{number.value:g}", expected, "Correct the value.")
        return number

    return AfterValidator(checked)


# Wide limits: what a law makes of its numbers is judged by `harness.traffic.loading`.
Coefficient = Annotated[Number, _within(-1000.0, 1000.0)]
LogScale = Annotated[Number, _within(-50.0, 50.0)]
Scale = Annotated[Number, _within(0.001, 1000.0)]
Gain = Annotated[Number, _within(0.0, 100.0)]
Gap = Annotated[Number, _within(0.0, 300.0)]  # 4 km of road hold two of them and 25 s at 100 m/s
Speed = Annotated[Number, _within(0.0, MAX_CONFIGURED_SPEED_MPS)]
Rate = Annotated[Number, _within(-MAX_CONFIGURED_SPEED_MPS, MAX_CONFIGURED_SPEED_MPS)]
Acceleration = Annotated[Number, _within(*map(float, ACCELERATIONS_MPS2[[0, -1]]))]
Braking = Annotated[Number, _within(0.0, 20.0)]
Time = Annotated[Number, _within(0.0, 100.0)]
Share = Annotated[Number, _within(0.0, 1.0)]
DegreesOfFreedom = Annotated[Number, _within(2.0, 1000.0)]  # below 2 more than 1e-4 lies outside of the t table


def _ordered(*ranges: tuple[str, str], equal: bool) -> Any:
    """Validator of a section: the ends of each range are in order, and may be ``equal``."""

    def checked(self: BaseModel) -> BaseModel:
        for low, high in ranges:
            least, most = getattr(self, low).value, getattr(self, high).value
            if least > most or (least == most and not equal):
                expected = f"a number {'of at most' if equal else 'below'} {high}"
                mend = "Change places, or correct one of them."
                raise broken_rule(low, f"{least:g}, with {high} {most:g}", expected, mend)
        return self

    return model_validator(mode="after")(checked)


def _whole_steps(number: Number) -> Number:
    steps = number.value / STEP_S
    if abs(steps - round(steps)) >= 1e-9:
        expected, mend = f"a multiple of the {STEP_S:g} s step", f"The nearest one is {round(steps) * STEP_S:g}."
        raise broken_rule("value", f"{number.value:g}", expected, mend)
    return number


class Scenario(Section):
    """Horizon of a test."""

    duration_s: Annotated[Number, _within(1.0, 25.0), AfterValidator(_whole_steps)]
    """At most 25 s: BV's free driving has 256 random numbers for each cut-in, and the road is 4 km long."""


class FitRange(Section):
    """Where the fits hold; states outside are clamped to it."""

    v_min_mps: Speed
    v_max_mps: Speed
    v_centre_mps: Speed
    v_scale_mps: Scale
    r1_min_m: Gap
    r1_max_m: Gap
    r1_centre_m: Gap
    r1_scale_m: Scale

    _ranges = _ordered(("v_min_mps", "v_max_mps"), ("r1_min_m", "r1_max_m"), equal=False)


class InitialState(Section):
    """Distribution of (v_BV, R1, R1dot, R2, R2dot)."""

    v_location_mps: Coefficient
    v_scale_mps: Scale
    v_shape: Coefficient
    r1_shift_m: Coefficient
    r1_shift_u_m: Coefficient
    r1_log_mean: Coefficient
    r1_log_mean_u: Coefficient
    r1_log_sd: LogScale
    r1_log_sd_u: LogScale
    r1dot_df: DegreesOfFreedom
    r1dot_location_mps: Coefficient
    r1dot_location_u: Coefficient
    r1dot_location_w: Coefficient
    r1dot_location_uw: Coefficient
    r1dot_location_uu: Coefficient
    r1dot_log_scale: LogScale
    r1dot_log_scale_u: LogScale
    r1dot_log_scale_w: LogScale
    r1dot_log_scale_ww: LogScale
    r1dot_min_ttc_s: Annotated[Number, _within(0.1, 100.0)]
    r2_min_m: Annotated[Number, _within(0.1, 300.0)]
    r2_max_m: Gap
    r2dot_min_mps: Rate
    r2dot_max_mps: Rate

    _ranges = _ordered(("r2_min_m", "r2_max_m"), ("r2dot_min_mps", "r2dot_max_mps"), equal=True)


class FreeDriving(Section):
    """Accelerations of LV, and of BV after its cut-in."""

    df: DegreesOfFreedom
    location_mps2: Acceleration
    log_scale: LogScale
    log_scale_u: LogScale
    log_scale_uu: LogScale
    brake_logit: LogScale
    brake_logit_u: LogScale
    brake_slope_s2pm: LogScale
    brake_max_mps2: Acceleration


class CarFollowing(Section):
    """Accelerations of BV behind LV."""

    gain_rate_per_s: Gain
    gain_gap_per_s2: Gain
    median_gap_m: Coefficient
    median_gap_v: Coefficient
    median_gap_vv: Coefficient
    standstill_m: Gap
    smallest_gap_m: Scale
    closing_threshold_mps2: Gain
    closing_gain: Gain
    near_gap_m: Gap
    near_mean_max_mps2: Acceleration
    df: DegreesOfFreedom
    log_scale: LogScale
    log_scale_rate: LogScale
    rate_cap_mps: Speed


class Guard(Section):
    """What keeps BV off LV; part of p."""

    lead_braking_mps2: Braking
    own_braking_mps2: Annotated[Number, _within(0.1, 20.0)]
    horizon_s: Annotated[Number, _within(0.0, 10.0)]
    margin_m: Gap


class CutIn(Section):
    """Hazard of the cut-in."""

    intercept: Coefficient
    u: Coefficient
    log_gap: Coefficient
    rate: Coefficient
    rate_squared: Coefficient
    u_squared: Coefficient
    rate_scale_mps: Scale
    rate_clamp_mps: Speed
    ignore_share: Share
    accept_ttc_s: Time
    accept_scale_s: Scale
    max_probability_1s: Annotated[Number, _within(1e-6, 0.5)]


class Lateral(Section):
    """How long cut-ins show themselves before BV overlaps: a constant lead, or a log-normal lateral speed."""

    distance_m: Annotated[Number, _within(0.1, 5.0)]
    lead_s: Annotated[Number, _within(0.0, LONGEST_LEAD_S), AfterValidator(_whole_steps)] | None = None
    speed_median_mps: Annotated[Number, _within(0.05, 20.0)] | None = None
    speed_log_sd: Annotated[Number, _within(0.01, 3.0)] | None = None
    longest_lead_s: Annotated[Number, _within(0.1, LONGEST_LEAD_S), AfterValidator(_whole_steps)] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        named = tuple(name for name in ("lead_s", *_SPEED) if getattr(self, name) is not None)
        if named not in (("lead_s",), _SPEED):
            mend = "A lead is constant, or follows from a lateral speed and is cut off at the longest."
            raise broken_rule("", ", ".join(named) or "neither", f"lead_s alone, or {', '.join(_SPEED)}", mend)
        return self

    def motion(self) -> LateralMotion:
        """As kernels read it."""
        if self.lead_s is not None:
            return constant_lead(self.lead_s.value, self.distance_m.value)
        median, log_sd, longest = (getattr(self, name).value for name in _SPEED)
        return log_normal_speed(self.distance_m.value, median, log_sd, longest)


class EnvironmentParameters(Section):
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
    lateral: Lateral | None = None
    replicates: str | None = None

    @model_validator(mode="after")
    def _av_has_a_speed(self) -> Self:
        """It starts at v_BV - R2dot."""
        slowest = self.fit_range.v_min_mps.value - self.initial_state.r2dot_max_mps.value
        fastest = self.fit_range.v_max_mps.value - self.initial_state.r2dot_min_mps.value
        if slowest < 0.0 or fastest > MAX_CONFIGURED_SPEED_MPS:
            found = f"speeds of the AV (v_BV - R2dot) from {slowest:g} to {fastest:g} m/s"
            mend = "Narrow r2dot_min_mps and r2dot_max_mps, or v_min_mps and v_max_mps of fit_range."
            raise broken_rule("initial_state", found, f"speeds from 0 to {MAX_CONFIGURED_SPEED_MPS:g} m/s", mend)
        return self

    def _entries(self, section: str) -> list[tuple[str, Any]]:
        of = getattr(self, section)
        return list(of) if isinstance(of, Section) else []

    def numbers(self) -> dict[str, Number]:
        """Flat ``section__name``, of those in a list ``section__name__0`` and so on → number, with its provenance."""
        found: dict[str, Number] = {}
        for section in type(self).model_fields:
            for name, entry in self._entries(section):
                listed = enumerate(entry) if isinstance(entry, list) else ()
                named = {f"{section}__{name}": entry, **{f"{section}__{name}__{i}": each for i, each in listed}}
                found |= {key: each for key, each in named.items() if isinstance(each, Number)}
        return found

    def values(self) -> dict[str, float]:
        """The same without provenance; what is fixed is among them."""
        given = {name: number.value for name, number in self.numbers().items()}
        return {**{f"scenario__{name}": value for name, value in FIXED.items()}, **given}

    def with_values(self, values: Mapping[str, float]) -> Self:
        """Other values by their flat names, as of a row of replicates; a `ValueError` where one is not allowed."""
        content = self.model_dump()
        for name, value in values.items():
            place: Any = content
            for key in name.split("__"):
                place = place[int(key) if isinstance(place, list) else key]
            place |= {"value": value, "range": None}
        return type(self).model_validate(content)

    def lateral_motion(self) -> LateralMotion:
        """How long cut-ins show themselves."""
        return constant_lead() if self.lateral is None else self.lateral.motion()

    def content_hash(self) -> str:
        """Hash of the numbers alone: a corrected note does not change a campaign."""
        return hashlib.sha256(json.dumps(self.values(), sort_keys=True).encode()).hexdigest()[:16]


def parameter_record(parameters: EnvironmentParameters, *, lane_change_level: float, hold_s: float) -> Record:
    """The numbers as kernels read them: ``section__name``, lane-changing ``level``, ``hold_steps``, ``max_steps``."""
    read = {name: value for name, value in parameters.values().items() if not name.startswith("lateral__")}
    numbers = {**read, "level": lane_change_level}
    steps = {"hold_steps": round(hold_s / STEP_S), "max_steps": round(numbers["scenario__duration_s"] / STEP_S)}
    dtype = [*((name, "f8") for name in numbers), *((name, "i8") for name in steps)]
    record: Record = np.array([(*numbers.values(), *steps.values())], dtype)[0]
    return record
