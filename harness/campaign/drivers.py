"""Built-in driver models: as stand-ins for the unknown AV, and as the AV itself."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from harness.campaign.section import Positive, Probability, Section, StepTime

MAX_CONFIGURED_SPEED_MPS = 60.0


class IDMParameters(Section):
    """Intelligent driver model; defaults are SM-I's (environment.md: [cutin] except where said)."""

    acceleration_mps2: Positive = Field(2.0, le=20.0, description="maximum acceleration, the alpha of Table I [cutin]")
    comfortable_deceleration_mps2: Positive = Field(3.0, le=20.0, description="b [cutin]")
    time_headway_s: float = Field(1.0, ge=0.0, le=10.0, description="T [cutin]")
    minimum_gap_m: float = Field(2.0, ge=0.0, le=50.0, description="s0 [cutin]")
    desired_speed_mps: Positive = Field(40.0, le=MAX_CONFIGURED_SPEED_MPS, description="v0 [assumed]")
    min_acceleration_mps2: float = Field(-4.0, ge=-20.0, le=0.0, description="hardest braking a_min [assumed]")
    max_acceleration_mps2: Positive = Field(2.0, le=20.0, description="upper clip [paper]")


class FVDMParameters(Section):
    """Full velocity difference model; defaults from the co-author's code ([cutin]) except where said."""

    kappa_per_s: Positive = Field(0.85, le=20.0, description="sensitivity to the optimal velocity [cutin]")
    lambda_per_s: float = Field(0.5, ge=0.0, le=20.0, description="sensitivity to the speed difference [assumed]")
    max_speed_mps: Positive = Field(40.0, le=MAX_CONFIGURED_SPEED_MPS, description="v_max [assumed]")
    v1: Positive = Field(6.75, le=1000.0, description="V1 of the optimal velocity function [cutin]")
    v2: Positive = Field(7.91, le=1000.0, description="V2 of the optimal velocity function [cutin]")
    c1_per_m: Positive = Field(0.13, le=100.0, description="C1 of the optimal velocity function [cutin]")
    c2: float = Field(1.57, ge=-1000.0, le=1000.0, description="C2 of the optimal velocity function [cutin]")
    min_acceleration_mps2: float = Field(-1.0, ge=-20.0, le=0.0, description="hardest braking a_min [paper: -1, -6]")
    max_acceleration_mps2: Positive = Field(2.0, le=20.0, description="upper clip [paper]")


class ConstantParameters(Section):
    """A vehicle that accelerates in the same way whatever happens before it: 0 never brakes."""

    acceleration_mps2: float = Field(0.0, ge=-20.0, le=20.0, description="its acceleration [assumed]")

    @property
    def min_acceleration_mps2(self) -> float:
        """Its only acceleration (m/s²)."""
        return self.acceleration_mps2

    @property
    def max_acceleration_mps2(self) -> float:
        """Its only acceleration (m/s²)."""
        return self.acceleration_mps2


class IDM(Section):
    """A vehicle that follows the intelligent driver model."""

    model: Literal["idm"]
    parameters: IDMParameters = IDMParameters()


class FVDM(Section):
    """A vehicle that follows the full velocity difference model."""

    model: Literal["fvdm"]
    parameters: FVDMParameters = FVDMParameters()


class Constant(Section):
    """A vehicle that does not look ahead."""

    model: Literal["constant"]
    parameters: ConstantParameters = ConstantParameters()


DriverModel = Annotated[IDM | FVDM, Field(discriminator="model")]
BuiltInParameters = IDMParameters | FVDMParameters | ConstantParameters
PARAMETERS: dict[str, type[BuiltInParameters]] = {
    "idm": IDMParameters,
    "fvdm": FVDMParameters,
    "constant": ConstantParameters,
}


class Reflexes(Section):
    """How a driver lags behind its model: surrogates may be late and smooth, but not random."""

    delay_s: StepTime = Field(
        0.0, ge=0.0, le=10.0, description="time after the cut-in during which it keeps its speed [assumed]"
    )
    max_jerk_mps3: Annotated[float, Field(ge=0.1, le=1000.0)] | None = Field(
        None, description="fastest change of its acceleration; unlimited when left out [assumed]"
    )


class Reaction(Reflexes):
    """How a built-in AV lags behind its model, now and then by inattention."""

    inattention_probability: Probability = Field(
        0.0, description="share of episodes in which it reacts later still [assumed]"
    )
    inattention_delay_s: StepTime = Field(
        0.0, ge=0.0, le=10.0, description="how much later it then reacts to the cut-in [assumed]"
    )


def default_surrogates() -> dict[str, DriverModel]:
    """Stand-ins of the paper, from careful to careless."""
    return {
        "SM-I": IDM(model="idm"),
        "SM-II": FVDM(model="fvdm", parameters=FVDMParameters(min_acceleration_mps2=-1.0)),
        "SM-III": FVDM(model="fvdm", parameters=FVDMParameters(min_acceleration_mps2=-6.0)),
    }
