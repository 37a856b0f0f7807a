"""Sections of a campaign but the vehicle: how tests are simulated, drawn and kept, and when there are enough."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    field_validator,
    model_validator,
)

from harness.problems import SURROGATE_PATTERN, broken_rule, did_you_mean, in_words
from harness.vocabulary import Method


def whole(value: Any) -> Any:
    """Turn ``1e6`` into ``1000000``: YAML reads every number with an exponent as a float."""
    if isinstance(value, float) and value.is_integer() and abs(value) <= 2.0**53:  # exact up to there
        return int(value)
    return value


Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
EXPOSURES = 1e-9, 1e6
"""Least and most events of a kind per hour of driving."""
EventsPerHour = Annotated[float, Field(ge=EXPOSURES[0], le=EXPOSURES[1])]
Confidence = Annotated[float, Field(ge=0.01, le=0.999999999)]
Whole = Annotated[int, BeforeValidator(whole)]
SurrogateName = Annotated[str, Field(pattern=SURROGATE_PATTERN)]


class Section(BaseModel):
    """A section of the campaign: unknown keys are errors, values never change after loading."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    @model_validator(mode="wrap")
    @classmethod
    def _errors_in_words(cls, data: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            return validate(data)
        except ValidationError as error:
            raise in_words(error, cls) from None

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """The values that are not defaults."""
        for name, value in super().__repr_args__():
            field = type(self).model_fields[name or ""]
            if field.is_required() or value != field.get_default(call_default_factory=True):
                yield name, value

    def at(self, path: Sequence[str]) -> Any:
        """Value at a path such as ``("av", "fmu", "file")``; None where a section on the way is left out."""
        key, *rest = path
        value = getattr(self, key)
        if rest and isinstance(value, dict):
            value, rest = value.get(rest[0]), rest[1:]
        return value.at(rest) if rest and value is not None else value

    def replaced(self, path: Sequence[str], value: Any) -> Self:
        """A copy with another value at a path such as ``("av", "fmu", "file")``, not validated."""
        key, *rest = path
        own = getattr(self, key)
        if rest:
            if isinstance(own, dict):
                value = own | {rest[0]: own[rest[0]].replaced(rest[1:], value) if rest[1:] else value}
            else:
                value = own.replaced(rest, value)
        return self.model_copy(update={key: value})


def _whole_steps(seconds: float) -> float:
    """Refuse a time that is not a multiple of the 0.1 s step."""
    steps = seconds * 10.0
    if abs(steps - round(steps)) >= 1e-9:
        mend = f"The nearest one is {round(steps) / 10.0:g}."
        raise broken_rule("", f"{seconds:g} s", "a multiple of the 0.1 s step", mend)
    return seconds


StepTime = Annotated[float, AfterValidator(_whole_steps)]
LeadTime = Annotated[float, Field(ge=0.0, le=10.0), AfterValidator(_whole_steps)]
"""Between the onset of a lane change and overlap."""


DEFAULT = "default"
DEFAULT_FAMILY = "cut_in"
"""Kind of events where a campaign names none."""


class EnvironmentSettings(Section):
    """The naturalistic driving environment."""

    parameters: str = DEFAULT
    """name of a shipped parameter file, or a path to your own; default: the scenario's"""
    lane_change_level: Positive = Field(1.0, le=1e8)
    """multiplies the cut-in hazard; highD: about 270 (python -m studies traffic)"""
    acceleration_hold_s: StepTime = Field(1.0, ge=0.1, le=2.0)
    """how long a drawn acceleration is held: 1.0 or 0.1"""
    cut_in_lead_s: LeadTime | None = None
    """time from onset to overlap of every cut-in; none: as the parameters say"""

    def named(self, default: str) -> str:
        """Of the parameter file, where the ``default`` is the scenario's."""
        return default if self.parameters == DEFAULT else self.parameters


class CrashSettings(Section):
    """Which crashes count."""

    counts_above_mps: float = Field(0.0, ge=0.0, le=50.0)
    """impact speed above which a crash counts, for all drivers"""


class ShellSettings(Section):
    """How tests are spread over the shells of the pool, and what is said about vehicles that keep to some of them."""

    statement: Literal["assumption_free", "library"] = "assumption_free"
    """what stop.rhw or accept is about; library: if the vehicle crashes only inside the library's boundary, outside of
    which nothing is tested then"""
    first_tests: Annotated[int, Field(ge=3, le=10_000), BeforeValidator(whole)] | None = None
    """tests of each shell before any is preferred; none: by its probability"""
    smallest_round: Whole = Field(1, ge=1, le=10_000)
    """fewest tests of a round; raise it for many workers"""
    beyond_envelope: bool = False
    """test also events on which not even full throttle crashes, as is done anyway for an AV that accelerates harder"""


CHALLENGE = r"^(immediate|recursive|.+\.py:\w+)$"


LEAST_TESTS: dict[str, int] = {"dr": 1_000}
"""Below which intervals miss too often, as rare crashes that no surrogate predicts are not among the tests (measured:
docs/estimators.md). The number of tests decides, and nothing that is seen in them: tests that lack such a crash look
better than they are."""


class Testing(Section):
    """How maneuvers are drawn at critical moments."""

    method: Method = "shells"
    """shells: events of a pool; forced: an event in every test; nde: no control; step_mixture: NADE as published;
    episode_mixture: one importance function per test"""
    estimator: str | None = None
    """what answers and stops instead of the method's own: a name, or my.py:MyEstimator"""
    challenge: str = Field("recursive", json_schema_extra={"pattern": CHALLENGE})
    """immediate: crash if BV cuts in now (published); recursive: backward induction; my.py:function: your own"""
    epsilon: float = Field(0.1, ge=1e-6, le=1.0)
    """share of natural driving in every importance function; at 0 what no surrogate crashes on would never be drawn,
    and the rate be too low"""
    alpha: dict[SurrogateName, Probability] | None = None
    """weight of each surrogate, summing to 1; none: equal"""
    defensive_share: float = Field(0.1, gt=0.0, lt=1.0, description="share of forced cut-ins in the episode mixture")
    criticality_threshold: float = Field(0.0, ge=0.0, lt=1.0, description="a moment is critical above it")
    shells: ShellSettings = ShellSettings()

    @property
    def own_challenge(self) -> str | None:
        """The challenge, if it is a function of the user's own."""
        return self.challenge if ":" in self.challenge else None

    @field_validator("challenge")
    @classmethod
    def _challenge_is_known(cls, challenge: str) -> str:
        if not re.search(CHALLENGE, challenge):
            mend = did_you_mean(challenge, ("immediate", "recursive")) or "Write my.py:function for one of your own."
            raise broken_rule("", f"'{challenge}'", "'immediate', 'recursive' or my.py:function", mend)
        return challenge

    @field_validator("alpha")
    @classmethod
    def _alpha_sums_to_one(cls, alpha: dict[str, float] | None) -> dict[str, float] | None:
        total = 1.0 if alpha is None else math.fsum(alpha.values())
        if abs(total - 1.0) > 1e-9:
            mend = "Change them, or leave alpha out for equal weights."
            raise broken_rule("", f"weights that sum to {total:.12g}", "weights that sum to 1", mend)
        return alpha


LEAST_POOL_ERROR, MOST_EVENTS = 0.001, 1_000_000


class PoolSettings(Section):
    """The pool of events that shells are drawn from; built once, in the twin."""

    library: str | None = None
    """name of a shipped surrogate library, or a path to your own; none: the traffic's"""
    relative_error: float | None = Field(None, ge=LEAST_POOL_ERROR, le=0.2)
    """relative standard error of surrogates' crash rates, four times that of few paths or beyond the boundary; none:
    the scenario's, 0.005 or 0.01"""
    events_per_shell: Whole = Field(25_000, ge=100, le=MOST_EVENTS)
    """events kept of each shell: its most tests; twice as many outside the boundary where the AV follows"""
    shadow_paths: Whole = Field(500, ge=50, le=100_000)
    """baseline runs of a vehicle that acts before the event"""
    seed: Whole = Field(1, ge=0, lt=2**63)
    """of the pool and of baseline runs, which another seed alone leaves as they are"""


class WorldSettings(Section):
    """Where tests are simulated."""

    engine: Literal["sumo", "twin"] = Field("sumo", description="sumo, or twin: the same motion without SUMO")
    cells: Whole = Field(64, ge=1, le=4096)
    """tests side by side, in SUMO at most 256; never changes a result"""


class Records(Section):
    """What is kept of every test."""

    moments: Literal["all", "first_9", "none"] = "first_9"
    """control steps kept: all, first_9 (which scv needs) or none"""
    traces: Literal["all", "crash", "critical", "none"] = "none"
    """tests whose motion is kept: all, crash, critical or none"""
    trace_share: Probability = Field(0.0, description="share of tests traced whatever their outcome")


MIN_CRASHES = 100
"""Sampled crashes before a precision may end tests that have weights."""


class Stop(Section):
    """When the campaign is long enough."""

    episodes: Whole = Field(100_000, ge=1, le=10**10, description="most tests to run")
    rhw: float | None = Field(None, ge=1e-4, lt=10.0)
    """stop at this half-width of the interval over the rate; not for step_mixture"""
    below_reference: float | None = Field(None, gt=0.0, le=1e6)
    """with rhw and shells: stop, too, once the rate is known to be below so many times that of the library's first
    reference driver; not where --set says rhw alone"""
    each_family: bool = False
    """with several scenarios: rhw is asked of each one's rate, not of the sum"""
    confidence: Confidence = Field(0.9, description="level of every interval")
    min_crashes: Annotated[int, Field(ge=1), BeforeValidator(whole)] | None = None
    """crashes needed before rhw may stop the campaign; none: 100, with shells 1"""


class TimesReference(Section):
    """A limit as a multiple of a reference driver's crash rate in the same traffic."""

    driver: str = Field(description="reference driver of the surrogate library, such as r157-cc")
    at_most: Positive = Field(1.0, le=1e6, description="times its crash rate: accepted below, rejected above")


class Accept(Section):
    """A limit: a run of shells ends when it is known on which side of it the rate of testing.shells.statement lies."""

    example: ClassVar[str] = "{times_reference: {driver: r157-cc}}"
    crash_rate_below: float | None = Field(None, gt=0.0, lt=1.0)
    """crashes per test, of several scenarios per hour of driving: accepted below it, rejected above"""
    times_reference: TimesReference | None = Field(None, description="the same beside a reference driver")

    @property
    def asked(self) -> tuple[str, float, str | None]:
        """The key that is given, its limit, and the reference driver of whose crash rate that is a multiple."""
        if (beside := self.times_reference) is not None:
            return "times_reference", beside.at_most, beside.driver
        return "crash_rate_below", self.crash_rate_below or math.nan, None

    @model_validator(mode="after")
    def _one_limit(self) -> Self:
        if (self.crash_rate_below is None) == (self.times_reference is None):
            found = "neither" if self.times_reference is None else "both"
            mend = "Write crash_rate_below: 3e-7, or times_reference: {driver: r157-cc}."
            raise broken_rule("", found, "one of crash_rate_below and times_reference", mend)
        return self


class Resources(Section):
    """What Ray sets aside for one worker."""

    cpus: Positive = Field(1.0, description="cores; also a share of one")
    gpus: float = Field(0.0, ge=0.0, description="GPUs; also a share of one")


class RaySettings(Section):
    """A Ray cluster, used where run.executor is ray."""

    address: str | None = None
    """HOST:6379 or auto; none: $RAY_ADDRESS, else a cluster of this machine"""
    resources: Resources = Resources()
    runtime_env: dict[str, Any] = Field(default_factory=dict)
    """Ray's runtime_env: brings the controller's package to the machines"""


USUAL_SHARD, LARGEST_SHARD = 5_000, 2_000_000
SHARD_SHARE, LONG_RUN = 32, 2_500_000


class RunSettings(Section):
    """How the work is spread; nothing here changes a result."""

    shard_size: Annotated[int, Field(ge=1, le=LARGEST_SHARD), BeforeValidator(whole)] | None = None
    """tests per task; none: 5,000, and more in long runs"""
    max_failed_share: Probability = Field(0.01, description="stop with exit code 3 above this share of failures")
    executor: Literal["local", "ray"] = "local"
    """workers run on this machine (local) or on a Ray cluster (ray)"""
    ray: RaySettings = RaySettings()

    @property
    def smallest_shard(self) -> int:
        """Episodes of the first shard."""
        return self.shard_size or USUAL_SHARD

    def shard_ends(self, n_episodes: int) -> Sequence[int]:
        """Where the shards of so many episodes, or a few more, end: by index alone, so that a run can go on."""
        if self.shard_size is not None:
            return range(self.shard_size, n_episodes + self.shard_size, self.shard_size)
        ends = [USUAL_SHARD]
        while ends[-1] < n_episodes:
            share = SHARD_SHARE if ends[-1] < LONG_RUN else SHARD_SHARE // 2
            ends.append(ends[-1] + min(max(USUAL_SHARD, ends[-1] // share), LARGEST_SHARD))
        return ends
