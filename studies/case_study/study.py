"""What a study is: steps that name campaigns and experiments, sizes for a quick look, and claims to be answered."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self, TypeVar

from pydantic import Field, model_validator

from harness.campaign.models import Override, read_model
from harness.campaign.sections import Positive, Probability, Section, Whole
from harness.problems import NAME_PATTERN, broken_rule
from harness.progress import Progress
from studies.work import results_of, worker_processes

_Result = TypeVar("_Result")
StepName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
SettingName = Annotated[str, Field(pattern=r"^[^.|]+$")]
Overrides = list[str]
_OVERRIDES: Any = Field([], description="values laid over the file's, such as testing.epsilon=0.2")


class TwinTests(Section):
    """Tests in the twin, of which nothing is kept but those that crashed."""

    kind: Literal["twin_tests"]
    campaign: str = Field(description="campaign file, relative to the study's")
    set: Overrides = _OVERRIDES
    tests: Whole = Field(ge=1, le=1_000_000_000)


class Run(Section):
    """A campaign, run into a folder with all its records as `harness run` would."""

    kind: Literal["run"]
    campaign: str = Field(description="campaign file, relative to the study's")
    set: Overrides = _OVERRIDES


class Convergence(Section):
    """Crash rate and relative half-width on growing numbers of tests, one curve for each step that is named."""

    kind: Literal["convergence"]
    of: list[StepName] = Field(min_length=1, max_length=4, description="steps of kind twin_tests or run")
    reference: StepName = Field(description="step whose crash rate the others are compared with")
    words: dict[StepName, str] = Field({}, description="what to call them in the plot")


class ControlVariates(Section):
    """NADE with and without sparse control variates on growing parts of one run, and stratum by stratum."""

    kind: Literal["control_variates"]
    of: StepName = Field(description="step of kind run: a step mixture with records.moments first_9 or all")
    sizes: list[Whole] = Field(min_length=1, description="numbers of tests, rising, for the table")
    looks: Whole = Field(12, ge=2, le=100, description="numbers of tests between 300 and the last one, for the plot")
    spread_tests: Whole | None = Field(200_000, ge=10, description="first ones, shown one by one; null: no strata")
    parts: Whole = Field(10, ge=3, le=1_000, description="of each size, for the gain by replication")


class RequiredNumbers(Section):
    """Required numbers of tests (RNoT) over shuffles of the same tests, and their ratios (AAR)."""

    kind: Literal["required_tests"]
    of: list[StepName] = Field(min_length=1, description="steps of kind twin_tests or run; ratios are over the first")
    shuffles: Whole = Field(200, ge=1, le=10_000)
    scv: StepName | None = Field(None, description="step of kind run of which SCV's numbers are asked, too")
    scv_tests: Whole = Field(1_000_000, ge=10, description="first tests of that run that are shuffled for it")
    scv_shuffles: Whole = Field(4, ge=1, le=10_000, description="a regression for each look of each shuffle: minutes")
    scv_ratio: float = Field(1.5, gt=1.0, description="from one look of it to the next")


class Variants(Section):
    """One campaign with other vehicles or settings: what NADE and SCV claim of each."""

    kind: Literal["variants"]
    title: str | None = Field(None, description="of its table on the page, if it has a reference and a title")
    campaign: str = Field(description="campaign file, relative to the study's; of any method but shells")
    set: Overrides = _OVERRIDES
    tests: Whole = Field(ge=2, le=100_000_000, description="of each campaign")
    replications: Whole = Field(1, ge=1, le=10_000, description="campaigns with each of them")
    avs: list[str] = Field([], description="vehicles of the shipped panel")
    settings: dict[SettingName, Overrides] = Field({}, description="values laid over the campaign's")
    each_of: list[dict[SettingName, Overrides]] = Field([], description="settings; every combination is a variant")
    shown: dict[str, str] = Field({}, description="those that the page has, if not all, and their names there")
    epsilons: list[Probability] = Field([], description="values of testing.epsilon, a variant each")
    reference: StepName | None = Field(None, description="step with the crash rate of all, for tests by replication")
    shuffles: Whole = Field(0, ge=0, le=10_000, description="orderings of all tests of a variant, for their RNoT")
    means: Whole = Field(0, ge=0, le=100_000_000, description="other tests of each, whose means of columns are known")


class Theorems(Section):
    """The paper's three theorems on small chains, by enumeration of all episodes."""

    kind: Literal["theorems"]
    draws: Whole = Field(200, ge=2, le=100_000, description="repetitions of Theorem 3's estimates")
    tests: Whole = Field(2_000, ge=10, description="tests of each repetition")


class SmallCase(Section):
    """The smaller case of the 2022 conference version, with its exact crash rate and variances."""

    kind: Literal["small_case"]
    lane_change_level: Positive = Field(description="multiplies the hazard of a cut-in")
    rhw: Positive = Field(0.1, description="relative half-width that numbers of tests are for")
    tests: Whole = Field(100_000, ge=100, description="drawn tests for each setting")
    epsilons: list[Probability] = Field(default=[0.1], min_length=1)
    thresholds: list[Probability] = Field(default=[0.0], min_length=1, description="of criticality")
    draws: Whole = Field(200, ge=2, le=100_000, description="campaigns that are repeated to see the true spread")
    tests_of_draw: Whole = Field(1_000, ge=10)
    reported: dict[Literal["nade", "scv"], Positive] = Field({}, description="tests looked for among the settings")


