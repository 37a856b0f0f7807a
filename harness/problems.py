"""What is wrong with a section, in words: found, expected, how to mend.

Every section puts the errors of its own keys into words (`in_words`), for it knows what they mean.
`harness.campaign.files`, which reads the file, adds place and line.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
SURROGATE_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"
_PATTERNS = {
    pattern: f"a name of letters, digits, {signs}, without spaces, that begins with a letter or digit"
    for pattern, signs in ((NAME_PATTERN, "_ . and -"), (SURROGATE_PATTERN, "_ and -"))
}
_NUMBERS = ("float_type", "finite_number", "int_type", "int_from_float")
KINDS = {
    **dict(zip(_NUMBERS, ("a number", "a number", "a whole number", "a whole number"), strict=True)),
    "string_type": "text",
    "bool_type": "true or false",
    "dict_type": "names, each with its value",
    "list_type": "a list",
    "tuple_type": "a tuple",
    "sequence_str": "a list of texts",
    "too_short": "one at least",
}
"""Kinds of values in words, by pydantic's name for the error."""
_UNITS = {"_mps2": "m/s²", "_mps": "m/s", "_per_s": "1/s", "_per_m": "1/m", "_s": "s", "_m": "m"}
_LONGEST = 60
MOST_SHOWN = 20
"""Errors of a section that are put into words; a file of another kind has thousands."""


def broken_rule(key: str, found: str, expected: str, mend: str) -> PydanticCustomError:
    """An error of validation with the parts of a `HarnessError`; ``key`` is a path within the section, or empty."""
    parts = {"key": key, "found": found, "expected": expected, "mend": mend}
    where = "{key}: " if key else ""
    return PydanticCustomError("broken_rule", where + "found {found}; expected {expected}. {mend}", parts)


def in_words(error: ValidationError, section: type[BaseModel]) -> ValidationError:
    """The error of a section, each of its parts in words, as a `broken_rule` has them."""
    worded = []
    for details in error.errors(include_url=False)[:MOST_SHOWN]:
        parts = details["ctx"] if details["type"] == "broken_rule" else _parts(details, section)
        worded.append(InitErrorDetails(type=broken_rule(**parts), loc=details["loc"], input=details["input"]))
    return ValidationError.from_exception_data(section.__name__, worded)


def _parts(details: ErrorDetails, section: type[BaseModel]) -> dict[str, str]:
    """Found, expected and how to mend it, of an error about a key of a section."""
    kind, loc, value, context = details["type"], details["loc"], details["input"], details.get("ctx", {})
    field = section.model_fields.get(str(loc[0])) if loc else None
    last = str(loc[-1]) if loc else ""
    key = ""
    found = describe_found(value)
    mend = _how_to_mend(value, kind, field)
    if kind == "missing":
        key, found, mend = last, "no such key", f"Add '{last}: …' to this section."
        expected = (field and field.description) or "a value"
    elif kind == "extra_forbidden":
        keys = list(section.model_fields)
        found, expected = f"the unknown key '{last[:_LONGEST]}'", f"one of the keys {', '.join(keys)}"
        mend = did_you_mean(last, keys)
    elif kind == "model_type":
        expected = f"a section with keys such as {', '.join(list(section.model_fields)[:4])}"
        mend = f"Write {example} there." if (example := getattr(section, "example", "")) else mend
        if "value" in section.model_fields and isinstance(value, int | float):
            mend = f"Write {{value: {value}, source: user}}."
    elif last == "[key]" and kind != "literal_error":
        found, expected, mend = f"the name {found}", _pattern_in_words(context), "Choose another name."
    elif kind == "literal_error":
        words = re.findall("'(.*?)'", context["expected"])
        expected, mend = f"one of {', '.join(words)}", did_you_mean(value, words) or mend
    elif kind == "string_pattern_mismatch":
        examples = " or ".join(map(str, (field and field.examples) or ()))
        expected = f"text such as {examples}" if examples else _pattern_in_words(context)
    else:
        unit = next((f" ({unit})" for suffix, unit in _UNITS.items() if last.endswith(suffix)), "")
        expected = KINDS.get(kind, details["msg"].removeprefix("Input should be ")) + unit
        expected += ", or null" if field and len(loc) == 1 and type(None) in get_args(field.annotation) else ""
    if kind.startswith("less_than") and 0 in context.values():
        mend = f"Write {last}: -{value}."
    elif kind.startswith("less_than") and last.endswith(("confidence", "share")) and 1.0 < value <= 100.0:  # per cent
        mend = f"Write {last}: {value / 100.0:g}."
    return {"key": key, "found": found, "expected": expected, "mend": mend}


def _pattern_in_words(context: Mapping[str, Any]) -> str:
    pattern = context["pattern"]
    return _PATTERNS.get(pattern, f"text that matches {pattern}")


def _how_to_mend(value: Any, kind: str, field: FieldInfo | None) -> str:
    if value is None:
        return "Write a value after the colon, or delete the key for its default."
    if kind in _NUMBERS and isinstance(value, str) and re.fullmatch(r"[-+.\d_eE]*\d[-+.\d_eE]*", value):
        return "Remove the quotes."
    if kind in _NUMBERS and isinstance(value, str) and (percent := re.fullmatch(r"([\d.]*\d) *%", value)):
        return f"Write {float(percent[1]) / 100.0:g}."
    if kind == "string_type" and isinstance(value, bool | int | float):
        return "Put it in quotes if it is meant as text."
    about = " ".join(field.description.split()) if field and field.description else ""
    return f"Correct it; the key means: {about.rstrip('.')}." if about else "Correct the value."


def did_you_mean(word: object, words: Sequence[str]) -> str:
    """The closest of some words, as a question; empty if none is close."""
    text = str(word)[:_LONGEST]
    return f"Did you mean '{meant}'?" if (meant := nearest(text, words)) else ""


def nearest(word: str, words: Sequence[str]) -> str:
    """The closest of some words, whatever their case, - and _; empty if none is close."""
    word = re.sub("max_(braking|decel|deceleration)(?=_|$)", "min_acceleration", word)
    by_spelling = {spelling.lower().replace("-", "_"): spelling for spelling in reversed(words)}
    cutoff = 0.75 if len(word) > 4 else 0.6  # of three letters a wrong one leaves 0.67
    word = word.lower().replace("-", "_")
    without_unit = [spelling for spelling in by_spelling if spelling.startswith(f"{word}_")]  # speed of speed_mps
    close = difflib.get_close_matches(word, by_spelling, 1, cutoff) or without_unit
    return by_spelling[close[0]] if close else ""


def listed(names: Iterable[str]) -> str:
    """Names, separated by commas."""
    return ", ".join(names) or "none"


def file_meant(file: Path) -> str:
    """`did_you_mean` for a file that is not there, of those of the same suffix beside it."""
    beside = sorted(path.name for path in file.parent.glob(f"*{file.suffix}") if path.is_file())
    meant = did_you_mean(file.stem, [Path(name).stem for name in beside])
    return meant.replace("'?", f"{file.suffix}'?")


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
