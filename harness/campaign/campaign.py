"""What a campaign is: frozen, validated models, one class per YAML section, and the rules between sections.

A campaign says which traffic (``environment``) meets which vehicle (``av``), how critical moments are found and
sampled (``surrogates``, ``testing``), where it is simulated (``world``), what is kept (``records``) and when it is
enough (``stop``). Units are in the field names.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any, Self

from pydantic import Field, model_validator

from harness.campaign.problems import NAME_PATTERN, broken_rule
from harness.campaign.sections import (
    MOST_SUMO_CELLS,
    Accept,
    EnvironmentSettings,
    PoolSettings,
    Records,
    Run,
    Section,
    Stop,
    SurrogateName,
    Testing,
    Whole,
    World,
    listed,
)
from harness.campaign.vehicle import (
    AutomatedVehicle,
    Surrogate,
    default_surrogates,
)
from harness.vocabulary import METHODS, SAMPLING


class Campaign(Section):
    """A test campaign, as one YAML file describes it."""

    name: str = Field(pattern=NAME_PATTERN, description="short name of letters, digits, _ . and -, used in reports")
    description: str = Field("", description="what this campaign is for, in a sentence")
    seed: Whole = Field(1, ge=0, lt=2**63, description="every random number follows from it")
    environment: EnvironmentSettings = EnvironmentSettings()
    av: AutomatedVehicle = AutomatedVehicle()
    surrogates: dict[SurrogateName, Surrogate] = Field(
        default_factory=default_surrogates, description="stand-ins for the unknown AV, by name"
    )
    testing: Testing = Testing()
    pool: PoolSettings = PoolSettings()
    world: World = World()
    records: Records = Records()
    stop: Stop = Stop()
    accept: Accept | None = Field(None, description="stop at a decision instead of at a precision")
    run: Run = Run()

    @model_validator(mode="before")
    @classmethod
    def _what_decides_is_what_is_tested(cls, content: Any) -> Any:
        """One place says which statement a run is about, and that its tests follow: ``testing.shells.statement``."""
        if not isinstance(content, dict) or not isinstance(accept := content.get("accept"), dict):
            return content
        asked, testing = accept.get("statement"), content.get("testing") or {}
        shells = testing.get("shells") or {} if isinstance(testing, dict) else None
        if asked is None or not isinstance(shells, dict) or "statement" in shells:
            return content
        return {**content, "testing": {**testing, "shells": {**shells, "statement": asked}}}

    @model_validator(mode="after")
    def _limit_can_be_decided(self) -> Self:
        if self.accept is None:
            return self
        asked, shells = self.accept.statement, self.testing.shells
        if self.testing.method != "shells":
            raise broken_rule(
                "accept",
                found=f"a limit, with testing.method {self.testing.method}",
                expected="testing.method shells: how often decisions are wrong is known for its intervals alone",
                mend="Choose shells, or delete the section and compare the interval with the limit yourself.",
            )
        if asked not in (None, shells.statement):
            raise broken_rule(
                "accept.statement",
                found=f"{asked}, and {shells.statement} in testing.shells.statement",
                expected="the same statement, or one of the two keys alone",
                mend="Delete one of them.",
            )
        if shells.stopping != "sequential":
            raise broken_rule(
                "accept",
                found=f"a limit, with testing.shells.stopping {shells.stopping}",
                expected="sequential: a decision plans no second phase",
                mend="Delete testing.shells.stopping.",
            )
        return self

    @model_validator(mode="after")
    def _alpha_matches_surrogates(self) -> Self:
        alpha = self.testing.alpha
        if alpha is not None and set(alpha) != set(self.surrogates):
            raise broken_rule(
                "testing.alpha",
                found=f"weights for {listed(alpha)}",
                expected=f"one weight for each surrogate: {listed(self.surrogates)}",
                mend="Name the surrogates exactly, or leave alpha out for equal weights.",
            )
        return self

    @model_validator(mode="after")
    def _av_suits_method_and_world(self) -> Self:
        method, av, world = self.testing.method, self.av, self.world
        if av.acts_before_cut_in and SAMPLING[method].holds_speed:
            raise broken_rule(
                "av.before_cut_in",
                found=f"controller, with testing.method {method}",
                expected="hold_speed: the method draws LV's and BV's path ahead, which needs to know the AV's",
                mend="Choose hold_speed, or testing.method shells (or forced), which drives the AV along its paths "
                "first.",
            )
        if av.acts_before_cut_in and av.model is not None:
            raise broken_rule(
                "av.before_cut_in",
                found=f"controller, with the built-in model {av.model}",
                expected="hold_speed: a built-in model has nothing to follow before the cut-in",
                mend="Delete the key, or bring a controller of your own.",
            )
        if world.engine == "twin" and av.source in ("sumo", "traci"):
            raise broken_rule(
                "world.engine",
                found=f"twin, with an AV that SUMO moves (av.{av.source})",
                expected="sumo",
                mend="Write engine: sumo.",
            )
        if world.engine == "sumo" and world.cells > MOST_SUMO_CELLS:
            raise broken_rule(
                "world.cells",
                found=f"{world.cells}, with engine sumo",
                expected=f"at most {MOST_SUMO_CELLS}: so many roads has the largest network",
                mend="Lower it; about 64 is fastest. It never changes a result.",
            )
        return self

    @model_validator(mode="after")
    def _method_has_surrogates_and_bounded_weights(self) -> Self:
        sampling = SAMPLING[self.testing.method]
        if not self.surrogates and sampling.mixes:
            raise broken_rule(
                "surrogates",
                found="none",
                expected=f"at least one surrogate for testing.method {self.testing.method}",
                mend="Leave surrogates out for the three of the paper, or choose method forced or nde.",
            )
        if self.stop.rhw is not None and not sampling.bounded:
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
        if watched is None:
            return self
        allowing = [name for name in METHODS if watched in SAMPLING[name].estimators]
        available = method in allowing
        if len(allowing) == 1:
            need = f"testing.method {allowing[0]}"
        else:
            need = f"another testing.method than {listed(name for name in METHODS if name not in allowing)}"
        if watched == "scv":
            need += " and records.moments first_9 or all"
            available = available and self.records.moments != "none"
        if not available:
            raise broken_rule(
                "stop.estimator",
                found=f"{watched}, which these records will not allow",
                expected=f"an estimator that can be computed, and {watched} needs {need}",
                mend="Change one of the two, or leave stop.estimator out for the method's own.",
            )
        return self

    @property
    def has_shadow_runs(self) -> bool:
        """Whether the AV is first driven along its paths without a cut-in."""
        return self.av.acts_before_cut_in and SAMPLING[self.testing.method].shadows

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
        """Hash of everything that changes an episode's bits, that of the environment's parameters included.

        Cells, workers, stop rule, trace policy and names are left out, so that a campaign can be continued to a
        smaller RHW or with other resources.
        """
        shells = self.testing.method == "shells"
        planned = shells and self.testing.shells.stopping == "two_phase"
        environment, testing = self.environment.model_dump(exclude={"parameters"}), self.testing.model_dump()
        # What came later changes no hash of before where it is left as it is.
        if environment["cut_in_lead_s"] is None:
            del environment["cut_in_lead_s"]
        if testing["shells"]["smallest_round"] == 1:
            del testing["shells"]["smallest_round"]
        unused = {"shadow_paths"} if not self.av.acts_before_cut_in else set()
        content = {
            **({"rhw": self.stop.rhw} if planned else {}),  # it decides where the second phase begins
            "seed": self.seed,
            "environment": environment,
            "environment_parameters": environment_parameters,
            "av": self.av.identity(),
            "surrogates": [(name, model.model_dump()) for name, model in self.surrogates.items()],
            "testing": testing,
            "pool": self.pool.model_dump(exclude=unused) if shells else None,
            "engine": self.world.engine,
            "moments": self.records.moments,
            "shard_size": self.run.smallest_shard,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
