"""Built-in driver models, which drive an AV or stand in for it: their parameters, and how drivers lag behind them."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, ValidationInfo, ValidatorFunctionWrapHandler, WrapValidator, model_validator
from pydantic_core import PydanticKnownError

from harness.campaign.sections import Positive, Probability, Section, StepTime
from harness.problems import broken_rule

MAX_CONFIGURED_SPEED_MPS = 60.0
NATURAL = "natural"
"""Headway that people keep."""

Strength = Annotated[float, Field(gt=0.0, le=20.0)]
Braking = Annotated[float, Field(ge=-20.0, le=0.0)]
Gap = Annotated[float, Field(ge=0.0, le=50.0)]
Delay = Annotated[float, Field(ge=0.0, le=10.0)]
Speed = Annotated[float, Field(gt=0.0, le=MAX_CONFIGURED_SPEED_MPS)]


class Following(Section):
    """How an intelligent driver model follows; defaults are SM-I's."""

    acceleration_mps2: Strength = Field(2.0, description="maximum acceleration, the alpha of Table I [cutin]")
    comfortable_deceleration_mps2: Strength = Field(3.0, description="b [cutin]")
    time_headway_s: Delay = Field(1.0, description="T [cutin]")
    minimum_gap_m: Gap = Field(2.0, description="s0 [cutin]")
    desired_speed_mps: Speed = Field(40.0, description="v0 [assumed]")
    max_acceleration_mps2: Strength = Field(2.0, description="upper clip [assumed]")


class IDMParameters(Following):
    """Intelligent driver model; defaults are SM-I's."""

    min_acceleration_mps2: Braking = Field(-4.0, description="hardest braking a_min [assumed]")


class FVDMParameters(Section):
    """Full velocity difference model."""

    kappa_per_s: Positive = Field(0.85, le=20.0, description="sensitivity to the optimal velocity [cutin]")
    lambda_per_s: float = Field(0.5, ge=0.0, le=20.0, description="sensitivity to the speed difference [assumed]")
    max_speed_mps: Speed = Field(40.0, description="v_max [assumed]")
    v1: Positive = Field(6.75, le=1000.0, description="V1 [cutin]")
    v2: Positive = Field(7.91, le=1000.0, description="V2 [cutin]")
    c1_per_m: Positive = Field(0.13, le=100.0, description="C1 [cutin]")
    c2: float = Field(1.57, ge=-1000.0, le=1000.0, description="C2 [cutin]")
    min_acceleration_mps2: Braking = Field(-1.0, description="hardest braking a_min [paper: -1, -6]")
    max_acceleration_mps2: Strength = Field(2.0, description="upper clip [assumed]")


class ConstantParameters(Section):
    """The same acceleration whatever happens: 0 never brakes."""

    acceleration_mps2: float = Field(0.0, ge=-20.0, le=20.0, description="its acceleration [assumed]")

    @property
    def min_acceleration_mps2(self) -> float:
        """Its only acceleration (m/s²)."""
        return self.acceleration_mps2

    @property
    def max_acceleration_mps2(self) -> float:
        """Its only acceleration (m/s²)."""
        return self.acceleration_mps2


class ReferenceParameters(Following):
    """What the reference drivers of UN Regulation No. 157 share: when they react, and how they follow.

    The regulation's cut-in takes time: BV moves sideways, and the driver has seen and evaluated the risk when their
    sides are still ``evaluated_at_m`` apart. Where ours is a step, after which they overlap, the driver has used up
    ``evaluated_at_m / lateral_speed_mps`` of its delay by then. Where cut-ins take time it sees them, evaluates them
    for ``risk_evaluation_s``, and nothing stands in for that.
    """

    reaction_time_s: float = Field(0.75, ge=0.0, le=5.0)
    """from the evaluated risk to the brakes [JRC-FSM: CC_rt, FSM_rt]"""
    lateral_speed_mps: Positive = Field(1.8, le=10.0)
    """of BV, where the cut-in is one step [JRC-FSM: 0.72 m in 0.4 s]"""
    evaluated_at_m: float = Field(0.505, ge=0.0, le=5.0)
    """lateral distance when the risk has been evaluated [JRC-FSM: CC_calc_dist_to_react]"""
    risk_evaluation_s: StepTime = Field(0.4, ge=0.0, le=5.0)
    """from seeing a cut-in that takes time to the evaluated risk [JRC-FSM: 0.4 s]"""
    time_headway_s: Delay | Literal["natural"] = 1.0  # type: ignore[assignment]
    """T; natural: as people keep it, where the vehicle follows from the start [cutin]"""
    perceives_braking_mps2: float = Field(3.0, ge=0.0, le=20.0)
    """how hard the vehicle ahead brakes when that is a danger, 0: at once [assumed; 5 by the regulation, UN R157]"""
    min_acceleration_mps2: Braking = -7.59294
    """hardest braking, 0.774 g [JRC-FSM: CC_max_deceleration]"""
    braking_jerk_mps3: Positive = Field(12.65, le=1000.0)
    """build-up of braking, 0.774 g in 0.6 s [JRC-FSM: CC_min_jerk]"""
    following_min_acceleration_mps2: Braking = Field(-4.0, description="hardest braking of that IDM [assumed]")

    @property
    def used_up_steps(self) -> float:
        """How much of its reaction time has passed by a dangerous cut-in, in steps."""
        return 10.0 * self.evaluated_at_m / self.lateral_speed_mps

    @property
    def delay_after_event_s(self) -> float:
        """How long after the cut-in it begins to brake (s); not before it, however slowly BV comes over."""
        return max(0.0, 10.0 * self.reaction_time_s - self.used_up_steps) / 10.0


