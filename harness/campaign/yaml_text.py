"""Strict YAML 1.2: every value is what it looks like, and every value knows its line.

``1e-5`` is a number, ``12:30`` and ``no`` are strings, a date stays text. A key written twice, a second document, an
unknown tag, a syntax error or an empty file is a `CampaignError` that names file, line and column.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from yaml.error import Mark, MarkedYAMLError
from yaml.nodes import MappingNode, Node, SequenceNode
from yaml.reader import ReaderError

from harness.campaign.yaml_loader import StrictLoader
from harness.errors import CampaignError

LARGEST_FILE = 1_000_000
"""Bytes of a YAML file that is read: a hundred times the largest that comes with the harness."""

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
