"""What a replication experiment is: a campaign to repeat, the vehicles or chains to repeat it with, and how often."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from harness.campaign.campaign import Campaign
from harness.campaign.files import Places, apply_overrides, parse_override
from harness.campaign.problems import NAME_PATTERN, broken_rule, validated
from harness.campaign.sections import Positive, Section, Whole
from harness.campaign.vehicle import AutomatedVehicle, BuiltInParameters
from harness.campaign.yaml_text import read_yaml
from harness.errors import CampaignError
from harness.vocabulary import SAMPLING, EstimatorName
from studies.chains.named import CHAINS

AvName = Annotated[str, Field(pattern=NAME_PATTERN)]


class SuperPopulation(Section):
    """Paths enumerated once, that pools of all replications are drawn from; and others for the truth.

    A vehicle that acts before the cut-in walks all of these itself, and its pools have ``pool.shadow_paths``.
    """

    paths: Whole = Field(65_536, ge=1024, le=1 << 22, description="paths that pools are drawn from, with replacement")
    reference_paths: Whole = Field(65_536, ge=1024, le=1 << 22, description="independent paths that the truth is from")
    pool_paths: Whole = Field(16_384, ge=256, le=1 << 20, description="paths of each pool; smoke.yaml has 32,768")


class Fault(Section):
    """A mistake made on purpose, to show that the experiment notices."""

    shell: Whole = Field(0, ge=0, description="stratum whose probability is wrong, from the most careful on")
    factor: float = Field(gt=0.0, description="wrong probability over the right one")


class Adversary(Section):
    """A vehicle made to look for a weak place of the intervals: another one's crashes, some of them elsewhere or gone.

    Its truth is that of the super-population which pools are drawn from: what is rare there is rare for both.
    """

    of: AvName = Field(description="vehicle of avs whose crashes it has")
    crashes: Literal["everywhere", "on_heaviest_paths", "on_lightest_paths"] = Field(
        "everywhere",
        description="which of its crashes inside the boundary it has: those on the paths that weigh most, or least",
    )
    share: float = Field(0.1, gt=0.0, le=1.0, description="share of its crash rate that these paths hold")
    hole: float = Field(
        0.0, ge=0.0, le=1.0, description="share of cut-ins outside the boundary on which it crashes besides"
    )
    failing: float = Field(0.0, ge=0.0, lt=1.0, description="share of its crashes that end as failed tests instead")


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
    avs: dict[AvName, AutomatedVehicle] = Field(
        default_factory=dict,
        description="vehicles, overtaking in the twin: built-in models, and for testing.method shells controllers with "
        "before_cut_in controller",
    )
    adversaries: dict[AvName, Adversary] = Field(
        default_factory=dict, description="made of some of avs; testing.method shells alone"
    )
    pairs: dict[AvName, Pair] = Field(
        default_factory=dict,
        description="comparisons to repeat instead of campaigns of single vehicles; testing.method shells alone",
    )
    chains: list[str] = Field(default_factory=list, description="exact Markov chains, instead of avs")
    estimators: list[EstimatorName] = Field(
        default_factory=list, description="whose results are judged; the method's own when left out"
    )
    limits: list[Positive] = Field(
        default_factory=list,
        description="judge decisions instead of intervals: limits of `accept`, as multiples of each one's crash rate",
    )
    super_population: SuperPopulation = SuperPopulation()
    fault: Fault | None = None

    @property
    def results(self) -> tuple[EstimatorName, ...]:
        """Estimators to judge."""
        return tuple(self.estimators) or (SAMPLING[self.campaign.testing.method].headline,)

    @property
    def nominal(self) -> float:
        """Share of intervals that are to hold the truth, or of decisions that are to be right."""
        confidence = self.campaign.stop.confidence
        return (1.0 + confidence) / 2.0 if self.limits else confidence

    def subject(self, name: str) -> Campaign:
        """The campaign with one of the vehicles."""
        return self.campaign.model_copy(update={"av": self.avs[name]})

    @property
    def acting(self) -> dict[str, AutomatedVehicle]:
        """Vehicles that act before the cut-in."""
        return {name: av for name, av in self.avs.items() if av.acts_before_cut_in}

    @property
    def holding(self) -> dict[str, AutomatedVehicle]:
        """Vehicles that keep their speed until the cut-in."""
        return {name: av for name, av in self.avs.items() if not av.acts_before_cut_in}

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
        for broken in chain(self._about_subjects(), self._about_vehicles(), self._about_the_method()):
            raise broken
        return self

    def _about_subjects(self) -> Iterator[PydanticCustomError]:
        """What is wrong with subjects, and those made of others."""
        if bool(self.avs) == bool(self.chains):
            yield broken_rule(
                "avs",
                "both avs and chains" if self.avs else "neither avs nor chains",
                "one of the two",
                "Name vehicles under avs for overtaking in the twin, or exact chains under chains.",
            )
        for name in self.chains:
            if name not in CHAINS:
                expected = f"some of {', '.join(CHAINS)}"
                yield broken_rule("chains", f"'{name}'", expected, "Choose one of them.")
        method = self.campaign.testing.method
        if self.adversaries and method != "shells":
            expected = "method shells: their crashes are drawn within shells"
            yield broken_rule("adversaries", f"adversaries for {method}", expected, "Delete them.")
        for name, made in self.adversaries.items():
            where, others = f"adversaries.{name}", ", ".join(self.avs)
            if made.of not in self.avs:
                expected = f"one of avs: {others}"
                yield broken_rule(f"{where}.of", f"'{made.of}'", expected, "Name one of them.")
            if name in self.avs:
                yield broken_rule(where, "a name that avs has, too", "another", "Rename it.")
        if self.pairs and method != "shells":
            expected = "method shells: it compares on drawn cut-ins"
            yield broken_rule("pairs", f"pairs for {method}", expected, "Delete them.")
        known = [*self.holding, *(name for name, made in self.adversaries.items() if made.of in self.holding)]
        for name, pair in self.pairs.items():
            for side, asked in (("a", pair.a), ("b", pair.b)):
                if asked not in known:
                    yield broken_rule(
                        f"pairs.{name}.{side}",
                        f"'{asked}'",
                        f"a vehicle that holds its speed before the cut-in: {', '.join(known)}",
                        "Name one of them; `harness compare` takes no others under shells.",
                    )

    def _about_vehicles(self) -> Iterator[PydanticCustomError]:
        """What has no twin."""
        if self.campaign.world.engine != "twin":
            yield broken_rule(
                "campaign.world.engine",
                self.campaign.world.engine,
                "twin: thousands of replications are not affordable in SUMO, whose records the twin's equal",
                "Leave the key out.",
            )
        for name, av in self.avs.items():
            built_in, acts = isinstance(av.parameters, BuiltInParameters), av.acts_before_cut_in
            if not (built_in or (av.source in ("controller", "fmu") and acts)):
                yield broken_rule(
                    f"avs.{name}",
                    f"an AV that av.{av.source} drives" + ("" if acts else " from the cut-in on"),
                    "a built-in model (idm, fvdm, constant), or a controller with before_cut_in controller: "
                    "replications run in the twin",
                    "Leave it out here, and test it in SUMO with `harness run`.",
                )
            if acts and (built_in or self.campaign.testing.method != "shells"):
                yield broken_rule(
                    f"avs.{name}.before_cut_in",
                    av.before_cut_in,
                    "hold_speed, but for a controller with testing.method shells, which walks paths first",
                    "Leave the key out.",
                )

    def _about_the_method(self) -> Iterator[PydanticCustomError]:
        """What the method does not allow."""
        method = self.campaign.testing.method
        judged = SAMPLING[method].estimators
        if wrong := set(self.results).difference(judged):
            expected = f"for testing.method {method}: {', '.join(sorted(judged))}"
            mend = "Change one of the two."
            yield broken_rule("estimators", ", ".join(sorted(wrong)), expected, mend)
        if self.limits and (method != "shells" or self.pairs):
            yield broken_rule(
                "limits",
                "comparisons of two vehicles" if self.pairs else f"testing.method {method}",
                "campaigns of single vehicles by testing.method shells, which alone decide",
                "Delete the key.",
            )
        if self.fault is not None and method != "shells":
            yield broken_rule("fault", f"a wrong shell for {method}", "method shells", "Delete it.")


def load_experiment(path: Path, overrides: Sequence[str] = ()) -> Experiment:
    """Read an experiment, with ``section.key=value`` laid over what the file says.

    Raises
    ------
    CampaignError
        The file cannot be read or says something wrong; the error names every place.
    """
    data, lines = read_yaml(path)
    changes = [parse_override(text) for text in overrides]
    experiment = validated(apply_overrides(data, changes), Experiment, str(path), Places(lines, changes))
    library = experiment.campaign.pool.library
    if "/" not in library and not library.endswith((".yaml", ".yml")):
        return experiment
    file = (path.parent / library).resolve()
    if not file.is_file():
        expected = "a surrogate library, or the name of a shipped one"
        mend = "Correct the path; it is relative to the folder of the experiment."
        raise CampaignError(f"{path}: campaign.pool.library", f"{library}, but there is no file {file}", expected, mend)
    return experiment.replaced(("campaign", "pool", "library"), str(file))
