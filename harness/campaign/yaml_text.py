"""Strict YAML 1.2: every value is what it looks like, and every value knows its line.

``1e-5`` is a number, ``12:30`` and ``no`` are strings, a date stays text. A key written twice, a second document, an
unknown tag, a syntax error or an empty file is a `CampaignError` that names file, line and column.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from yaml import SafeLoader
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError
from yaml.error import Mark, MarkedYAMLError
from yaml.events import AliasEvent
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from yaml.reader import ReaderError

from harness.errors import CampaignError

LARGEST_FILE = 1_000_000
"""Bytes of a YAML file that is read: a hundred times the largest that comes with the harness."""

_TAG = "tag:yaml.org,2002:"
_TEXT, _MERGE = _TAG + "str", _TAG + "merge"
_NULLS = ("", "~", "null", "Null", "NULL")
_TRUTH = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_BASES = {"0o": 8, "0x": 16}

MOST_VALUES = 100_000
"""Values of a document with every alias written out; the largest file that comes with the harness has 300."""
DEEPEST = 50
"""Levels of nesting, aliases written out; a campaign needs five."""

YamlPath = Sequence[str | int]


def dotted(where: YamlPath) -> str:
    """``testing.alpha``, the way a path is written in messages and after ``--set``."""
    return ".".join(map(str, where))


class Lines:
    """Where each value of a YAML document was written, which is composed and constructed at ``root``."""

    def __init__(self, path: str, root: Node) -> None:
        self.path = path
        self._root = root

    def line_of(self, where: YamlPath) -> int:
        """Line, from 1, of the value at ``where``, or of its nearest ancestor that is in the file."""
        node, line = self._root, 1
        for part in where:
            found = _child(node, part)
            if found is None:
                break
            mark, node = found
            line = mark.start_mark.line + 1
        return line

    def place(self, where: YamlPath) -> str:
        """``testing.alpha (smoke.yaml:12)``, or just file and line for the whole document."""
        spot = f"{self.path}:{self.line_of(where)}"
        return f"{dotted(where)} ({spot})" if where else spot


def _child(node: Node, part: str | int) -> tuple[Node, Node] | None:
    """Node that marks the line, and node of the value, of one step into ``node``."""
    if isinstance(node, SequenceNode) and isinstance(part, int) and part < len(node.value):
        return node.value[part], node.value[part]
    if isinstance(node, MappingNode):
        # The loader has put what ``<<`` merges before the mapping's own keys, which override it.
        return next(((key, value) for key, value in reversed(node.value) if key.value == str(part)), None)
    return None


def read_yaml(path: str | Path) -> tuple[dict[str, Any], Lines]:
    """Read a YAML file whose top level is a mapping.

    Parameters
    ----------
    path : str or Path
        UTF-8 text file with one YAML 1.2 document.

    Returns
    -------
    data : dict
        Plain ``dict``, ``list``, ``str``, ``int``, ``float``, ``bool`` and None.
    lines : Lines
        Line of every value.

    Raises
    ------
    CampaignError
        The file is missing, a folder, not UTF-8, empty, not a mapping, not YAML, or says a key twice.
    """
    name = str(path)
    data, root = _load(_read_text(Path(path)), name)
    if root is None:
        raise CampaignError(
            name, found="an empty file", expected="YAML keys and values", mend="Is it the right file, fully written?"
        )
    if not isinstance(data, dict):
        raise CampaignError(
            _place(name, root.start_mark),
            found=f"a {'list' if isinstance(data, list) else 'single value'} at the top level",
            expected="keys and values",
            mend="Write 'key: value' lines, without a dash before the first one.",
        )
    return data, Lines(name, root)


def parse_value(text: str, where: str) -> Any:
    """Read one value by the rules of `read_yaml`, as after the ``=`` of ``--set a.b=value``.

    Raises
    ------
    CampaignError
        ``text`` is empty or not YAML; the error names ``where``.
    """
    try:
        data, root = _load(text, where)
    except CampaignError as error:
        raise CampaignError(where, found=error.found, expected=error.expected, mend=error.mend) from None
    if root is None:
        raise CampaignError(
            where,
            found="no value after '='",
            expected="a value",
            mend="Write null if you mean none, '\"\"' for no text.",
        )
    return data


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)  # not all of what may be a device without an end
        if len(content) <= LARGEST_FILE:
            return content.decode("utf-8-sig")
        found, mend = f"more than {LARGEST_FILE:,} bytes", "Is it the right file?"
    except FileNotFoundError:
        found, mend = "no such file", "Check the spelling and the folder that you are in."
    except IsADirectoryError:
        found, mend = "a folder", "Name the file inside it."
    except UnicodeDecodeError as error:
        found, mend = f"bytes that are not UTF-8 (at byte {error.start})", "Save the file as UTF-8 text."
    except (OSError, ValueError) as error:
        found, mend = f"a file that cannot be read ({error})", "Check its name and permissions."
    raise CampaignError(str(path), found=found, expected="a readable YAML file in UTF-8", mend=mend)


def _load(text: str, name: str) -> tuple[Any, Node | None]:
    """Value of a text and, for the places of its parts, its composed document; None of both when it is empty."""
    mark: Mark | None = None
    trail: list[str | int] = []
    try:
        loader = StrictLoader(text)
        try:
            root = loader.get_single_node()
            return (None if root is None else loader.construct_document(root)), root
        finally:
            mark, trail = loader.get_mark(), [part for part in loader.trail if part is not None]
    except MarkedYAMLError as error:
        _fail_in_words(error, name, dotted(trail))
    except ReaderError as error:
        found = f"the character U+{error.character:04X}"
        *above, before = text[: error.position].split("\n")
        mark = Mark(name, error.position, len(above), len(before), text, error.position)
    except (ValueError, OverflowError) as error:  # an escape or a version number that is out of all bounds
        found = str(error).splitlines()[0]
    raise CampaignError(_place(name, mark), found=found, expected="plain YAML 1.2", mend="Correct or delete it.")


def _fail_in_words(error: MarkedYAMLError, name: str, path: str) -> NoReturn:
    """Say it in the parser's words: what it was at, and since which line, then the problem."""
    mark = error.problem_mark or error.context_mark
    since = f" (line {error.context_mark.line + 1})" if error.context_mark else ""
    found = ": ".join(filter(None, [error.context and error.context + since, error.problem]))
    found = found.removeprefix("found ")
    mend = str(error.note or "Check indentation, quotes and brackets at this place and just before it.")
    where = f"{path} ({_place(name, mark)})" if path else _place(name, mark)
    raise CampaignError(where, found=found, expected="plain YAML 1.2", mend=mend) from None


def _place(name: str, mark: Mark | None) -> str:
    return name if mark is None else f"{name}:{mark.line + 1}:{mark.column + 1}"


class StrictLoader(SafeLoader):
    """PyYAML's safe loader with YAML 1.2's core schema: no tag, key or number is guessed at, and nothing multiplies.

    It loads one document; whatever it refuses is a `yaml.error.MarkedYAMLError`, which knows line and column.
    """

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
