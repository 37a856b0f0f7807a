"""What a replication experiment is: a campaign to repeat, the vehicles or chains to repeat it with, and how often."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from harness.campaign.campaign import Campaign
from harness.campaign.drivers import BuiltInParameters
from harness.campaign.models import parse_override, read_model
from harness.campaign.sections import Positive, Section, Whole
from harness.campaign.vehicle import AutomatedVehicle
from harness.families.cut_in.family import CUT_IN
from harness.families.cut_in.loading import load_environment
from harness.problems import NAME_PATTERN, broken_rule
from harness.vehicles.library import load_library
from harness.vocabulary import SAMPLING, EstimatorName
from studies.chains.chain import CHAINS

AvName = Annotated[str, Field(pattern=NAME_PATTERN)]


class SuperPopulation(Section):
    """Paths enumerated once, that pools of all replications are drawn from; and others for the truth.

    A vehicle that acts before the cut-in walks all of these itself, and its pools have ``pool.shadow_paths``.
    """

    paths: Whole = Field(65_536, ge=1024, le=1 << 22, description="paths that pools are drawn from, with replacement")
    reference_paths: Whole = Field(65_536, ge=0, le=1 << 22, description="independent ones for the truth; 0: the same")
    pool_paths: Whole = Field(16_384, ge=256, le=1 << 20, description="paths of each pool; smoke.yaml has 32,768")


class Adversary(Section):
    """A vehicle made to look for a weak place of the intervals: another one's crashes, some of them elsewhere or gone.

    Its truth is that of the super-population which pools are drawn from: what is rare there is rare for both.
    """

    of: AvName = Field(description="vehicle of avs whose crashes it has")
    crashes: Literal["everywhere", "on_heaviest_paths", "on_lightest_paths"] = "everywhere"
    """those inside the boundary that it has: on paths that weigh most, or least"""
    share: float = Field(0.1, gt=0.0, le=1.0, description="share of its crash rate that these paths hold")
    hole: float = Field(0.0, ge=0.0, le=1.0, description="share of cut-ins outside on which it crashes besides")
    failing: float = Field(0.0, ge=0.0, lt=1.0, description="share of its crashes that end as failed tests instead")
    failing_tests: float = Field(0.0, ge=0.0, lt=1.0, description="share of all tests that fail, crash or not")


class Pair(Section):
    """Two vehicles, compared on the same cut-ins."""

    a: AvName = Field(description="one of avs or adversaries")
    b: AvName = Field(description="another, or the same")


class Experiment(Section):
    """A replication experiment, as one YAML file describes it."""

    format: Literal["validation-experiment"]
    version: Literal[1]
    name: str = Field(pattern=NAME_PATTERN)
    description: str = ""
    seed: Whole = Field(1, ge=0, lt=2**31)
    replications: Whole = Field(2000, ge=2, le=1_000_000, description="independent repetitions for each vehicle")
    campaign: Campaign = Field(description="what is repeated; its own av is replaced, stop.rhw null means a fixed n")
    avs: dict[AvName, AutomatedVehicle] = Field({}, description="built-in models; under shells controllers that act")
    adversaries: dict[AvName, Adversary] = Field({}, description="made of some of avs; under shells alone")
    pairs: dict[AvName, Pair] = Field({}, description="comparisons, instead of single vehicles; under shells alone")
    chains: list[str] = Field([], description="exact Markov chains, instead of avs")
    estimators: list[EstimatorName] = Field([], description="whose results are judged; the method's own when left out")
    limits: list[Positive] = []
    """judge decisions instead of intervals: limits of `accept`, as multiples of each one's crash rate in the
    super-population; at 1 both verdicts are wrong, and each is judged"""
    verdicts: list[Positive] = []
    """judge decisions, too: limits as multiples of the rate of `beside`; which is wrong follows from one's own ratio"""
    beside: str | None = Field(None, description="decide limits beside this reference driver: accept.times_reference")
    budgets: list[Whole] = Field([], description="numbers of tests within which limits are judged, and stop.episodes")
    siblings: bool = Field(False, description="also judge former rules of limits and bounds, which err more often")
    super_population: SuperPopulation = SuperPopulation()

    @property
    def results(self) -> tuple[EstimatorName, ...]:
        """Estimators to judge."""
        return tuple(self.estimators) or (SAMPLING[self.campaign.testing.method].headline,)

    @property
    def nominal(self) -> float:
        """Share of intervals that are to hold the truth, or of decisions that are to be right."""
        confidence = self.campaign.stop.confidence
        return (1.0 + confidence) / 2.0 if self.limits else confidence

    def nominal_of(self, result: str) -> float:
        """`nominal`, or that of a decision beside which intervals are judged, too."""
        return (1.0 + self.campaign.stop.confidence) / 2.0 if result.startswith("limit ") else self.nominal

    @property
    def all_budgets(self) -> tuple[int, ...]:
        """Numbers of tests within which limits are judged, ascending."""
        most = self.campaign.stop.episodes
        return tuple(sorted({min(budget, most) for budget in (*self.budgets, most)}))

    def subject(self, name: str) -> Campaign:
        """The campaign with one of the vehicles."""
        return self.campaign.model_copy(update={"av": self.avs[name]})

    @property
    def acting(self) -> list[str]:
        """Vehicles that act before the cut-in."""
        return [name for name, av in self.avs.items() if av.acts_before_event]

    @property
    def holding(self) -> dict[str, AutomatedVehicle]:
        """Vehicles that keep their speed until the cut-in."""
        return {name: av for name, av in self.avs.items() if not av.acts_before_event}

    def seed_of(self, place: int) -> int:
        """Seed of a subject's own, by its place in the file."""
        return self.seed * 1000 + place

    @field_validator("campaign", mode="before")
    @classmethod
    def _in_the_twin(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        world = value.get("world") or {}
        if isinstance(world, dict):
            world = {"engine": "twin", **world}
        return {"name": "replicated", **value, "world": world}

    @model_validator(mode="after")
    def _can_be_repeated(self) -> Self:
        """Refuse what would be repeated as something else, or not at all."""
        method = self.campaign.testing.method
        held = [*self.holding, *(name for name, made in self.adversaries.items() if made.of in self.holding)]
        names: list[tuple[str, str, Collection[str]]] = [("chains", name, CHAINS) for name in self.chains]
        names += [(f"adversaries.{name}.of", made.of, self.avs) for name, made in self.adversaries.items()]
        names += [(f"pairs.{name}", one, held) for name, pair in self.pairs.items() for one in (pair.a, pair.b)]
        names += [("estimators", name, SAMPLING[method].estimators) for name in self.results]
        names += [("campaign.world.engine", self.campaign.world.engine, ["twin"])]
        for key in ("adversaries", "pairs", "limits", "verdicts"):
            names += [("campaign.testing.method", method, ["shells"])] * bool(getattr(self, key))
        twice = {*self.adversaries} & {*self.avs}
        names += [(f"adversaries.{name}", name, ["a name that avs has not"]) for name in twice]
        names += [("limits", "limits for pairs", ["limits for single vehicles"])] * bool(self.limits and self.pairs)
        names += [("beside", "none", ["a reference driver, for verdicts"])] * bool(self.verdicts and not self.beside)
        for name, av in self.avs.items():
            driven = "a built-in model" if isinstance(av.parameters, BuiltInParameters) else f"av.{av.source}"
            if av.acts_before_event and method == "shells":  # it walks the paths of its pools first
                names.append((f"avs.{name}", driven, ["av.controller", "av.fmu"]))
            else:
                found = f"{driven} with before_event {av.before_event}"
                names.append((f"avs.{name}", found, ["a built-in model with before_event hold_speed"]))
        for key, name, known in names:
            if name not in known:
                mend = "Change it, or leave it out; what has no twin can be tested in SUMO with `harness run`."
                raise broken_rule(key, f"'{name}'", " or ".join(known), mend)
        if bool(self.avs) == bool(self.chains):
            found, mend = "both avs and chains" if self.avs else "neither avs nor chains", "Keep one of the two."
            raise broken_rule("avs", found, "vehicles that overtake in the twin, or exact chains", mend)
        return self


def load_experiment(path: Path, overrides: Sequence[str] = ()) -> Experiment:
    """Read an experiment, with ``section.key=value`` laid over what the file says.

    Raises `CampaignError`: the file, or the library that it names, cannot be read or says something wrong.
    """
    experiment = read_model(path, Experiment, [parse_override(text) for text in overrides])
    shows = load_environment(experiment.campaign.environment).lateral.present
    library = experiment.campaign.pool.library or CUT_IN.ladders[shows]
    load_library(library)
    return experiment.replaced(("campaign", "pool", "library"), library)
