"""Arguments of the functions that a user calls from Python, checked against their annotations before anything is done.

A numpy number counts as the plain number of its value. A path may be given as text.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache, wraps
from inspect import Signature, signature
from pathlib import Path
from types import NoneType, SimpleNamespace, UnionType
from typing import Annotated, Any, ParamSpec, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, Field, InstanceOf, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from harness.errors import HarnessError
from harness.problems import KINDS, describe_found, did_you_mean
from harness.vocabulary import MOST_ASKED

P = ParamSpec("P")
R = TypeVar("R")

AtLeastOne = Annotated[int, Field(ge=1, le=MOST_ASKED)]
AtLeastTwo = Annotated[int, Field(ge=2, le=MOST_ASKED)]
Episode = Annotated[int, Field(ge=0)]

_PLAIN = (int, float, bool, str, NoneType)
_CONFIG = ConfigDict(strict=True, arbitrary_types_allowed=True)


def checked(name: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let the function of that ``name`` refuse (`HarnessError`) what its annotations do not allow."""

    def decorated(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            takes, adapters = _expected(function)
            try:
                bound = takes.bind(*args, **kwargs)
            except TypeError as error:
                unknown = next((key for key in kwargs if key not in takes.parameters), "")
                mend = did_you_mean(unknown, list(takes.parameters)) or "Correct the call: what has a = goes by name."
                names = (f"{p.name}{'=' * (p.kind is p.KEYWORD_ONLY)}" for p in takes.parameters.values())
                raise HarnessError(name, str(error), f"arguments {', '.join(names)}", mend) from None
            for key in bound.arguments.keys() & adapters.keys():
                bound.arguments[key] = _checked(f"{name}({key}=…)", bound.arguments[key], *adapters[key])
            return function(*bound.args, **bound.kwargs)

        return call

    return decorated


@cache
def _expected(function: Callable[..., Any]) -> tuple[Signature, dict[str, tuple[TypeAdapter[Any], bool]]]:
    """Signature of a function; by argument the validator of its annotation, and whether the argument is a path."""
    annotations = {key: hint for key, hint in function.__annotations__.items() if key != "return"}
    arguments = SimpleNamespace(__annotations__=annotations)
    hints = get_type_hints(arguments, getattr(function, "__globals__", {}), include_extras=True)
    return signature(function), {key: (_adapter(hint), Path in (hint, *get_args(hint))) for key, hint in hints.items()}


def _adapter(hint: Any) -> TypeAdapter[Any]:
    kind = _kind(hint)
    return TypeAdapter(kind, config=None if isinstance(hint, type) and kind is not hint else _CONFIG)


def _kind(hint: Any) -> Any:
    """The annotation, in which classes stand for instances of theirs: these have been validated when they were made."""
    if get_origin(hint) in (Union, UnionType):
        return Union[tuple(map(_kind, get_args(hint)))]  # noqa: UP007 - made of what is known only here
    return cast(Any, InstanceOf)[hint] if isinstance(hint, type) and hint not in _PLAIN else hint


def _checked(where: str, value: Any, adapter: TypeAdapter[Any], is_path: bool) -> Any:
    plain = value.item() if getattr(value, "shape", None) == () else value
    try:
        validated = adapter.validate_python(plain)
    except ValidationError as error:
        first, *rest = error.errors(include_url=False)
        expected = " or ".join(dict.fromkeys(_words(problem, is_path=is_path) for problem in (first, *rest)))
        mend = did_you_mean(first["input"], re.findall("'(.*?)'", expected)) or "Correct the argument."
        mend = f"Write [{plain!r}]." if first["type"] == "sequence_str" else mend
        raise HarnessError(where, describe_found(first["input"]), expected, mend) from None
    if is_path and isinstance(validated, str | Path):
        name = str(validated)
        if not name or "\0" in name or name.encode(errors="replace").decode() != name:
            raise HarnessError(where, f"'{name}'", "the name of a file or folder, in UTF-8", "Correct the argument.")
    return validated


def _words(problem: ErrorDetails, *, is_path: bool) -> str:
    kind = problem.get("ctx", {}).get("class", "")
    if is_path and (problem["type"] == "string_type" or kind == "Path"):
        return "a path"
    if kind == "Campaign":
        return "a campaign (harness.load_campaign)"
    return KINDS.get(problem["type"], problem["msg"].removeprefix("Input should be "))
