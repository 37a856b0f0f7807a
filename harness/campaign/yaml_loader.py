"""PyYAML's safe loader with YAML 1.2's core schema: no tag, key or number is guessed at, and nothing multiplies."""

from __future__ import annotations

import re
from typing import Any, NoReturn

from yaml import SafeLoader
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError
from yaml.error import Mark
from yaml.events import AliasEvent
from yaml.nodes import MappingNode, Node, ScalarNode

_TAG = "tag:yaml.org,2002:"
_TEXT, _MERGE = _TAG + "str", _TAG + "merge"
_NULLS = ("", "~", "null", "Null", "NULL")
_TRUTH = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_BASES = {"0o": 8, "0x": 16}

MOST_VALUES = 100_000
"""Values of a document with every alias written out; the largest file that comes with the harness has 300."""
DEEPEST = 50
"""Levels of nesting, aliases written out; a campaign needs five."""


class StrictLoader(SafeLoader):
    """Loads one document; whatever it refuses is a `yaml.error.MarkedYAMLError`, which knows line and column."""

    yaml_implicit_resolvers = {}

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.trail: list[Any] = []
        """Path of the value that is being composed: a key or an index on each level, None of the root and of a key."""
        self._sizes: dict[Node, tuple[int, int]] = {}

    def compose_document(self) -> Node | None:
        """Compose a document that claims no other version of YAML."""
        root = super().compose_document()
        if root is not None and self.yaml_version not in (None, (1, 2)):
            _refuse(root.start_mark, "a %YAML directive for another version", "Delete the line that begins with %YAML.")
        return root

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """Compose a value, and bound what it amounts to: with aliases, a few lines can stand for billions of values."""
        event = self.peek_event()  # type: ignore[no-untyped-call]
        self.trail.append(index.value if isinstance(index, ScalarNode) else index)
        if len(self.trail) > DEEPEST:
            _refuse_depth(event.start_mark)
        node = super().compose_node(parent, index)
        if node is not None and not isinstance(event, AliasEvent):
            self._sizes[node] = self._checked_size(node)
        elif node not in self._sizes:
            _refuse(event.start_mark, "an anchor that contains itself", "Write the value out.")
        self.trail.pop()
        return node

    def _checked_size(self, node: Node) -> tuple[int, int]:
        """Values and levels of a composed value, aliases written out."""
        if isinstance(node, ScalarNode):
            _join_surrogates(node)
            return 1, 1
        inner = node.value
        if isinstance(node, MappingNode):
            self._require_texts_as_keys(node)
            inner = [part for pair in node.value for part in pair]
        sizes = [self._sizes[child] for child in inner]
        values, levels = 1 + sum(n for n, _ in sizes), 1 + max((depth for _, depth in sizes), default=0)
        if values > MOST_VALUES:
            found = f"{values:,} values, aliases (*) written out, where {MOST_VALUES:,} are the most"
            _refuse(node.start_mark, found, "Delete aliases.")
        if levels > DEEPEST:
            _refuse_depth(node.start_mark)
        return values, levels

    def _require_texts_as_keys(self, node: MappingNode) -> None:
        """Refuse keys that are no text, and one that is there already."""
        lines: dict[str, int] = {}
        for key, _ in node.value:
            if not isinstance(key, ScalarNode) or key.tag not in (_TEXT, _MERGE):
                shown = key.value[:40] if isinstance(key, ScalarNode) else "made of a list or mapping"
                _refuse(key.start_mark, f"a key {shown}, which is not text", "Quote the key if it is meant as text.")
            if key.value in lines:
                self.trail.append(key.value)
                found = f"the key {key.value!r} again, first written on line {lines[key.value]}"
                _refuse(key.start_mark, found, "Delete one of the two.")
            lines[key.value] = key.start_mark.line + 1

    def construct_core(self, node: ScalarNode) -> float | bool | None:
        """Value of a scalar that is no text, also where a tag claims it: ``!!int x`` is none."""
        kind, text = node.tag.removeprefix(_TAG), str(self.construct_scalar(node))
        digits = text.replace("_", "").lower()
        try:
            if kind == "int":
                return int(digits, _BASES.get(digits[:2], 10))
            if kind == "float":
                return float(digits.replace(".inf", "inf").replace(".nan", "nan"))
            return _TRUTH[text] if kind == "bool" else dict.fromkeys(_NULLS)[text]
        except (ValueError, KeyError):
            problem = f"{text[:40]!r} is no {kind}"
            raise ConstructorError(None, None, problem, node.start_mark, "Quote it if it is text.") from None


def _join_surrogates(node: ScalarNode) -> None:
    """Make one character of each surrogate pair, by which JSON escapes write some."""
    try:
        node.value = node.value.encode("utf-16", "surrogatepass").decode("utf-16")
    except UnicodeDecodeError:
        _refuse(node.start_mark, "half of a surrogate pair", "Write the character itself.")


def _refuse_depth(mark: Mark) -> NoReturn:
    _refuse(mark, f"values nested too deeply, in more than {DEEPEST} levels", "Close the brackets that were left open.")


def _refuse(mark: Mark, found: str, mend: str) -> NoReturn:
    raise ComposerError(None, None, found, mark, mend)


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
StrictLoader.yaml_constructors = {
    **{_TAG + kind: StrictLoader.construct_core for kind in ("null", "bool", "int", "float")},
    _TEXT: StrictLoader.construct_yaml_str,
    _TAG + "seq": StrictLoader.construct_yaml_seq,
    _TAG + "map": StrictLoader.construct_yaml_map,
    None: StrictLoader.construct_undefined,
}
