"""What a campaign is: frozen, validated models, one class per YAML section, and the rules between sections.

A campaign says which traffic (``environment``) meets which vehicle (``av``), how critical moments are found and
sampled (``surrogates``, ``testing``), where it is simulated (``world``), what is kept (``records``) and when it is
enough (``stop``). Units are in the field names.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from typing import Any, Self

import yaml
from pydantic import Field, model_validator
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from harness.campaign.combinations import refusal
from harness.campaign.drivers import Surrogate, default_surrogates
from harness.campaign.problems import NAME_PATTERN, broken_rule
from harness.campaign.sections import (
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
from harness.campaign.vehicle import AV_SOURCES, AutomatedVehicle
from harness.vocabulary import SAMPLING, Sampling


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
    def _parts_go_together(self) -> Self:
        alpha = self.testing.alpha
        if alpha is not None and set(alpha) != set(self.surrogates):
            expected = f"one weight for each surrogate: {listed(self.surrogates)}"
            mend = "Name the surrogates exactly, or leave alpha out for equal weights."
            raise broken_rule("testing.alpha", f"weights for {listed(alpha)}", expected, mend)
        if (words := refusal(self)) is not None:
            raise broken_rule(*words)
        return self

    @property
    def sampling(self) -> Sampling:
        """What is to be known of its method, ``testing.method``."""
        return SAMPLING[self.testing.method]

    @property
    def has_baseline_runs(self) -> bool:
        """Whether the AV is first driven along its paths without a cut-in."""
        return self.av.acts_before_cut_in and self.sampling.baseline_runs

    @property
    def min_crashes(self) -> int:
        """Sampled crashes needed before RHW may stop the campaign; limits within shells are exact, without a floor."""
        if self.stop.min_crashes is not None:
            return self.stop.min_crashes
        return 1 if self.sampling.strata else 100

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
        shells = self.sampling.strata
        environment, testing = self.environment.model_dump(exclude={"parameters"}), self.testing.model_dump()
        # What came later changes no hash of before where it is left as it is.
        if environment["cut_in_lead_s"] is None:
            del environment["cut_in_lead_s"]
        if testing["shells"]["smallest_round"] == 1:
            del testing["shells"]["smallest_round"]
        testing["shells"]["stopping"] = "sequential"  # nor does what went
        unused = {"shadow_paths"} if not self.av.acts_before_cut_in else set()
        content = {
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


# -- campaigns and their schema, written --

_HEADER = """\
# Campaign {name}, resolved: every value is written out, defaults included.
# Lists of allowed keys and values: harness schema. Run it again: harness run THIS_FILE --out DIR
"""


class _Dumper(yaml.SafeDumper):
    """Quotes every text that is not a plain word: other YAML readers see numbers, dates and truth values in many."""

    def ignore_aliases(self, _data: Any) -> bool:
        """Write every value out."""
        return True

    def represent_text(self, text: str) -> yaml.ScalarNode:
        """Node of a text."""
        plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", text) and text.lower() not in _MISREAD
        node: yaml.ScalarNode = self.represent_scalar("tag:yaml.org,2002:str", text, style=None if plain else '"')
        return node


_Dumper.add_representer(str, _Dumper.represent_text)
_MISREAD = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}


def dump_campaign(campaign: Campaign) -> str:
    """YAML text of a campaign; `harness.campaign.files.load_campaign` reads an equal campaign from it."""
    parts = [_HEADER.format(name=campaign.name)]
    for key, value in written_out(campaign).items():
        section = getattr(campaign, key)
        about = section.__doc__ if isinstance(section, Section) else type(campaign).model_fields[key].description
        parts.append(f"\n# {(about or key).splitlines()[0]}\n{yaml_text({key: value})}")
    return "".join(parts)


def written_out(campaign: Campaign) -> dict[str, Any]:
    """Plain data of a campaign with every default, but of the sources of an AV only the one that drives it."""
    data = campaign.model_dump()
    data["av"] = {key: value for key, value in data["av"].items() if key not in AV_SOURCES or value is not None}
    return data


def yaml_text(data: dict[str, Any]) -> str:
    """YAML of plain data, which `harness.campaign.files` reads back as it is."""
    # Escapes keep every character, control characters included, through any editor; math.inf never folds a line.
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=False, width=math.inf)
    return text


class _Schema(GenerateJsonSchema):
    """Without titles that repeat the keys; mappings whose names follow a pattern have no others."""

    def field_title_should_be_set(self, _schema: CoreSchema) -> bool:
        return False

    def dict_schema(self, schema: core_schema.DictSchema) -> JsonSchemaValue:
        return {"additionalProperties": False, **super().dict_schema(schema)}


def schema_text() -> str:
    """JSON schema (draft 2020-12) of a campaign, committed beside the scenarios and printed by ``harness schema``."""
    about = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "harness campaign"}
    schema = {**about, **Campaign.model_json_schema(schema_generator=_Schema), **about}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
