"""What a campaign is: frozen, validated models, one class per YAML section.

A campaign says which traffic (``environment``) meets which vehicle (``av``), how critical moments are found and
sampled (``surrogates``, ``testing``), where it is simulated (``world``), what is kept (``records``) and when it is
enough (``stop``). Units are in the field names.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
from collections.abc import Iterable
from pathlib import Path
from string import Formatter
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError, PydanticKnownError

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
CONTROLLER_PATTERN = r"^([A-Za-z_][A-Za-z0-9_.]*:[A-Za-z_][A-Za-z0-9_]*|[A-Za-z0-9][A-Za-z0-9_.-]*)$"
SURROGATE_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"
LARGEST_EXACT_WHOLE_FLOAT = 2.0**53


def _whole(value: Any) -> Any:
    """Turn ``1e6`` into ``1000000``: YAML reads every number with an exponent as a float."""
    if isinstance(value, float) and value.is_integer() and abs(value) <= LARGEST_EXACT_WHOLE_FLOAT:
        return int(value)
    return value


Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
Whole = Annotated[int, BeforeValidator(_whole)]
SurrogateName = Annotated[str, Field(pattern=SURROGATE_PATTERN)]
Method = Literal["nde", "forced", "step_mixture", "episode_mixture", "shells"]
EstimatorName = Literal["nde", "nade", "mixture_cv", "scv", "shells"]

MAX_CONFIGURED_SPEED_MPS = 60.0
MOST_SUMO_CELLS = 256
"""Roads of the largest committed network."""


def broken_rule(key: str, *, found: str, expected: str, mend: str) -> PydanticCustomError:
    """Error for a rule between several values, in the four parts that the loader shows.

    Parameters
    ----------
    key : str
        Dotted path of the value to blame, seen from the section that states the rule; empty for the section itself.
    found, expected, mend : str
        As in `harness.errors.HarnessError`.
    """
    parts = {"key": key, "found": found, "expected": expected, "mend": mend}
    where = "{key}: " if key else ""
    return PydanticCustomError("broken_rule", where + "found {found}; expected {expected}. {mend}", parts)


class Section(BaseModel):
    """A section of the campaign: unknown keys are errors, values never change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


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
_PARAMETERS: dict[str, type[BuiltInParameters]] = {
    "idm": IDMParameters,
    "fvdm": FVDMParameters,
    "constant": ConstantParameters,
}


def _whole_steps(seconds: float) -> float:
    """Refuse a time that is not a multiple of the 0.1 s step."""
    steps = seconds * 10.0
    if abs(steps - round(steps)) >= 1e-9:
        raise broken_rule(
            "",
            found=f"{seconds:g} s",
            expected="a multiple of the 0.1 s step",
            mend=f"The nearest one is {round(steps) / 10.0:g}.",
        )
    return seconds


StepTime = Annotated[float, AfterValidator(_whole_steps)]


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


class Environment(Section):
    """The naturalistic driving environment."""

    parameters: str = Field("ndd-overtaking-1", description="name of a shipped parameter file, or a path to your own")
    lane_change_level: Positive = Field(
        1.0,
        le=1e8,
        description="multiplies the cut-in hazard: 1 = dense-learning tables, 100 = a later table, about 350 = highD",
    )
    acceleration_hold_s: StepTime = Field(
        1.0, ge=0.1, le=2.0, description="how long a drawn acceleration is held, in whole 0.1 s steps; 1.0 or 0.1"
    )


class Limits(Section):
    """What an AV may ask for; beyond it an episode fails instead of being simulated with nonsense."""

    min_acceleration_mps2: float = Field(
        -15.0, ge=-50.0, le=0.0, description="hardest braking a controller may ask for"
    )
    max_acceleration_mps2: Positive = Field(10.0, le=50.0, description="hardest acceleration it may ask for")
    step_time_s: Positive = Field(10.0, le=3600.0, description="time that one call of the controller may take")


