"""The automated vehicle under test: who drives it, and what it may ask for."""

from __future__ import annotations

import hashlib
import re
import shlex
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, Field, field_validator, model_validator

from harness.campaign.drivers import PARAMETERS, BuiltInParameters, ModelName, Parameters, Reaction
from harness.campaign.sections import Positive, Section, StepTime, Whole
from harness.problems import NAME_PATTERN, broken_rule, listed

AV_SOURCES = ("model", "controller", "sumo", "traci", "fmu")
READS_NO_PARAMETERS = {
    "sumo": "Write vType attributes under av.sumo itself.",
    "traci": "Give them to your program in av.traci.command.",
    "fmu": "Write them under av.fmu.start_values.",
}
"""Sources of an AV beside which parameters would be lost, and where to write them."""
CONTROLLER_PATTERN = r"^(.+\.py|([A-Za-z_][A-Za-z0-9_.]*|.+\.py):[A-Za-z_][A-Za-z0-9_]*)$"


def with_another_driver(data: dict[str, Any], source: str, value: Any) -> dict[str, Any]:
    """A campaign's data for another driver (`AV_SOURCES`): without what belongs to the present one alone."""
    av, world = data.get("av") or {}, data.get("world")
    if not isinstance(av, dict):
        return data
    current = next((name for name in AV_SOURCES if av.get(name) is not None), "model")
    av = {key: value for key, value in av.items() if key == source or key not in AV_SOURCES}
    if source != current:
        belongings = {"parameters", "reaction", "traci_style"} | ({"before_event"} if source == "model" else set())
        belongings |= {"takes_over"} if source in ("sumo", "traci") else set()
        av = {key: value for key, value in av.items() if key not in belongings}
    elif source == "model" and isinstance(parameters := av.get("parameters"), dict) and value in PARAMETERS:
        before, after = (set(PARAMETERS.get(name, BaseModel).model_fields) for name in (av.get("model", "idm"), value))
        av["parameters"] = {key: value for key, value in parameters.items() if key in after or key not in before}
    if source in ("sumo", "traci") and isinstance(world, dict) and world.get("engine") == "twin":
        data = {**data, "world": {key: value for key, value in world.items() if key != "engine"}}
    return {**data, "av": av}


class Limits(Section):
    """What an AV may ask for; beyond it a test fails instead of being simulated with nonsense."""

    min_acceleration_mps2: float = Field(-15.0, ge=-50.0, le=0.0, description="hardest braking it may ask for")
    max_acceleration_mps2: Positive = Field(10.0, le=50.0, description="hardest acceleration it may ask for")
    step_time_s: Positive = Field(10.0, le=3600.0, description="time that one call may take")
    construction_time_s: Positive = Field(60.0, le=86_400.0, description="time that its import or constructor may take")


class TraciProcess(Section):
    """The user's program, connected to a real SUMO as an ordinary TraCI client."""

    command: str = Field(min_length=1, description="starts the program; {port} and {cells} are filled in")
    connect_time_s: Positive = Field(60.0, le=3600.0, description="time it may take to connect")
    restarts: Whole = Field(3, ge=0, le=100, description="times that it is started again when it has ended")
    allow_public: bool = False
    """run also on a machine with a public address: SUMO's server listens on every address"""

    @field_validator("command")
    @classmethod
    def _command_can_be_filled_in(cls, command: str) -> str:
        try:
            problem = None if shlex.split(command.format(port=0, cells=0)) else "no word"
        except (ValueError, LookupError, AttributeError) as error:
            problem = f"{type(error).__name__}: {error}"
        if problem is not None:
            expected = "a program and its arguments, with {port} and {cells} the only things in braces"
            mend = "Double a brace that is meant as itself: {{ and }}."
            raise broken_rule("", f"{problem[:60]}, in {command[:200]!r}", expected, mend)
        return command

    def words(self, port: int, cells: int) -> list[str]:
        """The command, filled in, word by word."""
        return shlex.split(self.command.format(port=port, cells=cells))


class TraciStyle(Section):
    """Of a TraCI script that runs as it is."""

    ego: str | None = Field(None, min_length=1)
    """name of the vehicle that it commands; none: found by trying it"""
    accel_mps2: Positive = 2.6
    """bounds what its commands lead to, as accel of its vehicle type does; by default that of SUMO's default type"""
    decel_mps2: Positive = 4.5
    """the same of braking"""


class FmuController(Section):
    """An FMI 2.0 co-simulation FMU as controller."""

    file: str = Field(min_length=1, description="path of the .fmu, relative to the campaign file")
    inputs: dict[str, str] = Field(default_factory=dict)
    """input variable of each observation (speed_mps, gap_m, …); empty: inputs named as one"""
    output: str | None = Field(None, min_length=1)
    """output variable that is the acceleration, m/s2; none: the only one"""
    start_values: dict[str, float] = Field(default_factory=dict, description="values set before initialisation")