Step = Annotated[
    TwinTests | Run | Variants | Convergence | ControlVariates | RequiredNumbers | Theorems | SmallCase,
    Field(discriminator="kind"),
]


class Claim(Section):
    """A number of the paper, beside one of a step's."""

    says: str = Field(description="what the paper says, in a few words")
    where: str = Field(description="section, figure or table")
    paper: float
    ours: str = Field(pattern=r"^\w+\..+$", description="STEP.FIGURE that answers it")
    within: float = Field(2.0, gt=1.0, description="factor within which our number counts as the same")
    tolerance: Positive | None = Field(None, description="distance that counts as the same, instead of a factor")
    at_most: bool = Field(False, description="whether the paper's number is a limit that ours does not exceed")
    why: str = Field("", description="why ours differs, as far as known; printed unless it is reproduced")
    fact: str = Field("", description="what several claims say, told in one row with the range of their numbers")
    ours_to_choose: bool = Field(False, description="whether a setting of ours decides it, so that nothing is judged")


class Line(Section):
    """A line of the last picture."""

    ours: str = Field(pattern=r"^\w+\..+$", description="STEP.FIGURE")
    paper: Positive | None = Field(None, description="what the paper reports")


class Study(Section):
    """A study, as one YAML file describes it."""

    format: Literal["case-study"]
    version: Literal[1]
    name: str = Field(pattern=NAME_PATTERN)
    title: str
    summary: str = Field("", description="what came out, in a few lines; left out where sizes allow no conclusions")
    rhw: Positive = Field(0.3, description="relative half-width that required numbers of tests are for")
    confidence: float = Field(0.9, gt=0.0, lt=1.0)
    steps: dict[StepName, Step] = Field(min_length=1, description="in the order in which they are made")
    quick: dict[StepName, dict[str, Any]] = Field({}, description="what --quick lays over steps, by step and key")
    claims: list[Claim] = Field(default_factory=list)
    conclusive: bool = Field(True, description="whether the sizes allow verdicts; those of --quick never do")
    picture: dict[str, Line] = Field({}, description="numbers of tests, by a label for each line")

    @model_validator(mode="after")
    def _asks_steps_that_are_there(self) -> Self:
        asked = [(f"claims.{k}.ours", claim.ours, self.steps) for k, claim in enumerate(self.claims)]
        asked += [(f"picture.{label}.ours", line.ours, self.steps) for label, line in self.picture.items()]
        asked += [(f"quick.{name}", name, self.steps) for name in self.quick]
        before: dict[str, Step] = {}
        for name, step in self.steps.items():
            asked += [(f"steps.{name}.{key}", wanted, dict(before)) for key, wanted in inputs_of(step)]
            before[name] = step
        for key, path, known in asked:
            if (name := path.partition(".")[0]) not in known:
                expected = f"one of the steps above it, {', '.join(known) or 'of which there is none'}"
                raise broken_rule(key, f"the step '{name}'", expected, "Name one of them.")
        return self


def inputs_of(step: Step) -> list[tuple[str, str]]:
    """Key and name of every step that a step reads."""
    found: list[tuple[str, str]] = []
    for key in ("of", "reference", "scv"):
        value = getattr(step, key, None)
        found += [(key, name) for name in ([value] if isinstance(value, str) else value or [])]
    return found


def load_study(path: Path, *, quick: bool = False) -> Study:
    """Read a study, with its ``quick`` sizes laid over its steps if they are asked for.

    Raises `CampaignError`: the file cannot be read or says something wrong; the error names every place.
    """
    study = read_model(path, Study)
    if quick:
        given = ((name, key, value) for name, values in study.quick.items() for key, value in values.items())
        changes = [Override(("steps", name, key), value, f"quick: steps.{name}.{key}") for name, key, value in given]
        title = f"{study.title} (quick: too few tests for conclusions)"
        study = read_model(path, Study, changes).model_copy(update={"title": title, "conclusive": False})
    placed = {}
    for name, step in study.steps.items():
        file = getattr(step, "campaign", None)
        placed[name] = step.model_copy(update={"campaign": str((path.parent / file).resolve())}) if file else step
    return study.model_copy(update={"steps": placed})


class Made(NamedTuple):
    """A finished step: its folder, and the content of its ``result.json``."""

    folder: Path
    result: dict[str, Any]


@dataclass(frozen=True)
class Context:
    """Where and how a step is made.

    Required numbers of tests are for ``rhw`` at a ``confidence``; ``made`` are the steps made before, by name. Without
    ``workers`` there is one for each core.
    """

    folder: Path
    rhw: float
    confidence: float
    made: Mapping[str, Made]
    workers: int | None
    progress: Progress

    def by_workers(self, jobs: Sequence[Any], make: Callable[[Any], _Result]) -> list[_Result]:
        """Results of all jobs, made by worker processes; see `results_of`."""
        with worker_processes(self.workers) as executor:
            return results_of(self.folder.name.rpartition("-")[0], jobs, make, self.progress, executor)