class TraciProcess(Section):
    """The user's program, connected to a real SUMO as an ordinary TraCI client."""

    command: str = Field(
        min_length=1, description="starts the program; {port} and {cells} are filled in, e.g. './my_av --port {port}'"
    )
    connect_time_s: Positive = Field(60.0, le=3600.0, description="time that the program may take to connect")
    restarts: Whole = Field(3, ge=0, le=100, description="times that a program that ended is started again")
    allow_public: bool = Field(
        False, description="run also where the machine has a public address: SUMO's server listens on all of them"
    )

    @field_validator("command")
    @classmethod
    def _command_can_be_filled_in(cls, command: str) -> str:
        try:
            fields = [parts[1:] for parts in Formatter().parse(command) if parts[1] is not None]
            wrong = [field for field in fields if field not in (("port", "", None), ("cells", "", None))]
            problem = f"the field {wrong[0][0]!r}" if wrong else None if shlex.split(command) else "no word"
        except ValueError as error:
            problem = str(error)
        if problem is not None:
            raise broken_rule(
                "",
                found=f"{problem[:60]}, in {command[:200]!r}",
                expected="a program and its arguments, with {port} and {cells} as they stand the only things in braces",
                mend="Double a brace that is meant as itself: {{ and }}.",
            )
        return command

    def words(self, port: int, cells: int) -> list[str]:
        """The command, filled in, word by word."""
        return shlex.split(self.command.format(port=port, cells=cells))


class FmuController(Section):
    """An FMI 2.0 co-simulation FMU as controller."""

    file: str = Field(min_length=1, description="path of the .fmu, relative to the campaign file")
    inputs: dict[str, str] = Field(
        description="FMU input variable for each observation: speed_mps, gap_m, lead_speed_mps, time_s, ..."
    )
    output: str = Field(min_length=1, description="FMU output variable that holds the acceleration, m/s2")
    start_values: dict[str, float] = Field(default_factory=dict, description="values set before initialisation")


AV_SOURCES = ("model", "controller", "sumo", "traci", "fmu")


class AutomatedVehicle(Section):
    """The automated vehicle under test: one of model, controller, sumo, traci and fmu."""

    model: Literal["idm", "fvdm", "constant"] | None = Field(
        None, description="built-in driver model; idm when nothing is named"
    )
    controller: str | None = Field(
        None,
        pattern=CONTROLLER_PATTERN,
        examples=["my_package.my_module:MyController", "an_entry_point"],
        description="your own: 'package.module:Class', or the name of an entry point in group harness.controllers",
    )
    sumo: dict[str, str | float] | None = Field(
        None, description="SUMO drives it: carFollowModel and any other vType attribute"
    )
    traci: TraciProcess | None = Field(None, description="your program, in any language, as a TraCI client")
    fmu: FmuController | None = Field(None, description="an FMI 2.0 co-simulation FMU")
    parameters: BuiltInParameters | dict[str, Any] = Field(
        default_factory=dict,
        validate_default=True,
        description="parameters of the built-in model (defaults where left out) or of the controller",
    )
    reaction: Reaction = Reaction()
    before_cut_in: Literal["hold_speed", "controller"] = Field(
        "hold_speed",
        description="until the cut-in the AV keeps its speed [itsc], or its controller acts from the start",
    )
    limits: Limits = Limits()

    @property
    def source(self) -> str:
        """Which of `AV_SOURCES` drives the AV."""
        return next(name for name in AV_SOURCES if getattr(self, name) is not None)

    @property
    def reproducible(self) -> bool:
        """Whether an episode runs again bit for bit: the harness cannot promise it for a program outside of it."""
        return self.traci is None

    def identity(self) -> dict[str, Any]:
        """What the AV is, for the campaign's hash: an FMU counts by its content, wherever it lies."""
        content = self.model_dump()
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
            raise broken_rule(
                forgotten[0],
                found="nothing (null)",
                expected=f"one of {', '.join(AV_SOURCES)}, with a value",
                mend=f"Write a value after '{forgotten[0]}:', or delete the key for the built-in idm.",
            )
        return {**data, "model": "idm"}

    @field_validator("parameters", mode="plain", json_schema_input_type=dict[str, Any])
    @classmethod
    def _parameters_follow_the_model(cls, value: Any, info: ValidationInfo) -> Any:
        # Not by trial of a union: a controller's parameters that look like the IDM's would become those.
        if "model" not in info.data:
            # A wrong model is an error of its own; complaints about parameters of a guessed model would only confuse.
            return IDMParameters()
        if (model := info.data["model"]) is not None:
            return _PARAMETERS[model].model_validate(value)
        if not isinstance(value, dict):
            raise PydanticKnownError("dict_type")
        return value

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        named = [name for name in AV_SOURCES if getattr(self, name) is not None]
        if len(named) > 1:
            raise broken_rule(
                "",
                found=" and ".join(named),
                expected=f"one of {', '.join(AV_SOURCES)}",
                mend="An AV has one driver: delete the others, or set them to null.",
            )
        return self

    @model_validator(mode="after")
    def _parameters_have_a_reader(self) -> Self:
        elsewhere = {
            "sumo": "Write vType attributes under av.sumo itself.",
            "traci": "Give them to your program in av.traci.command.",
            "fmu": "Write them under av.fmu.start_values.",
        }
        if self.source in elsewhere and self.parameters:
            raise broken_rule(
                "parameters",
                found=f"{_listed(dict(self.parameters))}, which nothing reads",
                expected=f"no parameters beside av.{self.source}",
                mend=elsewhere[self.source],
            )
        return self

    @model_validator(mode="after")
    def _only_a_built_in_model_is_slowed_down(self) -> Self:
        if self.model is None and self.reaction != Reaction():
            raise broken_rule(
                "reaction",
                found=f"a reaction beside av.{self.source}",
                expected="a reaction only of a built-in model",
                mend="Your own driver has its own delays: leave av.reaction out.",
            )
        return self


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


