"""Numbers of a family's file, each with its provenance and within its limits, and a file that is made of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args

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


# Wide limits: whether a law is sound with its numbers is checked when it is loaded.
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
    """What data leave open of a traffic: numbers by name, at the two ``ends`` of what they may be.

    Either ``where`` says where no event was seen, or a ``share`` is stated with a range that ends at ``highest``.
    """

    where: str
    ends: tuple[Mapping[str, float], Mapping[str, float]]
    share: float | None = None
    highest: float | None = None


class ParameterFile(Section):
    """Numbers of a traffic in sections, each with its provenance; a file may be ``like`` one of a ``folder``.

    ``replicates`` names a ``file`` of numbers that other data would have given, with its ``sha256``; None without one.
    ``blocks`` are sections whose numbers are fitted together, by a name of them all. A family whose data may lack some
    kinds of events overrides `kinds` and `left_open`.
    """

    folder: ClassVar[Path]
    replicates: ClassVar[Any]
    blocks: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({})

    @model_validator(mode="before")
    @classmethod
    def _is_like_another(cls, content: Any) -> Any:
        if not isinstance(content, dict):
            return content
        field = cls.model_fields.get("format")  # a family may have none
        own = get_args(field.annotation) if field else ()
        if own and (found := content.get("format", own[0])) not in own:
            mend = "Name the file of this scenario: `harness fit` writes one for each."
            raise broken_rule("format", describe_found(found), own[0], mend)
        return completed(content, cls.folder)

    @property
    def kinds(self) -> Any:
        """Kinds of events that data may lack, as `harness.families.cut_in.sections.AcceptanceSteps`; None for none."""
        return None

    @property
    def unseen(self) -> str:
        """Where the data had no event; empty if they had events everywhere."""
        return "" if (kinds := self.kinds) is None else kinds.where(kinds.without_events)

    def left_open(self) -> LeftOpen | None:
        """Numbers that the data do not determine; None if there are none."""
        return None

    def numbers(self) -> dict[str, Number]:
        """Numbers with their provenance by ``section__name``, those of a list by ``section__name__0`` and so on."""
        flat: dict[str, Any] = {}
        for name, section in self:
            for key, entry in section if isinstance(section, Section) else ():
                flat[f"{name}__{key}"] = entry
                items = entry if isinstance(entry, list) else ()
                flat |= {f"{name}__{key}__{i}": item for i, item in enumerate(items)}
        return {name: entry for name, entry in flat.items() if isinstance(entry, Number)}

    def values(self) -> dict[str, float]:
        """The same without provenance."""
        return {name: number.value for name, number in self.numbers().items()}

    def with_values(self, values: Mapping[str, float]) -> Self:
        """The same with other values by their flat names; a `ValueError` where one is not allowed."""
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


def completed(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The content of a file; what it leaves out is taken from the shipped file that it is ``like``."""
    if "like" not in content:
        return content
    shipped = sorted(file.stem for file in folder.glob("*.yaml"))
    if content["like"] not in shipped:
        found, expected = describe_found(content["like"]), f"one of {', '.join(shipped)}"
        raise broken_rule("like", found, expected, "Name one, or the file of this scenario.")
    merged = dict(_shipped(folder / f"{content['like']}.yaml"))
    for key, part in content.items():
        both_sections = isinstance(part, dict) and isinstance(merged.get(key), dict)
        merged[key] = {**merged[key], **part} if both_sections else part
    return {key: part for key, part in merged.items() if key != "like"}
