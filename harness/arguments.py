"""Arguments of the functions that a user calls from Python, held against their annotations before anything is done.

A number of numpy's is taken as the plain one that it stands for. A path may be a text.
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
        def call(*given: P.args, **named: P.kwargs) -> R:
            takes, adapters = _expected(function)
            try:
                bound = takes.bind(*given, **named)
            except TypeError as error:
                unknown = next((key for key in named if key not in takes.parameters), "")
                mend = did_you_mean(unknown, list(takes.parameters)) or "Correct the call: what has a = goes by name."
                told = (f"{of.name}{'=' * (of.kind is of.KEYWORD_ONLY)}" for of in takes.parameters.values())
                raise HarnessError(name, str(error), f"arguments {', '.join(told)}", mend) from None
            for key in bound.arguments.keys() & adapters.keys():
                bound.arguments[key] = _checked(f"{name}({key}=…)", bound.arguments[key], *adapters[key])
            return function(*bound.args, **bound.kwargs)

        return call

    return decorated


@cache
def _expected(function: Callable[..., Any]) -> tuple[Signature, dict[str, tuple[TypeAdapter[Any], bool]]]:
    """What a function takes; by argument what holds a value against its annotation, and whether that is a path."""
    of_arguments = {key: hint for key, hint in function.__annotations__.items() if key != "return"}
    hints = get_type_hints(
        SimpleNamespace(__annotations__=of_arguments), getattr(function, "__globals__", {}), include_extras=True
    )
    return signature(function), {key: (_adapter(hint), Path in (hint, *get_args(hint))) for key, hint in hints.items()}


def _adapter(hint: Any) -> TypeAdapter[Any]:
    kind = _kind(hint)
    return TypeAdapter(kind, config=None if isinstance(hint, type) and kind is not hint else _CONFIG)


def _kind(hint: Any) -> Any:
    """The annotation with classes of the harness's as such: their instances have been validated."""
    if get_origin(hint) in (Union, UnionType):
        return Union[tuple(map(_kind, get_args(hint)))]  # noqa: UP007 - made of what is known only here
    return cast(Any, InstanceOf)[hint] if isinstance(hint, type) and hint not in _PLAIN else hint


def _checked(where: str, value: Any, adapter: TypeAdapter[Any], is_path: bool) -> Any:
    plain = value.item() if getattr(value, "shape", None) == () else value
    try:
        found = adapter.validate_python(plain)
    except ValidationError as error:
        first, *others = error.errors(include_url=False)
        expected = " or ".join(dict.fromkeys(_words(each, is_path=is_path) for each in (first, *others)))
        mend = did_you_mean(first["input"], re.findall("'(.*?)'", expected)) or "Correct the argument."
        mend = f"Write [{plain!r}]." if first["type"] == "sequence_str" else mend
        raise HarnessError(where, describe_found(first["input"]), expected, mend) from None
    if is_path and isinstance(found, str | Path) and (not str(found) or not _is_text(str(found))):
        raise HarnessError(where, f"'{found}'", "the name of a file or folder, in UTF-8", "Correct the argument.")
    return found


def _is_text(name: str) -> bool:
    return "\0" not in name and name.encode(errors="replace").decode() == name


def _words(problem: ErrorDetails, *, is_path: bool) -> str:
    kind = problem.get("ctx", {}).get("class", "")
    if is_path and (problem["type"] == "string_type" or kind == "Path"):
        return "a path"
    if kind == "Campaign":
        return "a campaign (harness.load_campaign)"
    return KINDS.get(problem["type"], problem["msg"].removeprefix("Input should be "))