def _default_surrogates() -> dict[str, DriverModel]:
    return {
        "SM-I": IDM(model="idm"),
        "SM-II": FVDM(model="fvdm", parameters=FVDMParameters(min_acceleration_mps2=-1.0)),
        "SM-III": FVDM(model="fvdm", parameters=FVDMParameters(min_acceleration_mps2=-6.0)),
    }


class Shells(Section):
    """How tests are spread over the shells of the pool."""

    boundary: SurrogateName | None = Field(
        None, description="surrogate within which the conditional statement assumes all crashes; the library's own"
    )
    statement: Literal["assumption_free", "conditional"] = Field(
        "assumption_free", description="what has to reach stop.rhw; conditional tests only within the boundary"
    )
    first_tests: Whole = Field(12, ge=1, le=10_000, description="tests of each shell before any is preferred")


class Testing(Section):
    """How maneuvers are drawn at critical moments."""

    method: Method = Field(
        "episode_mixture",
        description="nde: no control; forced: cut-in time drawn given that one happens; step_mixture: published NADE; "
        "episode_mixture: one importance function per episode, forced cut-in as defence; shells: cut-ins of a pool, "
        "counted within shells of known probability",
    )
    challenge: Literal["immediate", "recursive"] = Field(
        "recursive", description="immediate: crash if BV cuts in now (published); recursive: backward induction"
    )
    epsilon: Probability = Field(0.1, description="share of p in every importance function [paper]")
    alpha: dict[SurrogateName, Probability] | None = Field(
        None, description="mixture weight per surrogate, summing to 1; equal when left out"
    )
    defensive_share: float = Field(
        0.1, gt=0.0, lt=1.0, description="alpha_0, share of forced cut-ins in the episode mixture"
    )
    criticality_threshold: float = Field(0.0, ge=0.0, lt=1.0, description="a moment is critical above it")
    shells: Shells = Shells()

    @field_validator("alpha")
    @classmethod
    def _alpha_sums_to_one(cls, alpha: dict[str, float] | None) -> dict[str, float] | None:
        total = 1.0 if alpha is None else math.fsum(alpha.values())
        if abs(total - 1.0) > 1e-9:
            raise broken_rule(
                "",
                found=f"weights that sum to {total:.12g}",
                expected="weights that sum to 1",
                mend="Change them, or leave alpha out for equal weights.",
            )
        return alpha