class CarefulCompetentParameters(ReferenceParameters):
    """The careful and competent human driver of UN Regulation No. 157."""

    critical_ttc_s: Strength = 2.0
    """time to collision below which it brakes [JRC-FSM: CC_critical_ttc]"""
    coasting_mps2: float = Field(0.4, ge=0.0, le=5.0, description="deceleration off the accelerator [JRC-FSM]")


class FuzzySafetyParameters(ReferenceParameters):
    """The fuzzy safety model of UN Regulation No. 157."""

    comfortable_braking_mps2: Strength = Field(4.0, description="braking in anticipation [JRC-FSM: FSM_br_min]")
    hard_braking_mps2: Strength = Field(6.0, description="braking in the greatest danger [JRC-FSM: FSM_br_max]")
    leader_braking_mps2: Strength = Field(7.0, description="how hard the vehicle ahead may brake [JRC-FSM: FSM_bl]")
    standstill_gap_m: Gap = Field(2.0, description="gap not counted in anticipation [JRC-FSM: FSM_margin_dist]")
    safe_margin_m: Positive = Field(2.0, le=50.0, description="gap beyond the safe one [JRC-FSM: FSM_margin_safe_dist]")

    @model_validator(mode="after")
    def _hard_is_harder(self) -> Self:
        if self.hard_braking_mps2 < self.comfortable_braking_mps2:
            found = f"{self.hard_braking_mps2:g}, below comfortable_braking_mps2 {self.comfortable_braking_mps2:g}"
            expected = "at least as much: it brakes the harder the greater the danger"
            raise broken_rule("hard_braking_mps2", found, expected, "Exchange them, or make them equal.")
        return self


BuiltInParameters = (
    IDMParameters | FVDMParameters | ConstantParameters | CarefulCompetentParameters | FuzzySafetyParameters
)
ModelName = Literal["idm", "fvdm", "constant", "r157-cc", "r157-fsm"]
PARAMETERS: dict[str, type[BuiltInParameters]] = dict(
    zip(get_args(ModelName), get_args(BuiltInParameters), strict=True)
)


def _of_the_model(value: Any, _by_trial: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
    """Parameters of the model that is named beside them; those of a controller stay as they are.

    Not by trial of a union: a controller's parameters that look like the IDM's would become those.
    """
    if "model" not in info.data:
        # A wrong model is an error of its own; complaints about parameters of a guessed model would only confuse.
        return IDMParameters()
    if (model := info.data["model"]) is not None:
        return PARAMETERS[model].model_validate(value)
    if not isinstance(value, dict):
        raise PydanticKnownError("dict_type")
    return value


Parameters = WrapValidator(_of_the_model, json_schema_input_type=BuiltInParameters | dict[str, Any])


class Reflexes(Section):
    """How a driver lags behind its model: surrogates may be late and smooth, but not random."""

    delay_s: StepTime = Field(0.0, ge=0.0, le=20.0)
    """time after it has perceived an event in which it does what it did [assumed]"""
    max_jerk_mps3: Annotated[float, Field(ge=0.1, le=1000.0)] | None = None
    """fastest change of acceleration; none: unlimited [assumed]"""
    perceives_lateral_m: float = Field(0.375, ge=0.0, le=10.0)
    """how far BV has come over when it is seen, where cut-ins take time [JRC-FSM: 0.375 of wandering]"""


class Surrogate(Section):
    """A stand-in for the unknown AV, with its reflexes; the shipped libraries have some."""

    model: ModelName = Field(description="driver model")
    parameters: Annotated[BuiltInParameters, Parameters] = Field(default_factory=dict, validate_default=True)
    """of the model, as under av"""
    reaction: Reflexes = Reflexes()

    @property
    def delay_after_event_s(self) -> float | None:
        """How long after a dangerous cut-in a reference driver begins to brake (s); None for any other driver."""
        if not isinstance(self.parameters, ReferenceParameters):
            return None
        return self.parameters.delay_after_event_s + self.reaction.delay_s

    def identity(self) -> dict[str, Any]:
        """What decides what it does; reflexes where it has some."""
        return self.model_dump(exclude={"reaction"} if self.reaction == Reflexes() else None)


class OwnSurrogate(Surrogate):
    """A class of the user's own in the AV's place, ``my.py:Model``: a batch controller made without arguments."""

    controller: str = Field(pattern=r"^.+\.py:\w+$")
    model: ModelName = "constant"  # of the record that stands for it; nothing is asked of that

    def identity(self) -> dict[str, Any]:
        """Its file counts, wherever it lies (`harness.resolved`)."""
        return {"controller": self.controller.rpartition(":")[2]}


def default_surrogates() -> dict[str, Surrogate]:
    """Stand-ins of the paper, from careful to careless."""
    brakes_1, brakes_6 = (FVDMParameters(min_acceleration_mps2=limit) for limit in (-1.0, -6.0))
    return {
        "SM-I": Surrogate(model="idm"),
        "SM-II": Surrogate(model="fvdm", parameters=brakes_1),
        "SM-III": Surrogate(model="fvdm", parameters=brakes_6),
    }


class Reaction(Reflexes):
    """How a built-in AV lags behind its model, now and then by inattention."""

    inattention_probability: Probability = 0.0
    """share of tests in which it reacts later still [assumed]"""
    inattention_delay_s: StepTime = Field(0.0, ge=0.0, le=10.0, description="how much later it then reacts [assumed]")