class AutomatedVehicle(Section):
    """The automated vehicle under test: one of model, controller, sumo, traci and fmu."""

    example: ClassVar[str] = "{controller: my_av.py:MyAV} or {model: r157-cc}"
    model: ModelName | None = Field(None, description="built-in driver model, idm where nothing is named")
    controller: str | None = Field(
        None, pattern=CONTROLLER_PATTERN, examples=["my_av.py:MyClass", "my_package.my_module:MyClass"]
    )
    """your own: 'file.py:Class' or 'package.module:Class', a function step(seen), or a TraCI script 'file.py'"""
    traci_style: TraciStyle = TraciStyle()
    sumo: dict[str, str | float] | None = None
    """SUMO drives it: carFollowModel and other vType attributes"""
    traci: TraciProcess | None = Field(None, description="your program, in any language, as a TraCI client")
    fmu: FmuController | None = Field(None, description="an FMI 2.0 co-simulation FMU")
    parameters: Annotated[BuiltInParameters | dict[str, Any], Parameters] = Field(
        default_factory=dict, validate_default=True
    )
    """of the built-in model or of the controller"""
    reaction: Reaction = Reaction()
    before_event: Literal["hold_speed", "controller"] = "hold_speed"
    """hold_speed until the event [itsc], or controller: it acts from the start"""
    takes_over: Literal["first_braking", "onset"] = "first_braking"
    """it keeps its speed until it first asks to brake, or BV is on its lane; or until the onset alone"""
    warm_up_s: StepTime = Field(2.0, ge=0.0, le=60.0)
    """time before the event shown to a controller or FMU that keeps its speed; its answers are unused"""
    limits: Limits = Limits()

    @property
    def source(self) -> str:
        """Which of `AV_SOURCES` drives the AV."""
        return next(name for name in AV_SOURCES if getattr(self, name) is not None)

    @property
    def acts_before_event(self) -> bool:
        """Whether its controller acts from the start of a test."""
        return self.before_event == "controller"

    @property
    def warm_up_steps(self) -> int:
        """Steps before the event that its controller is shown; 0 for what is not asked by the harness, or always."""
        warms_up = self.source in ("controller", "fmu") and not self.acts_before_event
        return round(10.0 * self.warm_up_s) if warms_up else 0

    @property
    def reproducible(self) -> bool:
        """Whether a test runs again bit for bit, which cannot be promised for a program outside of the harness."""
        return self.traci is None

    def identity(self) -> dict[str, Any]:
        """What the AV is, for the campaign's hash: an FMU counts by its content, wherever it lies."""
        content = self.model_dump()
        del content["limits"]["construction_time_s"]  # changes no test
        if self.acts_before_event:
            del content["takes_over"]
        if not self.warm_up_steps:  # nobody is shown it
            del content["warm_up_s"]
        if self.traci_style == TraciStyle():
            del content["traci_style"]
        if self.controller is not None:  # as a module that is found from where it lies
            content["controller"] = re.sub(r"^(?:.*/)?([^/]+)\.py(:|$)", r"\1\2", self.controller)
        if self.fmu is not None and (file := Path(self.fmu.file)).is_file():
            content["fmu"]["file"] = hashlib.sha256(file.read_bytes()).hexdigest()
        if self.traci is not None:
            del content["traci"]["allow_public"]  # changes no test
        return content

    @model_validator(mode="before")
    @classmethod
    def _idm_when_nothing_is_named(cls, data: Any) -> Any:
        if not isinstance(data, dict) or any(data.get(name) is not None for name in AV_SOURCES):
            return data
        if forgotten := [name for name in AV_SOURCES if name in data]:
            mend = f"Write a value after '{forgotten[0]}:', or delete the key for the built-in idm."
            raise broken_rule(forgotten[0], "nothing (null)", f"one of {', '.join(AV_SOURCES)}, with a value", mend)
        return {**data, "model": "idm"}

    @model_validator(mode="after")
    def _one_source_reads_all_of_it(self) -> Self:
        named = [name for name in AV_SOURCES if getattr(self, name) is not None]
        if len(named) > 1:
            mend = "An AV has one driver: delete the others, or set them to null."
            raise broken_rule("", " and ".join(named), f"one of {', '.join(AV_SOURCES)}", mend)
        beside = f"beside av.{self.source}"
        if self.source in READS_NO_PARAMETERS and self.parameters:
            found = f"{listed(dict(self.parameters))}, which nothing reads"
            raise broken_rule("parameters", found, f"no parameters {beside}", READS_NO_PARAMETERS[self.source])
        if self.controller is None and self.traci_style != TraciStyle():
            raise broken_rule("traci_style", f"traci_style {beside}", "it only beside a controller", "Leave it out.")
        if self.takes_over == "onset" and (self.source in ("sumo", "traci") or self.acts_before_event):
            beside = f"beside before_event: {self.before_event}" if self.acts_before_event else beside
            mend = "Leave it out. SUMO hands over at the overlap; who acts before the event drives from the start."
            raise broken_rule("takes_over", f"onset {beside}", "a vehicle that is asked from the onset on", mend)
        if self.model is None and self.reaction != Reaction():
            mend = "Your own driver has its own delays: leave av.reaction out."
            raise broken_rule("reaction", f"a reaction {beside}", "a reaction only of a built-in model", mend)
        return self


WAITS = {key: AutomatedVehicle.model_fields[key].default for key in ("before_event", "takes_over", "warm_up_s")}
"""Defaults of keys on what a vehicle does until the event: they mean nothing where it follows from the start."""


class Panel(Section):
    """Automated vehicles by name: ``av`` sections that experiments, tests and tables share."""

    format: Literal["av-panel"]
    version: Literal[1]
    description: str = ""
    avs: dict[Annotated[str, Field(pattern=NAME_PATTERN)], AutomatedVehicle] = Field(min_length=1)
    """av sections by name"""
