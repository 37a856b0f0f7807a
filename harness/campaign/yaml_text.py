"""Strict YAML 1.2: every value is what it looks like, and every value knows its line.

``1e-5`` is a number, ``12:30`` and ``no`` are strings, a date stays text. A key written twice, a second document, an
unknown tag, a syntax error or an empty file is a `CampaignError` that names file and line; nothing passes silently.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.composer import MaxDepthExceededError
from ruamel.yaml.error import MarkedYAMLError, ReusedAnchorWarning, YAMLError
from ruamel.yaml.nodes import Node
from ruamel.yaml.reader import ReaderError

from harness.campaign.problems import invalid_file
from harness.campaign.yaml_lines import Lines
from harness.campaign.yaml_nodes import DEEPEST, TOO_DEEP, PlainData, require_bounded
from harness.errors import CampaignError

Model = TypeVar("Model", bound=BaseModel)

LARGEST_FILE = 1_000_000
"""Bytes of a YAML file that is read: a hundred times the largest that comes with the harness, some 25 s of reading."""

_OPEN = "Look above for a [, { or quote that is not closed, and close it."
_SYNTAX = {
    "mapping values are not allowed": (
        "a second 'key:' where a value should end",
        "one 'key: value' per line",
        "Indent the key like its neighbours; put a text with ': ' in it in quotes.",
    ),
    "could not find expected ':'": (
        "a line without a colon just before here",
        "'key: value', with a space after the colon",
        "Add the colon, or indent the line if it belongs to the text above.",
    ),
    "found '<block mapping start>'": (
        "a key whose indentation fits no line above",
        "the same indentation for all keys of a section",
        "Put the key exactly below its neighbours.",
    ),
    "found '?'": ("a key after a list", "another '- item', or the end of the list", "Add a dash, or indent the key."),
    "found '-'": (
        "a list item among keys",
        "another 'key: value'",
        "Indent the list below the key that it belongs to.",
    ),
    "sequence entries are not allowed": (
        "a list item on the line of its key",
        "the first '- item' on a line of its own",
        "Begin a new line before the dash, or write [a, b].",
    ),
    "found '<scalar>'": (
        "text after a closing quote",
        "the end of the line",
        "Put all of the value in the same quotes.",
    ),
    "found '<stream end>'": ("the end of the file", "a closing bracket", _OPEN),
    "unexpected end of stream": ("the end of the file", "a closing quote", _OPEN),
    "expected ',' or": ("something else inside brackets", "a comma or the closing bracket", _OPEN),
    "found ']'": ("a ] that closes nothing", "a value", "Delete it, or write the [ that it belongs to."),
    "found '}'": ("a } that closes nothing", "a value", "Delete it, or write the { that it belongs to."),
    "cannot start any token": (
        "a character that a value may not begin with",
        "a value, or text in quotes",
        "Put the text in quotes.",
    ),
}
"""By a part of the parser's message: what was found and expected, and how to mend it."""


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
    root = _compose(_read_text(Path(path)), name)
    if root is None:
        raise CampaignError(
            name, found="an empty file", expected="YAML keys and values", mend="Is it the right file, fully written?"
        )
    data = PlainData(name).build(root)
    if not isinstance(data, dict):
        raise CampaignError(
            f"{name}:{root.start_mark.line + 1}",
            found=f"a {'list' if isinstance(data, list) else 'single value'} at the top level",
            expected="keys and values",
            mend="Write 'key: value' lines, without a dash before the first one.",
        )
    return data, Lines(name, root)


def read_model(path: str | Path, model: type[Model]) -> Model:
    """Read a YAML file into a pydantic model, such as an environment's parameters.

    Raises
    ------
    CampaignError
        As `read_yaml`; or the content does not fit ``model``, with every problem's path and line.
    """
    data, lines = read_yaml(path)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        schema = model.model_json_schema()
        raise invalid_file(error, path=str(path), data=data, schema=schema, place=lines.place) from None


