"""What a campaign is: frozen, validated models, one class per YAML section, and the rules between sections.

Units are in the field names. What does not go together is one table, `REFUSED`: it is asked while a campaign is read,
so that the error names file and line, and once more where it is resolved for a command, and its traffic is known.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable
from itertools import starmap
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import BeforeValidator, Field, SerializeAsAny, model_validator

from harness.campaign.drivers import NATURAL, OwnSurrogate, Surrogate, default_surrogates
from harness.campaign.sections import (
    DEFAULT,
    DEFAULT_FAMILY,
    LEAST_TESTS,
    MIN_CRASHES,
    Accept,
    CrashSettings,
    EnvironmentSettings,
    EventsPerHour,
    PoolSettings,
    Records,
    RunSettings,
    Section,
    Stop,
    SurrogateName,
    Testing,
    Whole,
    WorldSettings,
)
from harness.campaign.vehicle import WAITS, AutomatedVehicle
from harness.problems import NAME_PATTERN, broken_rule, did_you_mean, listed
from harness.vocabulary import SAMPLING, Sampling


def _shipped(value: Any) -> Any:
    """What the name of a driver of the shipped libraries, or of a class, stands for; any other value as it is."""
    if isinstance(value, str) and ".py:" in value:
        value = {"controller": value}
    if not isinstance(value, str):
        return OwnSurrogate.model_validate(value) if isinstance(value, dict) and "controller" in value else value
    from harness.vehicles.library import shipped_drivers  # noqa: PLC0415 - libraries read campaigns' sections

    if value not in (drivers := shipped_drivers()):
        expected = f"model and parameters of a driver, my.py:Model, or the name of a shipped one ({listed(drivers)})"
        mend = did_you_mean(value, list(drivers)) or "Write one that is like yours: any leaves rates unbiased."
        raise broken_rule("", f"'{value}'", expected, mend)
    return drivers[value].model_dump()


_Shipped = BeforeValidator(_shipped, json_schema_input_type=Surrogate | str)


class Campaign(Section):
    """A test campaign, as one YAML file describes it."""

    name: str = Field(pattern=NAME_PATTERN, description="short name of letters, digits, _ . and -, used in reports")
    description: str = Field("", description="what this campaign is for, in a sentence")
    seed: Whole = Field(1, ge=0, lt=2**63)
    """random numbers of the tests follow from it; those of the pool from pool.seed"""
    scenario: str = DEFAULT_FAMILY
    """kind of events that are tested: cut_in, lead_brakes, cut_out, or one that a package brings; several: scenarios"""
    scenarios: Annotated[list[str], Field(min_length=1)] | None = None
    """several kinds of events in one answer per hour, in place of scenario: [cut_in, lead_brakes, cut_out]"""
    exposure: dict[str, EventsPerHour] = Field(
        default_factory=dict, description="events per hour of driving, by scenario"
    )
    environment: EnvironmentSettings = EnvironmentSettings()
    environments: dict[str, str] = Field(default_factory=dict)
    """parameter files of the other scenarios, beside cut_in's environment: {lead_brakes: mine.lead_brakes.yaml}"""
    av: AutomatedVehicle = AutomatedVehicle()
    crash: CrashSettings = CrashSettings()
    surrogates: dict[SurrogateName, Annotated[SerializeAsAny[Surrogate], _Shipped]] = Field(
        default_factory=default_surrogates
    )
    """stand-ins for the unknown AV, by name: each a driver, the name of a shipped one (r157-cc), or my.py:Model"""
    testing: Testing = Testing()
    pool: PoolSettings = PoolSettings()
    world: WorldSettings = WorldSettings()
    records: Records = Records()
    stop: Stop = Stop()
    accept: Accept | None = Field(None, description="stop at a decision instead of at a precision")
    run: RunSettings = RunSettings()

    @model_validator(mode="after")
    def _parts_go_together(self) -> Self:
        alpha = self.testing.alpha
        if alpha is not None and set(alpha) != set(self.surrogates):
            expected = f"one weight for each surrogate: {listed(self.surrogates)}"
            mend = "Name the surrogates exactly, or leave alpha out for equal weights."
            raise broken_rule("testing.alpha", f"weights for {listed(alpha)}", expected, mend)
        for name in set(self.exposure) - set(self.scenarios or self.exposure):
            tested = self.scenarios or ()
            mend = did_you_mean(name, tested) or "Name it among scenarios, or delete it."
            raise broken_rule(f"exposure.{name}", f"'{name}'", f"a scenario that is tested: {listed(tested)}", mend)
        if (words := refusal(self)) is not None:
            raise broken_rule(*words)
        return self

    def of_family(self, name: str) -> Campaign:
        """The campaign of one of its scenarios; ``environment`` itself is that of cut-ins."""
        changes: dict[str, Any] = {"scenario": name, "scenarios": None, "exposure": {}, "environments": {}}
        if name != DEFAULT_FAMILY:  # in the others the vehicle drives from the start in any case
            changes["environment"] = EnvironmentSettings(parameters=self.environments.get(name, DEFAULT))
            changes["av"] = self.av.model_copy(update=WAITS)
        return self.model_copy(update={"stop": self.stop.model_copy(update={"each_family": False}), **changes})

    def own_seed(self, seed: int) -> int:
        """A seed of this scenario alone: else a vehicle fails in the same tests of all, and their pools err alike."""
        return seed if self.scenario == DEFAULT_FAMILY else seed ^ zlib.crc32(self.scenario.encode())

    @property
    def sampling(self) -> Sampling:
        """How its method, ``testing.method``, draws tests."""
        return SAMPLING[self.testing.method]

    @property
    def has_baseline_runs(self) -> bool:
        """Whether the AV is first driven along its paths without an event."""
        return self.av.acts_before_event and self.sampling.baseline_runs

    @property
    def min_crashes(self) -> int:
        """Sampled crashes needed before RHW may stop the campaign; limits within shells are exact, without a floor."""
        if self.stop.min_crashes is not None:
            return self.stop.min_crashes
        return 1 if self.sampling.strata else MIN_CRASHES

    @property
    def own_surrogates(self) -> dict[str, str]:
        """Surrogates that are classes of the user's own: ``my.py:Class`` by name."""
        return {name: driver.controller for name, driver in self.surrogates.items() if isinstance(driver, OwnSurrogate)}

    @property
    def importance_names(self) -> tuple[str, ...]:
        """Names of the importance functions, in the order of ``log_q``, none of them twice."""
        defensive = ("forced cut-ins" if "forced" in self.surrogates else "forced",) if self.sampling.forces else ()
        return defensive + (tuple(self.surrogates) if self.sampling.mixes else ())

    @property
    def mixture_weights(self) -> tuple[float, ...]:
        """Weights α of the importance functions, in the order of `importance_names`, summing to 1."""
        names = self.surrogates if self.sampling.mixes else ()
        chosen = self.testing.alpha
        alpha = tuple(chosen[name] if chosen else 1.0 / len(names) for name in names)
        if not self.sampling.forces:
            return alpha
        share = self.testing.defensive_share if alpha else 1.0
        return (share, *((1.0 - share) * weight for weight in alpha))

    def content_hash(self, environment_parameters: str, challenge: str | None = None) -> str:
        """Hash of everything that changes an episode's bits; ``challenge`` is the hash of one of the user's own.

        Cells, workers, estimator, stop rule, trace policy and names are left out, so that a campaign can be continued.
        """
        others = {} if self.scenario == DEFAULT_FAMILY else {"scenario": self.scenario}
        unused = set() if self.av.acts_before_event else {"shadow_paths"}
        testing = self.testing.model_dump(exclude={"estimator"}) | {"challenge": challenge or self.testing.challenge}
        if not self.testing.shells.beyond_envelope:
            del testing["shells"]["beyond_envelope"]
        content = others | {
            "crash": self.crash.model_dump(),
            "seed": self.seed,
            "environment": self.environment.model_dump(exclude={"parameters"}),
            "environment_parameters": environment_parameters,
            "av": self.av.identity(),
            "surrogates": [(name, model.identity()) for name, model in self.surrogates.items()],
            "testing": testing,
            "pool": self.pool.model_dump(exclude=unused) if self.sampling.strata else None,
            "engine": self.world.engine,
            "moments": self.records.moments,
            "shard_size": self.run.smallest_shard,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


# -- what does not go with what: one table of methods, vehicles, events, engines and commands --

Command = Literal["run", "compare", "av-check"]


class Use(NamedTuple):
    """The command (none while a campaign is read), whether cut-ins take time, whether the AV follows from the start."""

    command: Command | None = None
    shows: bool = False
    follows: bool = False


class Combination(NamedTuple):
    """What is refused: where to put the blame, when, and the words, with values of the campaign in braces."""

    where: str
    is_asked: Callable[[Campaign, Use], bool]
    found: str
    expected: str
    mend: str


_FOLLOWS = "in {scenario}, where the AV follows a vehicle from the start"


def _waits(key: str, usual: Any) -> Combination:
    """Refuses what differs from `WAITS` where the AV follows."""

    def differs(c: Campaign, use: Use) -> bool:
        return use.follows and bool(getattr(c.av, key) != usual)

    found, expected = f"{{av.{key}}}, {_FOLLOWS}", f"{usual}, which means nothing there: the vehicle drives in any case"
    return Combination(f"av.{key}", differs, found, expected, "Delete the key.")


REFUSED = (
    # -- limits --
    Combination(
        "accept", lambda c, _: c.accept is not None and not c.sampling.strata,
        "a limit, with testing.method {testing.method}",
        "testing.method shells: how often decisions are wrong is known for its intervals alone",
        "Choose shells, or delete the section and compare the interval with the limit yourself.",
    ),
    # -- several scenarios --
    Combination(
        "scenario", lambda c, _: c.scenarios is not None and c.scenario != DEFAULT_FAMILY,
        "{scenario}, beside scenarios", "one of both", "Delete one of both keys.",
    ),
    Combination(
        "scenarios", lambda c, _: c.scenarios is not None and len(set(c.scenarios)) < len(c.scenarios),
        "a scenario that is named twice", "each once", "Delete one of both.",
    ),
    Combination(
        "testing.method", lambda c, _: c.scenarios is not None and not c.sampling.strata,
        "{testing.method}, with several scenarios",
        "shells: rates of several kinds of events are one sum over strata", "Choose shells, or write one scenario.",
    ),
    Combination(
        "testing.shells.statement",
        lambda c, _: c.scenarios is not None and c.testing.shells.statement != "assumption_free",
        "{testing.shells.statement}, with several scenarios",
        "assumption_free: the sum is over all strata, and each library has a boundary of its own",
        "Delete the key, or write one scenario.",
    ),
    Combination(
        "pool.library", lambda c, _: c.scenarios is not None and c.pool.library is not None,
        "one library, with several scenarios", "null: each scenario has its own",
        "Delete the key, or write one scenario.",
    ),
    Combination(
        "exposure", lambda c, _: bool(c.exposure) and c.scenarios is None,
        "{exposure}, with one scenario", "events per hour of those that are tested",
        "Add --scenario all (scenarios: [cut_in, lead_brakes, cut_out]), or delete it: one has that of its traffic.",
    ),
    Combination(
        "environments",
        lambda c, _: bool(set(c.environments) - set(c.scenarios or ()) | {DEFAULT_FAMILY} & set(c.environments)),
        "{environments}: of cut_in, or of a scenario that is not among scenarios",
        "files of the others that are tested",
        "Name it among scenarios; that of cut_in, or of one scenario alone, is environment.parameters.",
    ),
    # -- vehicles that act before the event --
    Combination(
        "av.before_event",
        lambda c, use: (
            c.av.acts_before_event and (c.sampling.holds_speed or (use.shows and not c.sampling.baseline_runs))
        ),
        "controller, with testing.method {testing.method}",
        "hold_speed: the method draws the event, or its onset, ahead, which needs to know the AV's path",
        "Choose hold_speed, or testing.method shells (or forced), which drives the AV along its paths first.",
    ),
    Combination(
        "av.before_event", lambda c, _: c.av.acts_before_event and c.av.model is not None,
        "controller, with the built-in model {av.model}",
        "hold_speed: a built-in model has nothing to follow before the event",
        "Delete the key, or bring a controller of your own.",
    ),
    # -- where tests are simulated --
    Combination(
        "world.engine", lambda c, _: c.world.engine == "twin" and c.av.source in ("sumo", "traci"),
        "twin, with an AV that SUMO moves (av.{av.source})", "sumo", "Write engine: sumo.",
    ),
    # -- what methods need and allow --
    Combination(
        "surrogates", lambda c, _: not c.surrogates and c.sampling.mixes,
        "none", "at least one surrogate for testing.method {testing.method}",
        "Leave surrogates out for the three of the paper, or choose method forced or nde.",
    ),
    Combination(
        "surrogates", lambda c, _: bool(c.own_surrogates) and c.testing.challenge != "recursive",
        "a class of your own, with testing.challenge {testing.challenge}",
        "recursive: a class is driven for one hold period from each state, no more",
        "Write recursive, or name drivers.",
    ),
    Combination(
        "stop.rhw", lambda c, _: c.stop.rhw is not None and not c.sampling.bounded and c.testing.epsilon < 1.0,
        "{stop.rhw:g}, with testing.method {testing.method}",
        "no precision to stop at: weights of the step mixture may reach 1/epsilon to the power of its steps, and while "
        "the large ones are missing its interval looks narrow",
        "Set it to null for a fixed number of tests (stop.episodes), or choose shells, forced or episode_mixture.",
    ),
    Combination(
        "stop.below_reference",
        lambda c, _: c.stop.below_reference is not None and (c.stop.rhw is None or not c.sampling.strata),
        "{stop.below_reference:g}, where no stop.rhw is asked of tests from shells",
        "nothing: all it does is to end a run of shells before its stop.rhw is reached",
        "Write null; or ask for that limit alone, by accept.times_reference.",
    ),
    Combination(
        "stop.episodes", lambda c, _: c.stop.episodes < LEAST_TESTS.get(c.testing.estimator or "", 0),
        "{stop.episodes:g}, with testing.estimator {testing.estimator}",
        f"at least {LEAST_TESTS['dr']:,}: below, its intervals miss too often",
        "Raise it, or delete testing.estimator.",
    ),
    Combination(
        "records.moments", lambda c, _: c.testing.estimator == "scv" and c.records.moments == "none",
        "none, with testing.estimator scv", "first_9 or all: its control variates are of control steps",
        "Write first_9, or delete testing.estimator.",
    ),
    # -- cut-ins that take time, and scenarios in which the AV follows --
    Combination(
        "testing.method", lambda c, use: (use.shows or use.follows) and c.sampling.mixes,
        "{testing.method}, in {scenario}: cut-ins take time (`lateral` of the environment), or the AV follows",
        "shells, forced or nde: importance functions are those of cut-ins of one step",
        "Choose shells; or, of cut_in, add --set environment.parameters=ndd-overtaking-1.",
    ),
    *starmap(_waits, WAITS.items()),
    Combination(
        "av.model", lambda c, use: use.follows and c.av.model == "r157-fsm",
        "r157-fsm, " + _FOLLOWS,
        "another driver: how the fuzzy safety model meets lead braking has not been tried",
        "Choose r157-cc, idm or fvdm, or bring a controller of your own.",
    ),
    Combination(
        "av.parameters.time_headway_s",
        lambda c, use: (
            use.command is not None and not use.follows and getattr(c.av.parameters, "time_headway_s", None) == NATURAL
        ),
        "natural, in {scenario}", "seconds: the vehicle does not follow before the event",
        "Write a number, or scenario: lead_brakes.",
    ),
    Combination(
        "environment",
        lambda c, use: use.follows and c.environment != EnvironmentSettings(parameters=c.environment.parameters),
        "numbers of cut-ins, " + _FOLLOWS,
        "parameters alone", "Delete lane_change_level, acceleration_hold_s and cut_in_lead_s.",
    ),
    # -- comparisons --
    Combination(
        "testing.method", lambda c, use: use.command == "compare" and not c.sampling.strata,
        "{testing.method}, in a comparison", "shells, under which both vehicles meet the same events",
        "Write --set testing.method=shells; or run both by themselves and put their intervals side by side.",
    ),
    Combination(
        "accept", lambda c, use: use.command == "compare" and c.accept is not None,
        "a limit of one crash rate", "none in a comparison",
        "Write --set accept=null, and --margin if something is to be decided.",
    ),
    Combination(
        "av.before_event", lambda c, use: use.command == "compare" and c.has_baseline_runs,
        "controller: a vehicle that acts before the event has events of its own",
        "hold_speed in A and B: pairs need the same events",
        "Run both campaigns by themselves and put their intervals side by side, or write hold_speed.",
    ),
)  # fmt: skip
"""All that is refused, in the order in which it is told."""


def refusal(campaign: Campaign, use: Use | None = None) -> tuple[str, str, str, str] | None:
    """Where, found, expected and mend of the first combination that is refused; None if the campaign may go on."""
    while_read = Use()
    use = use or while_read
    for row in REFUSED:
        # A command may change a campaign that has been read: what it was allowed with then is not asked again.
        if row.is_asked(campaign, use) and not (use != while_read and row.is_asked(campaign, while_read)):
            values = dict(campaign)
            return row.where, row.found.format(**values), row.expected.format(**values), row.mend
    return None