class PoolSettings(Section):
    """The pool of cut-ins that shells, surrogate replay and the alarm on SUMO use; built once, in the twin."""

    library: str = Field("ladder-1", description="name of a shipped surrogate library, or a path to your own")
    relative_error: float = Field(
        0.005,
        ge=0.001,
        le=0.2,
        description="standard error of the surrogates' crash rates to reach, relative; four times as much for those "
        "beyond the boundary, or that crash in rare traffic of their own",
    )
    cut_ins_per_shell: Whole = Field(
        25_000, ge=100, le=1_000_000, description="cut-ins kept of each shell: the most tests that it can give"
    )
    seed: Whole = Field(1, ge=0, lt=2**63, description="every random number of the pool follows from it")


class World(Section):
    """Where episodes are simulated."""

    engine: Literal["sumo", "twin"] = Field("sumo", description="sumo: libsumo; twin: the same dynamics in numba")
    cells: Whole = Field(64, ge=1, le=4096, description="episodes simulated side by side; never changes a result")


class Records(Section):
    """What is kept of every episode."""

    moments: Literal["all", "first_9", "none"] = Field("first_9", description="control steps kept; scv needs first_9")
    traces: Literal["all", "crash", "critical", "none"] = Field("none", description="episodes whose motion is kept")
    trace_share: Probability = Field(
        0.0, description="share of episodes traced whatever their outcome, by a hash of the index"
    )


class Stop(Section):
    """When the campaign is long enough."""

    episodes: Whole = Field(100_000, ge=1, le=10**10, description="most episodes to run")
    rhw: float | None = Field(
        None, gt=0.0, lt=10.0, description="stop at this relative half-width of the interval; not for step_mixture"
    )
    confidence: float = Field(0.9, gt=0.0, lt=1.0, description="level of every interval")
    estimator: EstimatorName | None = Field(None, description="whose RHW is watched; default: the method's own")
    min_crashes: Annotated[int, Field(ge=1), BeforeValidator(_whole)] | None = Field(
        None, description="sampled crashes needed before RHW may stop the campaign; 100, with shells 1"
    )


class Run(Section):
    """How the work is spread; nothing here changes a result."""

    shard_size: Whole = Field(5_000, ge=1, le=1_000_000, description="episodes per file and per task")
    max_failed_share: Probability = Field(0.01, description="stop with exit code 3 above this share of failures")


