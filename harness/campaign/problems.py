"""From a pydantic `ValidationError` to one error that names each problem: place and line, found, expected, how to mend.

Every section puts the errors of its own keys into words (`in_words`), for it knows what they mean.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from harness.errors import CampaignError

YamlPath = Sequence[str | int]
Place = Callable[[YamlPath], str]
"""From a path in the data to the words that say where it was written."""
Model = TypeVar("Model", bound=BaseModel)

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
SURROGATE_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"
_PATTERNS = {
    pattern: f"a name of letters, digits, {signs}, without spaces, that begins with a letter or digit"
    for pattern, signs in ((NAME_PATTERN, "_ . and -"), (SURROGATE_PATTERN, "_ and -"))
}
_NUMBERS = ("float_type", "finite_number", "int_type", "int_from_float")
_KINDS = {
    **dict(zip(_NUMBERS, ("a number", "a number", "a whole number", "a whole number"), strict=True)),
    "string_type": "text",
    "bool_type": "true or false",
    "dict_type": "names, each with its value",
    "list_type": "a list",
}
"""Kinds of values in words, by pydantic's name for the error."""
_UNITS = {"_mps2": "m/s²", "_mps": "m/s", "_per_s": "1/s", "_per_m": "1/m", "_s": "s", "_m": "m"}
_LONGEST = 60
MOST_SHOWN = 20
"""Errors of a section that are put into words; a file of another kind has thousands."""


class InvalidFileError(CampaignError):
    """A file with one or more problems, each with its own place."""

    def __init__(self, path: str, problems: Sequence[CampaignError]) -> None:
        first, *more = self.problems = tuple(problems)
        super().__init__(first.where, first.found, first.expected, first.mend)
        if more:
            super().__init__(path, f"{len(self.problems)} problems", "none", "")
            # Not shortened: each of its lines is short.
            self.mend = "Mend each:\n" + "\n".join(f"  {problem}" for problem in self.problems)
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.problems)


def broken_rule(key: str, found: str, expected: str, mend: str) -> PydanticCustomError:
    """Error of a section in the parts of a `harness.errors.HarnessError`.

    ``key`` is the dotted path of the value to blame, seen from the section; empty for the section itself.
    """
    parts = {"key": key, "found": found, "expected": expected, "mend": mend}
    where = "{key}: " if key else ""
    return PydanticCustomError("broken_rule", where + "found {found}; expected {expected}. {mend}", parts)


