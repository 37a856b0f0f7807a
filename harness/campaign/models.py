"""Files of YAML as models: read, overridden (``--set``), checked with every problem named by its place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError

from harness.campaign.drivers import default_surrogates
from harness.campaign.vehicle import AV_SOURCES, with_another_driver
from harness.campaign.yaml_text import Lines, YamlPath, dotted, parse_value, read_yaml
from harness.errors import CampaignError
from harness.problems import MOST_SHOWN, describe_found, did_you_mean, in_words

Model = TypeVar("Model", bound=BaseModel)


def read_model(path: str | Path, model: type[Model], overrides: Sequence[Override] = ()) -> Model:
    """Read a YAML file into a model, or name the path and line of every problem (`CampaignError`)."""
    data, lines = read_yaml(path)
    return validated(data, model, Places(str(path), lines, overrides))


def validated(data: dict[str, Any], model: type[Model], place: Places) -> Model:
    """Data of a file, with its overrides, as a model; a `CampaignError` names every place where they do not fit."""
    data = apply_overrides(data, place.overrides)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        problems: dict[tuple[YamlPath, str], CampaignError] = {}
        for details in in_words(error, model).errors(include_url=False):
            parts = details["ctx"]
            where = (*_path_of(details["loc"], data), *filter(None, parts["key"].split(".")))
            found, expected = parts["found"], parts["expected"]
            # A value that may be of several kinds has an error for each kind.
            if (same_value := problems.get((where, found))) is not None and expected not in same_value.expected:
                expected = f"{same_value.expected} or {expected}"
            if not (mend := parts["mend"]):  # of an unknown key that resembles none beside it
                places = dict.fromkeys(section or "the top level" for section in places_of(str(where[-1]), model))
                belongs = f"'{where[-1]}' belongs under {' or '.join(places)}."
                mend = belongs if places else "Delete it, or correct its name."
            problems[where, found] = CampaignError(place(where), found, expected, mend)
    first, *more = problems.values()
    if not more:
        raise first
    at_least = "at least " if len(problems) == MOST_SHOWN else ""
    together = CampaignError(place.path, f"{at_least}{len(problems)} problems", "none", "Fix each:")
    together.problems = (first, *more)
    raise together


def _path_of(loc: Sequence[str | int], data: Any) -> tuple[str | int, ...]:
    """Path in the document for pydantic's ``loc``, which also holds members of unions and ``[key]`` marks."""
    path: list[str | int] = []
    for part in loc:
        if part in data if isinstance(data, dict) else isinstance(data, list) and isinstance(part, int):
            path.append(part)
            data = data[part]
    return tuple(path)


def places_of(key: str, kind: Any, prefix: str = "") -> Iterator[str]:
    """Dotted paths of the sections of a type that know a key, names of one's own choice written as ``NAME``."""
    if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
        for option in get_args(kind):
            yield from places_of(key, option, f"{prefix}.NAME" if get_origin(kind) is dict else prefix)
        return
    if key in kind.model_fields:
        yield prefix
    for name, field in kind.model_fields.items():
        yield from places_of(key, field.annotation, f"{prefix}.{name}".lstrip("."))


def names_a_file(name: str) -> bool:
    """Tell a path to a file of one's own from the name of a shipped one."""
    return name.endswith((".yaml", ".yml", ".py")) or "/" in name


def shipped_or_own(name: str, folder: Path, where: str) -> Path:
    """File that a name stands for: one of those shipped in ``folder`` (or `CampaignError`), or the user's own."""
    if names_a_file(name):
        return Path(name)
    shipped = sorted(file.stem for file in folder.glob("*.yaml"))
    if name not in shipped:
        expected = f"a shipped name ({', '.join(shipped)}), or a path that ends in .yaml"
        mend = did_you_mean(name, shipped) or "For a file of your own write its path, such as ./mine.yaml."
        raise CampaignError(where, f"'{name}', which is not shipped", expected, mend)
    return folder / f"{name}.yaml"


# -- values given with the command --


@dataclass(frozen=True)
class Override:
    """One ``--set`` (or ``--av``): where, the value that replaces what is there, and the option as it was typed."""

    path: tuple[str, ...]
    value: Any
    option: str


def parse_override(text: str) -> Override:
    """Read ``testing.epsilon=0.2`` (else `CampaignError`), the value by the same rules as in a campaign file."""
    path, equals, value = text.partition("=")
    parts = tuple(part.strip() for part in path.split("."))
    option = f"--set {text}"
    if not equals or not all(parts):
        raise CampaignError(option, "no path and value", "section.key=value", "For example: --set testing.epsilon=0.2")
    return Override(parts, parse_value(value, option), option)


def apply_overrides(data: dict[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
    """A copy of ``data`` with each override, later ones over earlier ones; `CampaignError`: it is in no section."""
    changed = dict(data)
    # A whole vehicle replaces what was said of one before. Of the rest the driver comes first: parameters are its own.
    last_vehicle = max((i for i, override in enumerate(overrides) if override.path == ("av",)), default=0)
    counted = [override for i, override in enumerate(overrides) if i >= last_vehicle or override.path[0] != "av"]
    for override in sorted(counted, key=lambda override: not _names_the_driver(override)):
        if _names_the_driver(override) and len(override.path) > 1:
            changed = with_another_driver(changed, override.path[1], override.value)
        if override.path[0] == "surrogates" and len(override.path) > 1 and "surrogates" not in changed:
            # The file leaves the surrogates to their default: changing one must not drop the others.
            changed["surrogates"] = {name: driver.model_dump() for name, driver in default_surrogates().items()}
        section = changed
        for depth, part in enumerate(override.path[:-1], start=1):
            inner, where = section.get(part, {}), dotted(override.path[:depth])
            if not isinstance(inner, dict):
                mend = f"Set {where} itself, or correct the path."
                raise CampaignError(override.option, f"{describe_found(inner)} at {where}", "a section with keys", mend)
            # A copy on the way, because an anchor makes several places share one section.
            section[part] = dict(inner)
            section = section[part]
        section[override.path[-1]] = override.value
    return changed


def _names_the_driver(override: Override) -> bool:
    section, *key = override.path
    return section == "av" and (not key or (key[0] in AV_SOURCES and override.value is not None))


@dataclass(frozen=True)
class Places:
    """Where values were written: in a file (lines from 1, by path), or by an override, of which later ones win."""

    path: str
    lines: Lines
    overrides: Sequence[Override] = ()

    def line_of(self, where: YamlPath) -> int:
        """Line of the value at ``where``, or of its nearest ancestor that is in the file."""
        return next((self.lines[key] for n in range(len(where), -1, -1) if (key := tuple(where[:n])) in self.lines), 1)

    def __call__(self, where: YamlPath) -> str:
        """``--set a.b=c``; or ``a.b (smoke.yaml:12)``, with overrides of its parts; file and line for the whole."""
        for override in reversed(self.overrides):
            if tuple(where[: len(override.path)]) == override.path:
                return override.option
        spot = f"{self.path}:{self.line_of(where)}" if self.lines else self.path  # the latter of a vehicle
        place = f"{dotted(where)} ({spot})" if where else spot
        section = tuple(where) if tuple(where) in self.lines else tuple(where[:-1])  # of a key that is missing
        inside = [item.option for item in self.overrides if item.path[: len(section)] == section]
        return f"{place} with {' '.join(inside)}" if inside and section else place
