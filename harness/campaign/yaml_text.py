"""YAML 1.2 read strictly, every value being what it looks like and knowing its line, and written so that it stays it.

``1e-5`` is a number, ``12:30`` and ``no`` are texts, a date stays text. A key written twice, a second document, a tag,
a syntax error or an empty file is a `CampaignError` that names file, line and column.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from yaml import SafeLoader
from yaml.composer import ComposerError
from yaml.error import MarkedYAMLError
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from yaml.reader import ReaderError

from harness.errors import CampaignError
from harness.problems import did_you_mean

YamlPath = Sequence[str | int]
Lines = dict[tuple[str | int, ...], int]
"""Line of each value, from 1, by its path."""
LARGEST_FILE = 100_000
"""Bytes of a YAML file that is read, in about a second: eight times the largest that comes with the harness."""
MOST_VALUES = 100_000
"""Values of a document with every alias written out."""
DEEPEST = 50
"""Levels of nesting, aliases written out; a campaign needs five."""

_TAG = "tag:yaml.org,2002:"
_TEXT = _TAG + "str"
_BASES = {"0o": 8, "0x": 16}


def dotted(where: YamlPath) -> str:
    """``testing.alpha``, the way a path is written in messages and after ``--set``."""
    return ".".join(map(str, where))


def read_yaml(path: str | Path) -> tuple[dict[str, Any], Lines]:
    """Data and lines of a UTF-8 file with one YAML 1.2 mapping, without double keys; else a `CampaignError`."""
    name = str(path)
    data, lines = deepcopy(_parsed(read_text(Path(path)), name))
    if not lines:
        raise CampaignError(name, "an empty file", "YAML keys and values", "Is it the right file, fully written?")
    if not isinstance(data, dict):
        found = f"a {'list' if isinstance(data, list) else 'single value'} at the top level"
        mend = "Write 'key: value' lines, without a dash before the first one."
        raise CampaignError(f"{name}:{lines[()]}", found, "keys and values", mend)
    return data, lines


def parse_value(text: str, where: str) -> Any:
    """Read one value by the rules of `read_yaml`, as after the ``=`` of ``--set a.b=value``; errors name ``where``."""
    try:
        data, lines = deepcopy(_parsed(text, where))
    except CampaignError as error:
        raise CampaignError(where, error.found, error.expected, error.mend) from None
    if not lines:
        mend = "Write null if you mean none, '\"\"' for no text."
        raise CampaignError(where, "no value after '='", "a value", mend)
    return data


def read_text(path: Path) -> str:
    """Text of a UTF-8 file of no more than `LARGEST_FILE` bytes; else a `CampaignError`."""
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)  # not all of what may be a device without an end
        if len(content) <= LARGEST_FILE:
            return content.decode("utf-8-sig")
        found, mend = f"more than {LARGEST_FILE:,} bytes", "Is it the right file?"
    except FileNotFoundError:
        meant = did_you_mean(path.name, [file.name for file in path.parent.glob("*.y*ml")])
        if (cloned := Path(__file__).parents[2] / path).is_file():  # as docs name those beside this package
            meant = f"Name {cloned}."
        found, mend = "no such file", meant or "Check the spelling and the folder that you are in."
    except IsADirectoryError:
        of_run = path / "campaign.yaml"
        found, mend = "a folder", f"Name {of_run}." if of_run.is_file() else "Name the file inside it."
    except UnicodeDecodeError as error:
        found, mend = f"bytes that are not UTF-8 (at byte {error.start})", "Save the file as UTF-8 text."
    except (OSError, ValueError) as error:
        found, mend = f"a file that cannot be read ({error})", "Check its name and permissions."
    raise CampaignError(str(path), found, f"a {'Python' if path.suffix == '.py' else 'YAML'} file in UTF-8", mend)


@lru_cache(maxsize=64)  # scenarios and comparisons read the same traffic again and again
def _parsed(text: str, name: str) -> tuple[Any, Lines]:
    """Value of a text, and the line of each of its parts by path; there are none when it is empty."""
    where, mend = name, "Correct or delete it."
    try:
        loader = StrictLoader(text)
        root = loader.get_single_node()
        lines = {} if root is None else _checked_lines(root)
        return (loader.construct_document(root) if lines else None), lines
    except MarkedYAMLError as error:
        # In the parser's words: what it was at, and since which line, then the problem.
        mark, since = error.problem_mark or error.context_mark, error.context_mark
        context = f"{error.context} (line {since.line + 1})" if since else None
        found = ": ".join(filter(None, [context, error.problem])).removeprefix("found ")
        where = name if mark is None else f"{name}:{mark.line + 1}:{mark.column + 1}"
        if error.context and not since:  # the path of a key, of `_checked_lines`
            where = f"{error.context} ({where})"
        mend = str(error.note or "Check indentation, quotes and brackets just before it.")
        mend = "Use spaces, not tabs." if "'\\t'" in found else mend
    except ReaderError as error:
        before = text[: error.position].split("\n")
        where, found = f"{name}:{len(before)}:{len(before[-1]) + 1}", f"the character U+{error.character:04X}"
    except RecursionError:
        found, mend = "values nested too deeply", "Close the brackets that were left open."
    except (ValueError, OverflowError) as error:  # a number or an escape that is out of all bounds
        found = str(error).splitlines()[0]
    raise CampaignError(where, found, "plain YAML 1.2", mend)


class StrictLoader(SafeLoader):
    """PyYAML's safe loader of one document with YAML 1.2's core schema, and no tags."""

    yaml_implicit_resolvers = {}

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """Compose a value that claims no tag."""
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if getattr(event, "tag", None) is not None:
            raise ComposerError(None, None, f"a tag, {event.tag}", event.start_mark, "Delete it; quote what is text.")
        return super().compose_node(parent, index)

    def construct_whole_number(self, node: ScalarNode) -> int:
        """Value of ``010``, which is ten, ``0o17``, ``0x1F`` or ``1_000``."""
        digits = node.value.replace("_", "").lower()
        return int(digits, _BASES.get(digits[:2], 10))


def _checked_lines(root: Node) -> Lines:
    """Line of every value by its path, aliases written out.

    Refused are too many values or levels, which a few aliases can stand for, and keys that are double or no text.
    """
    lines: Lines = {(): root.start_mark.line + 1}
    waiting: list[tuple[tuple[str | int, ...], Node]] = [((), root)]
    while waiting:
        path, node = waiting.pop()
        inner = node.value if isinstance(node, MappingNode) else []
        if isinstance(node, SequenceNode):
            inner = [(ScalarNode(_TEXT, i, item.start_mark), item) for i, item in enumerate(node.value)]
        if len(lines) + len(inner) > MOST_VALUES or len(path) > DEEPEST:
            most = f"more than {MOST_VALUES:,} values, or {DEEPEST} levels of nesting, aliases (*) written out"
            raise ComposerError(None, None, most, node.start_mark, "Delete aliases.")
        for key, value in inner:
            if not isinstance(key, ScalarNode) or key.tag not in (_TEXT, _TAG + "merge"):
                shown = key.value[:40] if isinstance(key, ScalarNode) else "made of a list or mapping"
                found, quote = f"a key {shown}, which is not text", "Quote the key if it is meant as text."
                raise ComposerError(None, None, found, key.start_mark, f"{quote} Decimals take a point.")
            place = (*path, key.value)
            if place in lines:
                found = f"the key {key.value!r} again, first written on line {lines[place]}"
                raise ComposerError(dotted(place), None, found, key.start_mark, "Delete one of the two.")
            lines[place] = key.start_mark.line + 1
            waiting.append((place, value))
    return lines


# YAML 1.2, chapter 10.3.2; and, as in Python, underscores between digits.
for _kind, _pattern, _beginnings in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9][0-9_]*|0o[0-7_]+|0x[0-9a-fA-F_]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9][0-9_]*|[0-9][0-9_]*(\.[0-9_]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", list("-+.")),
    ("merge", r"<<", ["<"]),
):
    StrictLoader.add_implicit_resolver(_TAG + _kind, re.compile(rf"^(?:{_pattern})$"), _beginnings)
StrictLoader.add_constructor(_TAG + "int", StrictLoader.construct_whole_number)


# -- written --


class _Dumper(yaml.SafeDumper):
    """Quotes every text that is not a plain word: other YAML readers see numbers, dates and truth values in many."""

    def ignore_aliases(self, _data: Any) -> bool:
        return True

    def represent_text(self, text: str) -> yaml.ScalarNode:
        plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", text) and text.lower() not in _MISREAD
        node: yaml.ScalarNode = self.represent_scalar("tag:yaml.org,2002:str", text, style=None if plain else '"')
        return node


_Dumper.add_representer(str, _Dumper.represent_text)
_MISREAD = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}


def yaml_text(data: dict[str, Any]) -> str:
    """YAML of plain data, which `read_yaml` reads back as it is."""
    # Escapes keep every character, control characters included, through any editor; math.inf never folds a line.
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=False, width=math.inf)
    return text
