"""Error messages for unknown keys and wrong values of a file: each place and line, found, expected, how to mend it.

From a pydantic `ValidationError` to one error that lists every problem; lines are `harness.campaign.yaml_text.Lines`'s.

A problem is a `CampaignError`: where, what was found (`describe_found`), what the JSON schema expects there
(`describe_expected`), and how to mend it.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from harness.campaign.schema import Schema, SchemaView, schema_of
from harness.campaign.sections import NAME_PATTERN, SURROGATE_PATTERN
from harness.campaign.yaml_text import YamlPath, dotted, read_yaml
from harness.errors import CampaignError

Place = Callable[[YamlPath], str]
"""From a path in the data to the words that say where it was written."""
Model = TypeVar("Model", bound=BaseModel)

_UNITS = {"_mps2": "m/s²", "_mps": "m/s", "_per_s": "1/s", "_per_m": "1/m", "_s": "s", "_m": "m"}
_LONGEST = 60
_PATTERNS = {
    NAME_PATTERN: "a name of letters, digits, _ . and -, without spaces, that begins with a letter or digit",
    SURROGATE_PATTERN: "a name of letters, digits, _ and -, without spaces, that begins with a letter or digit",
}


class InvalidFileError(CampaignError):
    """A file with one or more problems, each with its own place."""

    def __init__(self, path: str, problems: Sequence[CampaignError]) -> None:
        first, *more = self.problems = tuple(problems)
        if more:
            super().__init__(path, found=f"{len(self.problems)} problems", expected="none", mend="")
            # Not shortened: each of its lines is short.
            self.mend = "Mend each:\n" + "\n".join(f"  {problem}" for problem in self.problems)
        else:
            super().__init__(first.where, found=first.found, expected=first.expected, mend=first.mend)
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.problems)


def read_model(path: str | Path, model: type[Model]) -> Model:
    """Read a YAML file into a pydantic model, such as an environment's parameters.

    Raises
    ------
    CampaignError
        As `read_yaml`; or the content does not fit ``model``, with every problem's path and line.
    """
    data, lines = read_yaml(path)
    return validated(data, model, str(path), lines.place)


def validated(data: Any, model: type[Model], path: str, place: Place) -> Model:
    """Data of a file as a model; an `InvalidFileError` names every place where they do not fit."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        view = SchemaView(schema_of(model))
        words = [_words(details, view, data) for details in error.errors(include_url=False)]
        # A value of several kinds is refused once for each.
        problems = [
            CampaignError(place(where), found=found, expected=expected, mend=mend)
            for where, found, expected, mend in dict.fromkeys(words)
        ]
        raise InvalidFileError(path, problems) from None


_Words = tuple[YamlPath, str, str, str]
"""Place, found, expected, mend."""


def _words(details: ErrorDetails, view: SchemaView, data: Any) -> _Words:
    path, kind = _path_of(details, data), details["type"]
    if kind == "broken_rule":
        parts = details["ctx"]
        return (*path, *filter(None, parts["key"].split("."))), parts["found"], parts["expected"], parts["mend"]
    if kind == "extra_forbidden":
        return _unknown_key(path, view, data)
    if kind == "missing":
        expected = describe_expected(view.at(path, data), str(path[-1]))
        return path, "no such key", expected, f"Add '{path[-1]}: …' to this section."
    if kind in ("union_tag_not_found", "union_tag_invalid"):
        return _wrong_tag(details, path)
    if details["loc"][-1:] == ("[key]",):
        expected = "a name of letters, digits, _ and -, beginning with a letter or digit"
        return path, f"the name {str(details['input'])[:60]!r}", expected, "Choose another name."
    schema = view.at(path, data)
    expected = (
        describe_expected(schema, dotted(path[-1:])) if schema else details["msg"].removeprefix("Input should be ")
    )
    return path, describe_found(details["input"]), expected, _how_to_mend(details["input"], schema)


def _path_of(details: ErrorDetails, data: Any) -> tuple[str | int, ...]:
    """Path in the document for pydantic's ``loc``, which also holds tags of unions and ``[key]`` marks."""
    path: list[str | int] = []
    for part in details["loc"]:
        is_step = part in data if isinstance(data, dict) else isinstance(data, list) and isinstance(part, int)
        if is_step:
            path.append(part)
            data = data[part]
    return (*path, details["loc"][-1]) if details["type"] == "missing" else tuple(path)


