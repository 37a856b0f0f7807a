"""Plain words for what was found in a file and for what a JSON schema expects there."""

from __future__ import annotations

from typing import Any

from harness.campaign.section import NAME_PATTERN, SURROGATE_PATTERN

_UNITS = {"_mps2": "m/s²", "_mps": "m/s", "_per_s": "1/s", "_per_m": "1/m", "_s": "s", "_m": "m"}
_LONGEST = 60
_PATTERNS = {
    NAME_PATTERN: "a name of letters, digits, _ . and -, without spaces, that begins with a letter or digit",
    SURROGATE_PATTERN: "a name of letters, digits, _ and -, without spaces, that begins with a letter or digit",
}


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
        return _describe_words(schema)
    if kind in ("number", "integer"):
        return _describe_number(schema, key, "a whole number" if kind == "integer" else "a number")
    if kind == "string":
        return _describe_text(schema)
    if "properties" in schema:
        return "a section with keys such as " + ", ".join(list(schema["properties"])[:4])
    if "anyOf" in schema:
        return " or ".join(_describe_kind(option, key) for option in schema["anyOf"])
    containers = {"array": "a list", "object": "names, each with its value"}
    return containers.get(str(kind), "a section" if "oneOf" in schema else "another kind of value")


def _describe_words(schema: dict[str, Any]) -> str:
    if "const" in schema:
        return f"the word '{schema['const']}'"
    return "one of " + ", ".join(map(str, schema["enum"]))


def _describe_text(schema: dict[str, Any]) -> str:
    if "examples" in schema:
        return "text such as " + " or ".join(map(str, schema["examples"]))
    return _PATTERNS.get(schema.get("pattern", ""), "text")


def _describe_number(schema: dict[str, Any], key: str, noun: str) -> str:
    words = {
        "minimum": "at least",
        "exclusiveMinimum": "above",
        "maximum": "at most",
        "exclusiveMaximum": "below",
    }
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
