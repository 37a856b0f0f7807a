"""Campaigns: read from files, or made for a vehicle by its name (``--av``); and written."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from harness.arguments import checked
from harness.campaign.campaign import Campaign
from harness.campaign.drivers import ModelName
from harness.campaign.models import (
    Override,
    Places,
    names_a_file,
    parse_override,
    read_model,
    shipped_or_own,
    validated,
)
from harness.campaign.python_files import in_python_file, is_script
from harness.campaign.sections import DEFAULT, DEFAULT_FAMILY, Section
from harness.campaign.vehicle import AV_SOURCES, Panel
from harness.campaign.yaml_text import read_yaml, yaml_text
from harness.errors import CampaignError
from harness.families import families, family_named
from harness.files import real_path
from harness.problems import did_you_mean, file_meant, listed

SHIPPED_PANEL = Path(__file__).parents[1] / "scenarios" / "av_panel.yaml"
_FILES = {
    ("av", "controller"): "a Python file with the controller",
    ("testing", "estimator"): "a Python file with the estimator",
    ("testing", "challenge"): "a Python file with the challenge",
    ("av", "fmu", "file"): "an FMI 2.0 co-simulation FMU",
    ("pool", "library"): "a surrogate library, or the name of a shipped one",
    ("environment", "parameters"): "a parameter file, or the name of a shipped one",
}
"""Places of a campaign that may name a file, and what that has to be."""


@checked("harness.load_campaign")
def load_campaign(
    path: str | Path, overrides: Sequence[str] = (), *, av: str | None = None, check_files: bool = True
) -> Campaign:
    """Read, override and validate a campaign; paths of files that it names become absolute.

    Parameters
    ----------
    path : str or Path
        Campaign file; or a vehicle (`named_vehicle`), which is driven until its rate is known to 30 %.
    overrides : sequence of str
        ``section.key=value`` each, as after ``--set``: ``["stop.rhw=0.3", "av.parameters.min_acceleration_mps2=-6"]``.
    av : str, optional
        Vehicle that replaces the campaign's, as after ``--av``; overrides are laid over it.
    check_files : bool
        Whether files that the campaign names must exist; False to look at a run whose environment file is gone.

    Raises `CampaignError`: the file cannot be read, is not YAML, or says something wrong; the error names every place.
    """
    vehicle = [] if av is None else [Override(("av",), named_vehicle(av, "--av "), f"--av {av}")]
    of_file = names_a_campaign(path)
    if vehicle and not of_file:
        raise CampaignError(f"--av {av}", f"a second vehicle, beside {path}", "one", "Leave one of both out.")
    data, lines = read_yaml(path) if of_file else (_default_campaign(str(path)), {})
    typed = [parse_override(text) for text in overrides]
    place = Places(str(path), lines, [*vehicle, *_nothing_sooner(typed), *typed])
    campaign = validated(data, Campaign, place)
    if campaign.accept is not None and not any(override.path[0] == "accept" for override in typed):
        for override in filter(_asks_for_precision, typed):
            found, expected = "a precision, in a campaign with a limit", "one of the two: a limit ends it at a decision"
            raise CampaignError(override.option, found, expected, "Add --set accept=null.")
    folder = Path(path).parent
    campaign = _with_real_paths(campaign, place, folder if of_file else Path.cwd(), check_files=check_files)
    if check_files:
        own = family_named(campaign.scenario, place(("scenario",)))
        for i, family in enumerate(campaign.scenarios or ()):
            family_named(family, place(("scenarios", i)))
        if (name := campaign.environment.parameters) != DEFAULT:
            where = place(("environment", "parameters"))
            for other in families().values():
                if other.shipped != own.shipped and (other.shipped / f"{name}.yaml").is_file():
                    mend = f"Write --set environment.parameters={own.default_parameters}, or leave it out."
                    raise CampaignError(where, f"'{name}', of {other.name}", f"traffic of {own.name}", mend)
            shipped_or_own(name, own.shipped, where)
        for family, file in campaign.environments.items():
            shipped_or_own(file, family_named(family).shipped, place(("environments", family)))
    env = campaign.run.ray.runtime_env
    paths = {key: _absolute(env[key], folder) for key in ("working_dir", "py_modules") if key in env}
    return campaign.replaced(("run", "ray", "runtime_env"), {**env, **paths})


def _with_real_paths(campaign: Campaign, place: Places, folder: Path, *, check_files: bool) -> Campaign:
    """The campaign with absolute paths of all its files; one typed after ``--set`` may be relative to this folder."""
    files = _FILES | {("environments", name): _FILES["environment", "parameters"] for name in campaign.environments}
    files |= {("surrogates", name, "controller"): _FILES["av", "controller"] for name in campaign.own_surrogates}
    for where, expected in files.items():
        name, end = campaign.at(where), ""
        if where[-1] in ("controller", "estimator", "challenge") and name is not None and ".py:" in name:
            name, _, end = name.rpartition(":")
        elif name is None or (where[-1] != "file" and not names_a_file(name)):
            continue
        file = _absolute(name, folder)
        if not Path(file).exists() and place(where).startswith("--set"):
            file = _absolute(name, Path.cwd())
        if check_files and not Path(file).is_file():
            here = "the current folder" if folder == Path.cwd() else "that of the campaign file"
            mend = file_meant(Path(file)) or f"Correct the path, which is relative to {here}."
            raise CampaignError(place(where), f"no file {file}", expected, mend)
        campaign = campaign.replaced(where, f"{file}:{end}" if end else file)
    return campaign


def campaign_of(campaign: Campaign | str | Path) -> Campaign:
    """The campaign itself, or that of a path or a vehicle (`load_campaign`)."""
    return campaign if isinstance(campaign, Campaign) else load_campaign(campaign)


def _absolute(value: Any, folder: Path) -> Any:
    """A path, or each of a list, that is relative to a folder; URIs, as Ray takes them, stay."""
    if isinstance(value, list):
        return [_absolute(path, folder) for path in value]
    if isinstance(value, str) and "://" not in value:
        return str(real_path(folder / os.path.expanduser(value)))  # noqa: PTH111 - Path's own fails without a home
    return value


def _asks_for_precision(override: Override) -> bool:
    return override.path in (("stop", "rhw"), ("stop", "min_crashes")) and override.value is not None


def _nothing_sooner(typed: Sequence[Override]) -> Iterator[Override]:
    """Overrides that switch off ``stop.below_reference``, where another end of the run was typed."""
    for override in typed:
        other_method = override.path == ("testing", "method") and override.value != "shells"
        if other_method or override.path == ("stop", "rhw") or _asks_for_precision(override):
            yield Override(("stop", "below_reference"), None, override.option)


# -- vehicles by name --

FEW_NAMES = 6
_OTHER_FORMS = (
    "my_av.py:MyClass, package.module:MyClass, a TraCI script my_script.py, my_av.fmu, sumo:MODEL, PANEL.yaml:NAME, or "
)
QUICK = {"rhw": 0.3, "below_reference": 0.3}
"""When a vehicle without a campaign has been tested enough."""


def names_a_campaign(path: str | Path) -> bool:
    """Whether it is the path of a campaign, not a vehicle: a YAML file, or an existing one that is not code."""
    suffix, text = Path(path).suffix, str(path)
    if suffix in (".yaml", ".yml"):
        return True
    return suffix not in (".py", ".fmu") and (Path(path).exists() or ("/" in text and ":" not in text))


def _default_campaign(vehicle: str) -> dict[str, Any]:
    place, _, name = vehicle.rpartition(":")
    is_file = vehicle.endswith((".fmu", ".py"))
    words = Path(vehicle).stem if is_file else f"{Path(place).name.removesuffix('.py')}-{name}"
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", words).strip("-._")
    records = {"traces": "crash"}  # for the player
    return {"name": name, "av": named_vehicle(vehicle), "stop": dict(QUICK), "records": records}


def named_vehicle(text: str, option: str = "") -> dict[str, Any]:
    """The ``av`` section that a word stands for; a `CampaignError` if it stands for none.

    That is a Python class or function, ``my_av.py:MyClass`` or ``package.module:MyClass``; a TraCI script,
    ``my_script.py``, or a function of it without arguments, ``my_script.py:main``; the path of an FMU; a model of
    SUMO's, ``sumo:ACC``; a vehicle of a panel, ``PANEL.yaml:NAME``; one of the shipped panel, or a built-in model.
    """
    place, colon, name = text.rpartition(":")
    if text.endswith(".fmu"):
        return {"fmu": {"file": str(real_path(text))}}
    if not colon and is_script(text):
        return {"controller": str(real_path(text))}
    if place == "sumo":
        return {"sumo": {"carFollowModel": name}}
    if colon and not place.endswith((".yaml", ".yml")):
        return {"controller": f"{real_path(place)}:{name}" if place.endswith(".py") else text}
    panel = load_panel(place or SHIPPED_PANEL).avs
    if name in panel:
        return panel[name].model_dump(exclude_unset=True)
    if name in (models := () if colon else get_args(ModelName)):
        return {"model": name}
    names = list(dict.fromkeys((*models, *sorted(panel))))
    files = [] if colon else [str(file) for file in Path().glob("*.y*ml")]
    found = f"no vehicle '{name}' in {place}" if colon else f"no {'' if option else 'campaign file, and no '}vehicle"
    if text.endswith(".py") and not Path(text).exists():
        found, files = "no such file", [str(file) for file in Path().glob("*.py")]
    expected = f"{'' if colon else _OTHER_FORMS}one of {', '.join(names[:FEW_NAMES])}, …"
    module, _, member = text.rpartition(".")
    member_of = f"Write {module}.py:{member}." if member != "py" and Path(f"{module}.py").is_file() else ""
    near = in_python_file(text) or did_you_mean(name, [*files, *names])
    mend = member_of or near or f"Name one of them: {listed(names)}."
    raise CampaignError(f"{option}{text}", found, expected, mend)


def load_panel(path: str | Path = SHIPPED_PANEL) -> Panel:
    """Read a panel, or name all that is wrong with it (`CampaignError`); paths of FMUs become absolute."""
    panel = read_model(path, Panel)
    avs = dict(panel.avs)
    for name, av in avs.items():
        if av.fmu is not None:
            avs[name] = av.replaced(("fmu", "file"), _absolute(av.fmu.file, Path(path).parent))
    return panel.replaced(("avs",), avs)


# -- campaigns and their schema, written --

_HEADER = """\
# Campaign {name}, resolved: every value is written out, defaults included.
# Lists of allowed keys and values: harness schema. Run it again: harness run THIS_FILE --out DIR
"""


def dump_campaign(campaign: Campaign) -> str:
    """YAML text of a campaign; `load_campaign` reads an equal campaign from it."""
    parts = [_HEADER.format(name=campaign.name)]
    for key, value in written_out(campaign).items():
        section = getattr(campaign, key)
        about = section.__doc__ if isinstance(section, Section) else type(campaign).model_fields[key].description
        parts.append(f"\n# {(about or key).splitlines()[0]}\n{yaml_text({key: value})}")
    return "".join(parts)


def written_out(campaign: Campaign) -> dict[str, Any]:
    """Plain data of a campaign with every default; of the sources of an AV only the one that drives it."""
    several = campaign.scenarios is not None and campaign.scenario == DEFAULT_FAMILY  # which is not asked then
    data = campaign.model_dump(exclude={"scenario"} if several else None)
    left_out = {key for key in AV_SOURCES if data["av"][key] is None}
    left_out |= {"traci_style"} if "controller" in left_out else set()
    data["av"] = {key: value for key, value in data["av"].items() if key not in left_out}
    return data


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
