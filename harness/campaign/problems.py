"""From a pydantic `ValidationError` to one error that lists every problem of a file in plain words."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from harness.campaign.expectations import describe_expected, describe_found
from harness.campaign.schema import Schema, SchemaView
from harness.campaign.yaml_lines import YamlPath, dotted
from harness.errors import CampaignError, shortened

Place = Callable[[YamlPath], str]


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong in a file: where, what was found and expected, and how to mend it."""

    where: str
    found: str
    expected: str
    mend: str

    def __post_init__(self) -> None:
        for part in ("where", "found", "expected", "mend"):
            object.__setattr__(self, part, shortened(getattr(self, part)))

    def __str__(self) -> str:
        return f"{self.where}: found {self.found}; expected {self.expected}. {self.mend}"


class InvalidFileError(CampaignError):
    """A file with one or more problems, each with its own place.

    Parameters
    ----------
    path : str
        The file.
    problems : iterable of Problem
        At least one.
    """

    def __init__(self, path: str, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        if len(self.problems) == 1:
            only = self.problems[0]
            super().__init__(only.where, found=only.found, expected=only.expected, mend=only.mend)
        else:
            mend = "Mend each:\n" + "\n".join(f"  {problem}" for problem in self.problems)
            super().__init__(path, found=f"{len(self.problems)} problems", expected="none", mend="")
            self.mend = mend  # each of its lines is short
        self.path = path

    def __reduce__(self) -> tuple[type[InvalidFileError], tuple[str, tuple[Problem, ...]]]:
        return type(self), (self.path, self.problems)


def invalid_file(error: ValidationError, *, path: str, data: Any, schema: Schema, place: Place) -> InvalidFileError:
    """Translate what pydantic found wrong with ``data``.

    Parameters
    ----------
    error : ValidationError
        Raised by ``model_validate(data)``.
    path : str
        The file, for messages.
    data : object
        Plain data as `harness.campaign.yaml_text.read_yaml` gives it.
    schema : dict
        JSON schema of the model.
    place : callable
        From a path in ``data`` to the words that say where it was written (`Lines.place`).
    """
    view = SchemaView(schema)
    problems = [_problem(details, view, data, place) for details in error.errors(include_url=False)]
    return InvalidFileError(path, dict.fromkeys(problems))  # a value of several kinds is refused once for each


def _problem(details: ErrorDetails, view: SchemaView, data: Any, place: Place) -> Problem:
    path = view.path_of(details["loc"], data)
    kind = details["type"]
    if kind == "broken_rule":
        return _broken_rule(details["ctx"], path, place)
    if kind == "extra_forbidden":
        return _unknown_key(path, view, data, place)
    if kind == "missing":
        expected = describe_expected(view.at(path, data), str(path[-1]))
        return Problem(place(path), "no such key", expected, f"Add '{path[-1]}: …' to this section.")
    if kind in ("union_tag_not_found", "union_tag_invalid"):
        return _wrong_tag(details, path, place)
    if details["loc"][-1:] == ("[key]",):
        expected = "a name of letters, digits, _ and -, beginning with a letter or digit"
        return Problem(place(path), f"the name {str(details['input'])[:60]!r}", expected, "Choose another name.")
    return _wrong_value(details, path, view, data, place)


def _broken_rule(parts: dict[str, Any], path: YamlPath, place: Place) -> Problem:
    blamed = (*path, *filter(None, parts["key"].split(".")))
    return Problem(place(blamed), parts["found"], parts["expected"], parts["mend"])


def _wrong_tag(details: ErrorDetails, path: YamlPath, place: Place) -> Problem:
    key = details["ctx"]["discriminator"].strip("'")
    expected = f"one of {details['ctx']['expected_tags']}" if "expected_tags" in details["ctx"] else f"a key '{key}'"
    if details["type"] == "union_tag_not_found":
        return Problem(place(path), f"no key '{key}'", expected, f"Add '{key}: …'; it decides which other keys follow.")
    return Problem(place((*path, key)), describe_found(details["input"][key]), expected, "Choose one of them.")


def _unknown_key(path: YamlPath, view: SchemaView, data: Any, place: Place) -> Problem:
    key = str(path[-1])
    known = list(view.at(path[:-1], data).get("properties", {}))
    expected = f"one of the keys {', '.join(known)}" if known else "no key of this name"
    close = difflib.get_close_matches(key, known, n=1)
    elsewhere = list(dict.fromkeys(view.paths_of_key(key)))
    if close:
        mend = f"Did you mean '{close[0]}'?"
    elif elsewhere:
        mend = f"'{key}' belongs under {' or '.join(name.rpartition('.')[0] or 'the top level' for name in elsewhere)}."
    else:
        mend = "Delete it, or correct its name."
    return Problem(place(path), f"the unknown key '{key}'", expected, mend)


def _wrong_value(details: ErrorDetails, path: YamlPath, view: SchemaView, data: Any, place: Place) -> Problem:
    value = details["input"]
    schema = view.at(path, data)
    expected = (
        describe_expected(schema, dotted(path[-1:])) if schema else details["msg"].removeprefix("Input should be ")
    )
    return Problem(place(path), describe_found(value), expected, _how_to_mend(value, schema))


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
