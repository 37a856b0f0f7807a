"""Numbers of a family's file, each with its provenance and within its limits, and a file that is made of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

from pydantic import AfterValidator, BaseModel, Field, model_validator

from harness.campaign.drivers import MAX_CONFIGURED_SPEED_MPS
from harness.campaign.sections import Section
from harness.campaign.yaml_text import read_yaml
from harness.files import content_hash
from harness.problems import broken_rule, describe_found
from harness.vehicles.kinematics import STEP_S


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


def within(low: float, high: float) -> AfterValidator:
    """Refuse a value, or an end of its range, outside of [low, high]."""

    def checked(number: Number) -> Number:
        for key, values in (("value", [number.value]), ("range", number.range or [])):
            if outside := [each for each in values if not low <= each <= high]:
                expected = f"{'a number' if key == 'value' else 'numbers'} from {low:g} to {high:g}"
                raise broken_rule(key, f"{outside[0]:g}", expected, "Correct the value.")
        return number

    return AfterValidator(checked)


# Wide limits: what a law makes of its numbers is judged where it is loaded.
Coefficient = Annotated[Number, within(-1000.0, 1000.0)]
LogScale = Annotated[Number, within(-50.0, 50.0)]
Scale = Annotated[Number, within(0.001, 1000.0)]
Gain = Annotated[Number, within(0.0, 100.0)]
Gap = Annotated[Number, within(0.0, 300.0)]  # 4 km of road hold two of them and 25 s at 100 m/s
Speed = Annotated[Number, within(0.0, MAX_CONFIGURED_SPEED_MPS)]
Rate = Annotated[Number, within(-MAX_CONFIGURED_SPEED_MPS, MAX_CONFIGURED_SPEED_MPS)]
Acceleration = Annotated[Number, within(-4.0, 2.0)]  # of everyday driving
Braking = Annotated[Number, within(0.0, 20.0)]
Time = Annotated[Number, within(0.0, 100.0)]
Share = Annotated[Number, within(0.0, 1.0)]
DegreesOfFreedom = Annotated[Number, within(2.0, 1000.0)]  # below 2 more than 1e-4 lies outside of the t table


def ordered(*ranges: tuple[str, str], equal: bool) -> Any:
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


def in_whole_steps(number: Number) -> Number:
    """Refuse a time that is not a multiple of the step."""
    steps = number.value / STEP_S
    if abs(steps - round(steps)) >= 1e-9:
        expected, mend = f"a multiple of the {STEP_S:g} s step", f"The nearest one is {round(steps) * STEP_S:g}."
        raise broken_rule("value", f"{number.value:g}", expected, mend)
    return number


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

    _ranges = ordered(("v_min_mps", "v_max_mps"), ("r1_min_m", "r1_max_m"), equal=False)


class SpeedsAndGaps(Section):
    """Laws of a vehicle's speed, and of the gap that people keep to the one ahead (`harness.families.flow`)."""

    v_location_mps: Coefficient
    v_scale_mps: Scale
    v_shape: Coefficient
    r1_shift_m: Coefficient
    r1_shift_u_m: Coefficient
    r1_log_mean: Coefficient
    r1_log_mean_u: Coefficient
    r1_log_sd: LogScale
    r1_log_sd_u: LogScale


class LeftOpen(NamedTuple):
    """What data leave open of a traffic: numbers by name at the two ``ends`` of what they may be.

    ``where`` says where nothing was seen, else it is empty and ``highest`` the end of what is stated of a ``share``.
    """

    where: str
    ends: tuple[Mapping[str, float], Mapping[str, float]]
    share: float | None = None
    highest: float | None = None


class ParameterFile(Section):
    """Numbers of a traffic in sections, each with its provenance; a file may be ``like`` one of a ``folder``.

    ``replicates`` names a ``file`` of numbers that other data would have given, with its ``sha256``; None without one.
    ``blocks`` are sections whose numbers are fitted together, by what they are called. Of one whose data have all kinds
    of events nothing more is to be said.
    """

    folder: ClassVar[Path]
    replicates: ClassVar[Any]
    blocks: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({})

    @model_validator(mode="before")
    @classmethod
    def _is_like_another(cls, given: Any) -> Any:
        return completed(given, cls.folder) if isinstance(given, dict) else given

    @property
    def kinds(self) -> Any:
        """Kinds of events of which data may have none (`harness.families.cut_in.sections.AcceptanceSteps`), or None."""
        return None

    @property
    def unseen(self) -> str:
        """Where the data had no event; empty where they had."""
        return "" if (kinds := self.kinds) is None else kinds.where(kinds.without_events)

    def left_open(self) -> LeftOpen | None:
        """What data leave open."""
        return None

    def numbers(self) -> dict[str, Number]:
        """Flat ``section__name``, of those in a list ``section__name__0`` and so on → number, with its provenance."""
        found: dict[str, Any] = {}
        for section, of in self:
            for name, entry in of if isinstance(of, Section) else ():
                found[f"{section}__{name}"] = entry
                listed = enumerate(entry if isinstance(entry, list) else ())
                found |= {f"{section}__{name}__{i}": each for i, each in listed}
        return {name: entry for name, entry in found.items() if isinstance(entry, Number)}

    def values(self) -> dict[str, float]:
        """The same without provenance."""
        return {name: number.value for name, number in self.numbers().items()}

    def with_values(self, values: Mapping[str, float]) -> Self:
        """Other values by their flat names, as of a row of replicates; a `ValueError` where one is not allowed."""
        content = self.model_dump()
        for name, value in values.items():
            place: Any = content
            for key in name.split("__"):
                place = place[int(key) if isinstance(place, list) else key]
            place |= {"value": value, "range": None}
        return type(self).model_validate(content)

    def content_hash(self) -> str:
        """Hash of the numbers alone: a corrected note does not change a campaign."""
        return content_hash(json.dumps(self.values(), sort_keys=True).encode())


@cache
def _shipped(file: Path) -> dict[str, Any]:
    return completed(read_yaml(file)[0], file.parent)


def completed(given: dict[str, Any], folder: Path) -> dict[str, Any]:
    """What a file says, with numbers and sections that it leaves out as in the shipped one that it is ``like``."""
    if "like" not in given:
        return given
    shipped = sorted(file.stem for file in folder.glob("*.yaml"))
    if given["like"] not in shipped:
        found, expected = describe_found(given["like"]), f"one of {', '.join(shipped)}"
        raise broken_rule("like", found, expected, "Name one, or write all numbers.")
    whole = dict(_shipped(folder / f"{given['like']}.yaml"))
    for key, of in given.items():
        both = isinstance(of, dict) and isinstance(whole.get(key), dict)
        whole[key] = {**whole[key], **of} if both else of
    return {key: of for key, of in whole.items() if key != "like"}