def _wrong_tag(details: ErrorDetails, path: YamlPath) -> _Words:
    key = details["ctx"]["discriminator"].strip("'")
    expected = f"one of {details['ctx']['expected_tags']}" if "expected_tags" in details["ctx"] else f"a key '{key}'"
    if details["type"] == "union_tag_not_found":
        return path, f"no key '{key}'", expected, f"Add '{key}: …'; it decides which other keys follow."
    return (*path, key), describe_found(details["input"][key]), expected, "Choose one of them."


def _unknown_key(path: YamlPath, view: SchemaView, data: Any) -> _Words:
    key = str(path[-1])
    known = list(view.at(path[:-1], data).get("properties", {}))
    expected = f"one of the keys {', '.join(known)}" if known else "no key of this name"
    elsewhere = list(dict.fromkeys(view.paths_of_key(key)))
    if close := difflib.get_close_matches(key, known, n=1):
        mend = f"Did you mean '{close[0]}'?"
    elif elsewhere:
        mend = f"'{key}' belongs under {' or '.join(name.rpartition('.')[0] or 'the top level' for name in elsewhere)}."
    else:
        mend = "Delete it, or correct its name."
    return path, f"the unknown key '{key}'", expected, mend


def _how_to_mend(value: Any, schema: Schema) -> str:
    if value is None:
        return "Write a value after the colon, or delete the key for its default."
    wants_number = schema.get("type") in ("number", "integer")
    if wants_number and isinstance(value, str) and _reads_as_number(value):
        return "Remove the quotes."
    if schema.get("type") == "string" and isinstance(value, bool | int | float):
        return "Put it in quotes if it is meant as text."
    if isinstance(value, str) and (close := difflib.get_close_matches(value, schema.get("enum", ()), n=1)):
        return f"Did you mean '{close[0]}'?"
    about = schema.get("description", "").rstrip(".")
    return f"Correct it; the key means: {about}." if about else "Correct the value."


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def describe_found(value: Any) -> str:
    """Say what ``value`` is, and its kind where the looks deceive: ``the text '0.9'``, ``true (not a number)``."""
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return f"{'true' if value else 'false'} (a truth value)"
    if isinstance(value, str):
        return f"the text {_short(repr(value))}"
    if isinstance(value, dict):
        return f"keys and values ({_short(', '.join(map(str, value)) or 'none')})"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return _short(_digits(value))


def describe_expected(schema: dict[str, Any], key: str) -> str:
    """Say what ``schema`` allows, with limits and the unit that the name of ``key`` carries."""
    words = _describe_kind(schema, key)
    return f"{words}, or null" if schema.get("nullable") else words


def _describe_kind(schema: dict[str, Any], key: str) -> str:
    kind = schema.get("type")
    if "const" in schema or "enum" in schema:
        return "one of " + ", ".join(map(str, schema["enum"])) if "enum" in schema else f"the word '{schema['const']}'"
    if kind in ("number", "integer"):
        return _describe_number(schema, key, "a whole number" if kind == "integer" else "a number")
    if kind == "string":
        examples = " or ".join(map(str, schema.get("examples", ())))
        return f"text such as {examples}" if examples else _PATTERNS.get(schema.get("pattern", ""), "text")
    if "properties" in schema:
        return "a section with keys such as " + ", ".join(list(schema["properties"])[:4])
    if "anyOf" in schema:
        return " or ".join(_describe_kind(option, key) for option in schema["anyOf"])
    containers = {"array": "a list", "object": "names, each with its value"}
    return containers.get(str(kind), "a section" if "oneOf" in schema else "another kind of value")


def _describe_number(schema: dict[str, Any], key: str, noun: str) -> str:
    words = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}
    limits = [f"{text} {_limit(schema[bound])}" for bound, text in words.items() if bound in schema]
    if limits and limits[0].startswith("at "):
        noun += " of"
    unit = next((name for suffix, name in _UNITS.items() if key.endswith(suffix)), "")
    return " ".join(filter(None, (noun, " and ".join(limits), f"({unit})" if unit else "")))


def _limit(bound: float) -> str:
    return str(bound) if isinstance(bound, int) and abs(bound) < 10**7 else f"{bound:.12g}"


def _digits(value: Any) -> str:
    try:
        return str(value)
    except ValueError:  # Python refuses to print whole numbers of more than 4300 digits
        return "an enormous whole number"


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
