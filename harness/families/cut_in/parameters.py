"""The numbers of the naturalistic driving environment, each with its provenance, from a schema-validated file."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, model_validator

from harness.campaign.drivers import MAX_CONFIGURED_SPEED_MPS
from harness.campaign.problems import broken_rule, describe_found
from harness.campaign.sections import Section
from harness.campaign.yaml_text import read_yaml
from harness.families.cut_in.lateral import LateralMotion, constant_lead, log_normal_speed
from harness.families.cut_in.laws import Wish
from harness.numbers import plain
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M
from harness.vocabulary import ACCELERATIONS_MPS2, FloatArray, Record

SHIPPED_FOLDER = Path(__file__).parent
FIXED = {"step_s": STEP_S, "vehicle_length_m": VEHICLE_LENGTH_M}
"""What the compiled motion and SUMO's network are made for: no file can change it, but campaigns' hashes contain it."""
LONGEST_LEAD_S = 10.0
_SPEED = ("speed_median_mps", "speed_log_sd", "longest_lead_s")
_AXES = (("v_mps", "v_log"), ("r1_m", "r1_log"), ("r1dot_mps", "r1dot_log"))
_NOT_IN_RECORD = ("lateral__", "hazard_table__", "acceptance_steps__")


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
    """Refuse a value, or an end of its range, outside of [low, high]."""

    def checked(number: Number) -> Number:
        for key, values in (("value", [number.value]), ("range", number.range or [])):
            if outside := [each for each in values if not low <= each <= high]:
                expected = f"{'a number' if key == 'value' else 'numbers'} from {low:g} to {high:g}"
                raise broken_rule(key, f"{outside[0]:g}", expected, "Correct the value.")
        return number

    return AfterValidator(checked)


# Wide limits: what a law makes of its numbers is judged by `harness.families.cut_in.loading`.
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
    """Hazard of the cut-in; coefficients in whose place there is a table are left out (`REPLACED`)."""

    intercept: Coefficient | None = None
    u: Coefficient | None = None
    log_gap: Coefficient | None = None
    rate: Coefficient | None = None
    rate_squared: Coefficient | None = None
    u_squared: Coefficient | None = None
    rate_scale_mps: Scale | None = None
    rate_clamp_mps: Speed | None = None
    ignore_share: Share | None = None
    accept_ttc_s: Time | None = None
    accept_scale_s: Scale | None = None
    max_probability_1s: Annotated[Number, _within(1e-6, 0.5)]


_ACCEPTANCE = ("ignore_share", "accept_ttc_s", "accept_scale_s")
REPLACED = {
    "hazard_table": tuple(name for name in CutIn.model_fields if name not in (*_ACCEPTANCE, "max_probability_1s")),
    "acceptance_steps": _ACCEPTANCE,
}
"""Coefficients of ``cut_in`` in whose place a table may stand."""


def _rising(knots: list[Number]) -> list[Number]:
    for before, after in pairwise(each.value for each in knots):
        if not before < after:
            raise broken_rule("", f"{after:g} after {before:g}", "numbers that rise", "Sort them, each once.")
    return knots


_LENGTH = Field(min_length=1, max_length=64)
Knots = Annotated[list[Rate], _LENGTH, AfterValidator(_rising)]
Gaps = Annotated[list[Gap], _LENGTH, AfterValidator(_rising)]
LogHazards = Annotated[list[LogScale], _LENGTH]


def _require_one_each(self: Section, key: str, of: str, more: int = 0) -> None:
    numbers, wanted = getattr(self, key), len(getattr(self, of)) + more
    if numbers is not None and len(numbers) != wanted:
        expected = f"{wanted}, one for each of {of}" + " and one beyond" * more
        raise broken_rule(key, f"{len(numbers)} numbers", expected, "Add what is missing, or delete what is too much.")


class HazardTable(Section):
    """Logarithm of the wish to change lanes (per second): three functions, linear between knots, that are added."""

    v_mps: Knots
    v_log: LogHazards
    r1_m: Gaps
    r1_log: LogHazards
    r1dot_mps: Knots
    r1dot_log: LogHazards

    @model_validator(mode="after")
    def _one_value_per_knot(self) -> Self:
        for knots, logs in _AXES:
            _require_one_each(self, logs, knots)
        return self

    def wish(self) -> Wish:
        """As kernels read it."""
        return Wish(*(np.column_stack([_values(getattr(self, name)) for name in axis]) for axis in _AXES))


SMALLEST_SHARE = 1e-12
"""Of lane changes that are accepted."""


class AcceptanceSteps(Section):
    """Share of wished lane changes carried out, by time to collision with the AV: below each of ``ttc_s``, and above.

    ``events`` were seen in each step, and ``exposure`` of them would have been expected if each wish were carried out.
    """

    ttc_s: Annotated[list[Annotated[Number, _within(0.01, 100.0)]], _LENGTH, AfterValidator(_rising)]
    share: list[Annotated[Number, _within(SMALLEST_SHARE, 1.0)]]
    events: list[Annotated[int, Field(ge=0)]] | None = None
    exposure: list[Annotated[float, Field(ge=0.0)]] | None = None

    @model_validator(mode="after")
    def _one_share_per_step(self) -> Self:
        _require_one_each(self, "share", "ttc_s", 1)
        for key in ("events", "exposure"):
            _require_one_each(self, key, "share")
        return self

    def steps(self) -> FloatArray:
        """Upper ends (s) and shares (n, 2), as kernels read them."""
        return np.column_stack([[*_values(self.ttc_s), math.inf], _values(self.share)])

    @property
    def without_events(self) -> list[int]:
        """Steps in which no lane change was seen."""
        return [step for step, events in enumerate(self.events or ()) if not events]

    def where(self, some: Collection[int]) -> str:
        """Times to collision of steps, neighbours together: ``TTC < 2 s``, ``TTC 3 to 5 s``."""
        ends = [0.0, *_values(self.ttc_s), math.inf]
        low = [plain(ends[step]) for step in some if step - 1 not in some]
        high = [plain(ends[step + 1]) for step in some if step + 1 not in some]
        between = (f"TTC {a} to {b} s" if float(a) else f"TTC < {b} s" for a, b in zip(low, high, strict=True))
        return " and ".join(between).replace("to inf s", "s and more")


def _values(numbers: Sequence[Number]) -> list[float]:
    return [each.value for each in numbers]


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


OF_REPLICATES = b"harness fit"
"""Key in the metadata of a file of replicates: hash of the numbers that they belong to."""


class Replicates(Section):
    """Which environments other data of the same kind would have given: a file beside this one, and its hash."""

    file: Annotated[str, Field(pattern=r"^[^\x00-\x1f]+$", examples=["mine.replicates.parquet"])]
    sha256: str


@cache
def _shipped(name: str) -> dict[str, Any]:
    return _completed(read_yaml(SHIPPED_FOLDER / f"{name}.yaml")[0])


def _completed(given: dict[str, Any]) -> dict[str, Any]:
    """What a file says, with numbers and sections that it leaves out as in the environment that it is ``like``."""
    if "like" not in given:
        return given
    shipped = sorted(file.stem for file in SHIPPED_FOLDER.glob("*.yaml"))
    if given["like"] not in shipped:
        found, expected = describe_found(given["like"]), f"one of {', '.join(shipped)}"
        raise broken_rule("like", found, expected, "Name one, or write all numbers.")
    whole = dict(_shipped(given["like"]))
    for key, of in given.items():
        both = isinstance(of, dict) and isinstance(whole.get(key), dict)
        whole[key] = {**whole[key], **of} if both else of
    return {key: of for key, of in whole.items() if key != "like"}


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
    hazard_table: HazardTable | None = None
    acceptance_steps: AcceptanceSteps | None = None
    lateral: Lateral | None = None
    replicates: Replicates | None = None

    @model_validator(mode="before")
    @classmethod
    def _is_like_another(cls, given: Any) -> Any:
        return _completed(given) if isinstance(given, dict) else given

    @model_validator(mode="after")
    def _one_law_each(self) -> Self:
        """Wish and acceptance have a formula or a table."""
        for table, names in REPLACED.items():
            absent = getattr(self, table) is None
            wrong = [name for name in names if (getattr(self.cut_in, name) is None) == absent]
            if wrong and absent:
                expected = f"all coefficients of the formula, or a section {table}"
                raise broken_rule("cut_in", f"neither {', '.join(wrong)} nor {table}", expected, "Add what is missing.")
            if wrong:
                found = f"{', '.join(wrong)} besides the section {table}"
                raise broken_rule("cut_in", found, "one of both: the table takes their place", "Delete one of both.")
        return self

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

    @property
    def unseen(self) -> str:
        """Times to collision at which the data that it was fitted to have no lane change; empty without such."""
        steps = self.acceptance_steps
        return "" if steps is None or steps.exposure is None else steps.where(steps.without_events)

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

    def wish(self) -> Wish:
        """Table of the wish to change lanes; empty where it has a formula."""
        return Wish(*np.empty((3, 0, 2))) if self.hazard_table is None else self.hazard_table.wish()

    def accepted(self) -> FloatArray:
        """Steps of the acceptance (n, 2); none where it has a formula."""
        return np.empty((0, 2)) if self.acceptance_steps is None else self.acceptance_steps.steps()

    def lateral_motion(self) -> LateralMotion:
        """How long cut-ins show themselves."""
        return constant_lead() if self.lateral is None else self.lateral.motion()

    def content_hash(self) -> str:
        """Hash of the numbers alone: a corrected note does not change a campaign."""
        return content_hash(json.dumps(self.values(), sort_keys=True).encode())


def content_hash(content: bytes) -> str:
    """Hash of some bytes, as files name it."""
    return hashlib.sha256(content).hexdigest()[:16]


def parameter_record(parameters: EnvironmentParameters, *, lane_change_level: float, hold_s: float) -> Record:
    """The numbers as kernels read them: ``section__name``, lane-changing ``level``, ``hold_steps``, ``max_steps``.

    Coefficients in whose place there is a table are no numbers: records of all environments are of one type.
    """
    absent = {f"cut_in__{name}": math.nan for names in REPLACED.values() for name in names}
    given = {**absent, **parameters.values(), "level": lane_change_level}
    numbers = {name: value for name, value in given.items() if not name.startswith(_NOT_IN_RECORD)}
    steps = {"hold_steps": round(hold_s / STEP_S), "max_steps": round(numbers["scenario__duration_s"] / STEP_S)}
    dtype = [*((name, "f8") for name in numbers), *((name, "i8") for name in steps)]
    record: Record = np.array([(*numbers.values(), *steps.values())], dtype)[0]
    return record