def validated(data: Any, model: type[Model], path: str, place: Place) -> Model:
    """Data of a file as a model; an `InvalidFileError` names every place where they do not fit."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        problems: dict[tuple[YamlPath, str], CampaignError] = {}
        for details in in_words(error, model).errors(include_url=False):
            parts = details["ctx"]
            where = (*_path_of(details["loc"], data), *filter(None, parts["key"].split(".")))
            alike = problems.get((where, parts["found"]))
            expected = parts["expected"]
            # A value of several kinds is refused once for each.
            if alike is not None and expected not in alike.expected:
                expected = f"{alike.expected} or {expected}"
            mend = parts["mend"] or _where_it_belongs(str(where[-1]), model)
            problems[where, parts["found"]] = CampaignError(place(where), parts["found"], expected, mend)
        raise InvalidFileError(path, list(problems.values())) from None


def in_words(error: ValidationError, section: type[BaseModel]) -> ValidationError:
    """The error of a section with those of its own keys in words, as of a `broken_rule`."""
    worded = []
    for details in error.errors(include_url=False)[:MOST_SHOWN]:
        parts = details["ctx"] if details["type"] == "broken_rule" else _parts(details, section)
        worded.append(InitErrorDetails(type=broken_rule(**parts), loc=details["loc"], input=details["input"]))
    return ValidationError.from_exception_data(section.__name__, worded)


def _parts(details: ErrorDetails, section: type[BaseModel]) -> dict[str, str]:
    """Found, expected and how to mend it, of an error about a key of a section."""
    kind, loc, value, context = details["type"], details["loc"], details["input"], details.get("ctx", {})
    field, last = section.model_fields.get(str(loc[0])) if loc else None, str(loc[-1]) if loc else ""
    key, found = "", describe_found(value)
    mend = _how_to_mend(value, kind, field)
    if kind == "missing":
        key, found, mend = last, "no such key", f"Add '{last}: …' to this section."
        expected = (field and field.description) or "a value"
    elif kind == "extra_forbidden":
        found, known = f"the unknown key '{last[:_LONGEST]}'", list(section.model_fields)
        expected, mend = f"one of the keys {', '.join(known)}", did_you_mean(last, known)
    elif kind == "model_type":
        expected = f"a section with keys such as {', '.join(list(section.model_fields)[:4])}"
    elif last == "[key]":
        found, expected, mend = f"the name {found}", _PATTERNS[context["pattern"]], "Choose another name."
    elif kind == "literal_error":
        words = re.findall("'(.*?)'", context["expected"])
        expected, mend = f"one of {', '.join(words)}", did_you_mean(value, words) or mend
    elif kind == "string_pattern_mismatch":
        examples = " or ".join(map(str, (field and field.examples) or ()))
        expected = f"text such as {examples}" if examples else _PATTERNS[context["pattern"]]
    else:
        unit = next((f" ({unit})" for suffix, unit in _UNITS.items() if last.endswith(suffix)), "")
        expected = _KINDS.get(kind, details["msg"].removeprefix("Input should be ")) + unit
        expected += ", or null" if field and len(loc) == 1 and type(None) in get_args(field.annotation) else ""
    return {"key": key, "found": found, "expected": expected, "mend": mend}


def _how_to_mend(value: Any, kind: str, field: FieldInfo | None) -> str:
    if value is None:
        return "Write a value after the colon, or delete the key for its default."
    if kind in _NUMBERS and isinstance(value, str) and re.fullmatch(r"[-+.\d_eE]*\d[-+.\d_eE]*", value):
        return "Remove the quotes."
    if kind == "string_type" and isinstance(value, bool | int | float):
        return "Put it in quotes if it is meant as text."
    about = field and field.description
    return f"Correct it; the key means: {about.rstrip('.')}." if about else "Correct the value."


def did_you_mean(word: object, words: Sequence[str]) -> str:
    """The closest of some words, as a question; empty if none is close."""
    return next(
        (f"Did you mean '{close}'?" for close in difflib.get_close_matches(str(word)[:_LONGEST], words, n=1)), ""
    )


def _path_of(loc: Sequence[str | int], data: Any) -> tuple[str | int, ...]:
    """Path in the document for pydantic's ``loc``, which also holds members of unions and ``[key]`` marks."""
    path: list[str | int] = []
    for part in loc:
        if part in data if isinstance(data, dict) else isinstance(data, list) and isinstance(part, int):
            path.append(part)
            data = data[part]
    return tuple(path)


def _where_it_belongs(key: str, model: type[BaseModel]) -> str:
    """How to mend an unknown key that resembles none beside it."""
    places = list(dict.fromkeys(_places_of(key, model, "")))
    if places:
        return f"'{key}' belongs under {' or '.join(place or 'the top level' for place in places)}."
    return "Delete it, or correct its name."


def _places_of(key: str, kind: Any, prefix: str) -> Iterator[str]:
    """Dotted paths of the sections of a type that know a key, names of one's own choice written as ``NAME``."""
    if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
        for option in get_args(kind):
            yield from _places_of(key, option, f"{prefix}.NAME" if get_origin(kind) is dict else prefix)
        return
    if key in kind.model_fields:
        yield prefix
    for name, field in kind.model_fields.items():
        yield from _places_of(key, field.annotation, f"{prefix}.{name}".lstrip("."))


def describe_found(value: Any) -> str:
    """Say what ``value`` is, and its kind where the looks deceive: ``the text '0.9'``, ``true (a truth value)``."""
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
    return _short(str(value))


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