def parse_value(text: str, where: str) -> Any:
    """Read one value by the rules of `read_yaml`, as after the ``=`` of ``--set a.b=value``.

    Raises
    ------
    CampaignError
        ``text`` is empty or not YAML; the error names ``where``.
    """
    try:
        root = _compose(text, where)
    except CampaignError as error:
        raise CampaignError(where, found=error.found, expected=error.expected, mend=error.mend) from None
    if root is None:
        raise CampaignError(
            where,
            found="no value after '='",
            expected="a value",
            mend="Write null if you mean none, '\"\"' for no text.",
        )
    return PlainData(where).build(root)


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)  # not all of what may be a device without an end
        if len(content) > LARGEST_FILE:
            _fail(str(path), 1, f"more than {LARGEST_FILE:,} bytes", "a file of settings", "Is it the right file?")
        return content.decode("utf-8-sig")
    except FileNotFoundError:
        found, mend = "no such file", "Check the spelling and the folder that you are in."
    except IsADirectoryError:
        found, mend = "a folder", "Name the file inside it."
    except UnicodeDecodeError as error:
        found, mend = f"bytes that are not UTF-8 (at byte {error.start})", "Save the file as UTF-8 text."
    except (OSError, ValueError) as error:
        found, mend = f"a file that cannot be read ({error})", "Check its name and permissions."
    raise CampaignError(str(path), found=found, expected="a readable YAML file in UTF-8", mend=mend)


def _compose(text: str, name: str) -> Node | None:
    parser = YAML(typ="safe", pure=True)
    parser.max_depth = DEEPEST
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", ReusedAnchorWarning)
            root: Node | None = parser.compose(text)
    except ReusedAnchorWarning as error:
        _fail_at_anchor(error, name)
    except MaxDepthExceededError as error:
        _fail(name, error.problem_mark.line + 1, *TOO_DEEP)
    except MarkedYAMLError as error:
        _fail_at_mark(error, name)
    except ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        found = f"the character U+{ord(text[error.position]):04X}"
        _fail(name, line, found, "printable text", "Delete it; it is often left by a word processor.")
    except RecursionError:
        _fail(name, 1, *TOO_DEEP)
    except (YAMLError, ValueError) as error:
        _fail(name, 1, str(error).splitlines()[0], "YAML 1.2", "Remove the directive or correct the syntax.")
    if parser.resolver.processing_version != (1, 2):
        _fail(name, 1, "a %YAML directive for another version", "YAML 1.2", "Delete the line that begins with %YAML.")
    if root is not None:
        require_bounded(root, name)
    return root


def _fail_at_anchor(warning: ReusedAnchorWarning, name: str) -> NoReturn:
    """The parser only warns, and prints the place: the last line number is that of the second anchor."""
    first, second = re.findall(r"line (\d+), column", str(warning))[-2:]
    found = f"an anchor (&) that line {first} has already"
    _fail(name, int(second), found, "each anchor once", "Give one of the two another name.")


def _fail_at_mark(error: MarkedYAMLError, name: str) -> NoReturn:
    mark = error.problem_mark or error.context_mark
    # A mark prints itself over several lines; the first part of the first line is the problem proper.
    problem = str(error.problem or error.context).splitlines()[0].split("   in ")[0].strip()
    if "\\t" in problem:
        _fail(name, mark.line + 1, "a tab", "spaces", "Indent with spaces only.")
    if "another document" in problem:
        _fail(name, mark.line + 1, "a second document (after ---)", "one document", "Keep one document per file.")
    line, column = mark.line + 1, mark.column + 1
    for part, (found, expected, mend) in _SYNTAX.items():
        if part in problem:
            raise CampaignError(f"{name}:{line}:{column}", found=found, expected=expected, mend=mend)
    raise CampaignError(
        f"{name}:{line}:{column}",
        found=problem.removeprefix("found "),
        expected="valid YAML",
        mend="Check indentation, quotes and brackets near it.",
    )


def _fail(name: str, line: int, found: str, expected: str, mend: str) -> NoReturn:
    raise CampaignError(f"{name}:{line}", found=found, expected=expected, mend=mend)