class Campaign(Section):
    """A test campaign, as one YAML file describes it."""

    name: str = Field(pattern=NAME_PATTERN, description="short name of letters, digits, _ . and -, used in reports")
    description: str = Field("", description="what this campaign is for, in a sentence")
    seed: Whole = Field(1, ge=0, lt=2**63, description="every random number follows from it")
    environment: Environment = Environment()
    av: AutomatedVehicle = AutomatedVehicle()
    surrogates: dict[SurrogateName, DriverModel] = Field(
        default_factory=_default_surrogates, description="stand-ins for the unknown AV, by name"
    )
    testing: Testing = Testing()
    pool: PoolSettings = PoolSettings()
    world: World = World()
    records: Records = Records()
    stop: Stop = Stop()
    run: Run = Run()

    @model_validator(mode="after")
    def _alpha_matches_surrogates(self) -> Self:
        alpha = self.testing.alpha
        if alpha is not None and set(alpha) != set(self.surrogates):
            raise broken_rule(
                "testing.alpha",
                found=f"weights for {_listed(alpha)}",
                expected=f"one weight for each surrogate: {_listed(self.surrogates)}",
                mend="Name the surrogates exactly, or leave alpha out for equal weights.",
            )
        return self

    @model_validator(mode="after")
    def _paths_need_an_av_that_holds_its_speed(self) -> Self:
        method = self.testing.method
        if self.av.before_cut_in == "controller" and method in ("forced", "episode_mixture", "shells"):
            raise broken_rule(
                "av.before_cut_in",
                found=f"controller, with testing.method {method}",
                expected="hold_speed: the method draws LV's and BV's path ahead, which needs to know the AV's",
                mend="Choose hold_speed, or testing.method step_mixture or nde.",
            )
        return self

    @model_validator(mode="after")
    def _built_in_models_wait_for_the_cut_in(self) -> Self:
        if self.av.before_cut_in == "controller" and self.av.model is not None:
            raise broken_rule(
                "av.before_cut_in",
                found=f"controller, with the built-in model {self.av.model}",
                expected="hold_speed: a built-in model has nothing to follow before the cut-in",
                mend="Delete the key, or bring a controller of your own.",
            )
        return self

    @model_validator(mode="after")
    def _engine_can_drive_the_av(self) -> Self:
        if self.world.engine == "twin" and self.av.source in ("sumo", "traci"):
            raise broken_rule(
                "world.engine",
                found=f"twin, with an AV that SUMO moves (av.{self.av.source})",
                expected="sumo",
                mend="Write engine: sumo.",
            )
        return self

    @model_validator(mode="after")
    def _network_has_the_cells(self) -> Self:
        if self.world.engine == "sumo" and self.world.cells > MOST_SUMO_CELLS:
            raise broken_rule(
                "world.cells",
                found=f"{self.world.cells}, with engine sumo",
                expected=f"at most {MOST_SUMO_CELLS}: so many roads has the largest network",
                mend="Lower it; about 64 is fastest. It never changes a result.",
            )
        return self

    @model_validator(mode="after")
    def _mixture_has_surrogates(self) -> Self:
        if not self.surrogates and self.testing.method in ("step_mixture", "episode_mixture"):
            raise broken_rule(
                "surrogates",
                found="none",
                expected=f"at least one surrogate for testing.method {self.testing.method}",
                mend="Leave surrogates out for the three of the paper, or choose method forced or nde.",
            )
        return self

    @model_validator(mode="after")
    def _precision_can_be_promised(self) -> Self:
        if self.stop.rhw is not None and self.testing.method == "step_mixture":
            raise broken_rule(
                "stop.rhw",
                found=f"{self.stop.rhw:g}, with testing.method step_mixture",
                expected="no precision to stop at: nothing bounds the weights of the step mixture, and while the large "
                "ones are missing its interval looks narrow",
                mend="Set it to null for a fixed number of tests (stop.episodes), or choose shells, forced or "
                "episode_mixture.",
            )
        return self

    @model_validator(mode="after")
    def _watched_estimator_is_available(self) -> Self:
        watched, method = self.stop.estimator, self.testing.method
        needs = {
            "nde": (method == "nde", "testing.method nde"),
            "mixture_cv": (method == "episode_mixture", "testing.method episode_mixture"),
            "scv": (
                method == "step_mixture" and self.records.moments != "none",
                "testing.method step_mixture and records.moments first_9 or all",
            ),
            "shells": (method == "shells", "testing.method shells"),
            "nade": (method != "shells", "another testing.method than shells"),
        }
        available, need = needs.get(watched or "", (True, ""))
        if not available:
            raise broken_rule(
                "stop.estimator",
                found=f"{watched}, which these records will not allow",
                expected=f"an estimator that can be computed, and {watched} needs {need}",
                mend="Change one of the two, or leave stop.estimator out for the method's own.",
            )
        return self

    @property
    def min_crashes(self) -> int:
        """Sampled crashes needed before RHW may stop the campaign; limits within shells are exact, without a floor."""
        if self.stop.min_crashes is not None:
            return self.stop.min_crashes
        return 1 if self.testing.method == "shells" else 100

    def alpha(self) -> tuple[float, ...]:
        """Mixture weights of the surrogates, in their order, summing to 1."""
        if self.testing.alpha is None:
            return tuple(1.0 / len(self.surrogates) for _ in self.surrogates)
        return tuple(self.testing.alpha[name] for name in self.surrogates)

    def content_hash(self, environment_parameters: str) -> str:
        """Hash of everything that changes an episode's bits.

        Parameters
        ----------
        environment_parameters : str
            Hash of the environment parameter file in use.

        Notes
        -----
        Cells, workers, stop rule, trace policy and names are left out, so that a campaign can be continued to a
        smaller RHW or with other resources.
        """
        content = {
            "seed": self.seed,
            "environment": self.environment.model_dump(exclude={"parameters"}),
            "environment_parameters": environment_parameters,
            "av": self.av.identity(),
            "surrogates": [(name, model.model_dump()) for name, model in self.surrogates.items()],
            "testing": self.testing.model_dump(),
            "pool": self.pool.model_dump() if self.testing.method == "shells" else None,
            "engine": self.world.engine,
            "moments": self.records.moments,
            "shard_size": self.run.shard_size,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
