"""Files of campaigns: read as strict YAML, overridden (``--set``, ``--av``), and checked with every problem named.

``1e-5`` is a number, ``12:30`` and ``no`` are texts, a date stays text. A key written twice, a second document, a tag,
a syntax error or an empty file is a `CampaignError` that names file, line and column.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field
from yaml import SafeLoader
from yaml.composer import ComposerError
from yaml.error import MarkedYAMLError
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from yaml.reader import ReaderError

from harness.campaign.campaign import Campaign
from harness.campaign.drivers import default_surrogates
from harness.campaign.problems import NAME_PATTERN, Model, YamlPath, describe_found, did_you_mean, validated
from harness.campaign.sections import Section
from harness.campaign.vehicle import AutomatedVehicle
from harness.errors import CampaignError

SHIPPED_PARAMETERS = Path(__file__).parents[1] / "traffic"


SHIPPED_PANEL = Path(__file__).parents[1] / "scenarios" / "av_panel.yaml"
_FILES = {
    ("av", "fmu", "file"): "an FMI 2.0 co-simulation FMU",
    ("pool", "library"): "a surrogate library, or the name of a shipped one",
    ("environment", "parameters"): "a parameter file, or the name of a shipped one",
}
"""Places of a campaign that may name a file, and what that has to be."""


def load_campaign(
    path: str | Path, overrides: Sequence[str] = (), *, av: str | None = None, check_files: bool = True
) -> Campaign:
    """Read, override and validate a campaign; paths of files that it names become absolute.

    Parameters
    ----------
    path : str or Path
        Campaign file.
    overrides : sequence of str
        ``section.key=value`` each, as after ``--set``: ``["stop.rhw=0.3", "av.parameters.min_acceleration_mps2=-6"]``.
    av : str, optional
        Vehicle that replaces the campaign's, as after ``--av``: ``PANEL.yaml:NAME``, or ``NAME`` in the shipped panel.
        Overrides are laid over it.
    check_files : bool
        Whether files that the campaign names must exist; False to look at a run whose environment file is gone.

    Raises `CampaignError`: the file cannot be read, is not YAML, or says something wrong; the error names every place.
    """
    laid = [] if av is None else [Override(("av",), panel_av(av).model_dump(exclude_unset=True), f"--av {av}")]
    campaign, place = _read(path, Campaign, [*laid, *map(parse_override, overrides)])
    folder = Path(path).parent
    for where, expected in _FILES.items():
        name = campaign.at(where)
        if name is None or (where[-1] != "file" and not names_a_file(name)):
            continue
        file = _absolute(name, folder)
        if check_files and not Path(file).is_file():
            mend = "Correct the path; it is relative to the folder of the campaign file."
            raise CampaignError(place(where), f"{name}, but there is no file {file}", expected, mend)
        campaign = campaign.replaced(where, file)
    if check_files:
        shipped_or_own(campaign.environment.parameters, SHIPPED_PARAMETERS, place(("environment", "parameters")))
    runtime_env = {
        key: _absolute(value, folder) if key in ("working_dir", "py_modules") else value
        for key, value in campaign.run.ray.runtime_env.items()
    }
    return campaign.replaced(("run", "ray", "runtime_env"), runtime_env)


def _absolute(value: Any, folder: Path) -> Any:
    """A path, or each of a list, that is relative to a folder; URIs, as Ray takes them, stay."""
    if isinstance(value, list):
        return [_absolute(each, folder) for each in value]
    if isinstance(value, str) and "://" not in value:
        return str((folder / Path(value).expanduser()).resolve())
    return value


def names_a_file(name: str) -> bool:
    """Tell a path to a file of one's own from the name of a shipped one."""
    return name.endswith((".yaml", ".yml")) or "/" in name


def shipped_or_own(name: str, folder: Path, where: str) -> Path:
    """File that a name stands for: one of those shipped in ``folder`` (or `CampaignError`), or the user's own."""
    if names_a_file(name):
        return Path(name)
    shipped = sorted(file.stem for file in folder.glob("*.yaml"))
    if name not in shipped:
        expected = f"a shipped name ({', '.join(shipped)}), or a path that ends in .yaml"
        mend = did_you_mean(name, shipped) or "For a file of your own write its path, such as ./mine.yaml."
        raise CampaignError(where, f"'{name}', which is not shipped", expected, mend)
    return folder / f"{name}.yaml"


# -- values given with the command --


@dataclass(frozen=True)
class Override:
    """One ``--set`` (or ``--av``): where, the value that replaces what is there, and the option as it was typed."""

    path: tuple[str, ...]
    value: Any
    option: str


def parse_override(text: str) -> Override:
    """Read ``testing.epsilon=0.2`` (else `CampaignError`), the value by the same rules as in a campaign file."""
    path, equals, value = text.partition("=")
    parts, option = tuple(part.strip() for part in path.split(".")), f"--set {text}"
    if not equals or not all(parts):
        raise CampaignError(option, "no path and value", "section.key=value", "For example: --set testing.epsilon=0.2")
    return Override(parts, parse_value(value, option), option)


def apply_overrides(data: dict[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
    """Lay each override over ``data``, later ones over earlier ones; ``data`` itself stays as it is.

    A path that leads through something that is not a section is a `CampaignError`.
    """
    changed = dict(data)
    for override in overrides:
        if override.path[0] == "surrogates" and len(override.path) > 1 and "surrogates" not in changed:
            # The file leaves the surrogates to their default: changing one must not drop the others.
            changed["surrogates"] = {name: driver.model_dump() for name, driver in default_surrogates().items()}
        section = changed
        for depth, part in enumerate(override.path[:-1], start=1):
            inner, where = section.get(part, {}), dotted(override.path[:depth])
            if not isinstance(inner, dict):
                mend = f"Set {where} itself, or correct the path."
                raise CampaignError(override.option, f"{describe_found(inner)} at {where}", "a section with keys", mend)
            # A copy on the way, because an anchor makes several places share one section.
            section[part] = dict(inner)
            section = section[part]
        section[override.path[-1]] = override.value
    return changed


@dataclass(frozen=True)
class Places:
    """Where values were written: in a file (lines from 1, by path), or by an override, of which later ones win."""

    path: str
    lines: dict[tuple[str | int, ...], int]
    overrides: Sequence[Override] = ()

    def line_of(self, where: YamlPath) -> int:
        """Line of the value at ``where``, or of its nearest ancestor that is in the file."""
        return next(self.lines[at] for n in range(len(where), -1, -1) if (at := tuple(where[:n])) in self.lines)

    def __call__(self, where: YamlPath) -> str:
        """``--set a.b=c``; or ``a.b (smoke.yaml:12)``, with overrides of its parts; file and line for the whole."""
        for override in reversed(self.overrides):
            if tuple(where[: len(override.path)]) == override.path:
                return override.option
        spot = f"{self.path}:{self.line_of(where)}"
        place = f"{dotted(where)} ({spot})" if where else spot
        section = tuple(where) if tuple(where) in self.lines else tuple(where[:-1])  # of a key that is missing
        inside = [item.option for item in self.overrides if item.path[: len(section)] == section]
        return f"{place} with {' '.join(inside)}" if inside and section else place


# -- a panel of vehicles --


class Panel(Section):
    """Automated vehicles by name: ``av`` sections that experiments, tests and tables share."""

    format: Literal["av-panel"]
    version: Literal[1]
    description: str = ""
    avs: dict[Annotated[str, Field(pattern=NAME_PATTERN)], AutomatedVehicle] = Field(
        min_length=1, description="av sections by name"
    )


def load_panel(path: str | Path = SHIPPED_PANEL) -> Panel:
    """Read a panel, or name all that is wrong with it (`CampaignError`); paths of FMUs become absolute."""
    panel = read_model(path, Panel)
    avs = {
        name: av if av.fmu is None else av.replaced(("fmu", "file"), _absolute(av.fmu.file, Path(path).parent))
        for name, av in panel.avs.items()
    }
    return panel.replaced(("avs",), avs)


def panel_av(text: str) -> AutomatedVehicle:
    """The vehicle that ``PANEL.yaml:NAME`` names, or a bare ``NAME`` in the shipped panel; else a `CampaignError`."""
    file, _, name = text.rpartition(":")
    avs = load_panel(file or SHIPPED_PANEL).avs
    if name not in avs:
        expected = f"one of {', '.join(avs)}; or PANEL.yaml:NAME for a panel of your own"
        mend = did_you_mean(name, list(avs)) or "Name one of them."
        raise CampaignError(f"--av {text}", f"no vehicle '{name}' in {file or 'the shipped panel'}", expected, mend)
    return avs[name]


# -- strict YAML 1.2: every value is what it looks like, and knows its line --


def read_model(path: str | Path, model: type[Model], overrides: Sequence[Override] = ()) -> Model:
    """Read a YAML file into a model, or name the path and line of every problem (`CampaignError`)."""
    return _read(path, model, overrides)[0]


def _read(path: str | Path, model: type[Model], overrides: Sequence[Override]) -> tuple[Model, Places]:
    data, places = read_yaml(path)
    places = replace(places, overrides=overrides)
    return validated(apply_overrides(data, overrides), model, str(path), places), places


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


def read_yaml(path: str | Path) -> tuple[dict[str, Any], Places]:
    """Read a UTF-8 file with one YAML 1.2 document whose top level is a mapping: its plain data, and their lines.

    Any other file, and one that says a key twice, is a `CampaignError`.
    """
    name = str(path)
    data, lines = _load(_read_text(Path(path)), name)
    if not lines:
        raise CampaignError(name, "an empty file", "YAML keys and values", "Is it the right file, fully written?")
    if not isinstance(data, dict):
        found = f"a {'list' if isinstance(data, list) else 'single value'} at the top level"
        mend = "Write 'key: value' lines, without a dash before the first one."
        raise CampaignError(f"{name}:{lines[()]}", found, "keys and values", mend)
    return data, Places(name, lines)


def parse_value(text: str, where: str) -> Any:
    """Read one value by the rules of `read_yaml`, as after the ``=`` of ``--set a.b=value``; errors name ``where``."""
    try:
        data, lines = _load(text, where)
    except CampaignError as error:
        raise CampaignError(where, error.found, error.expected, error.mend) from None
    if not lines:
        mend = "Write null if you mean none, '\"\"' for no text."
        raise CampaignError(where, "no value after '='", "a value", mend)
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
    raise CampaignError(str(path), found, "a readable YAML file in UTF-8", mend)


def _load(text: str, name: str) -> tuple[Any, dict[tuple[str | int, ...], int]]:
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


def _checked_lines(root: Node) -> dict[tuple[str | int, ...], int]:
    """Line of every value by its path, aliases written out.

    Refused are too many values or levels, for with aliases a few lines can stand for billions of values, and keys that
    are no text or stand there twice.
    """
    lines: dict[tuple[str | int, ...], int] = {(): root.start_mark.line + 1}
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
                found = f"a key {shown}, which is not text"
                raise ComposerError(None, None, found, key.start_mark, "Quote the key if it is meant as text.")
            at = (*path, key.value)
            if at in lines:
                found = f"the key {key.value!r} again, first written on line {lines[at]}"
                raise ComposerError(dotted(at), None, found, key.start_mark, "Delete one of the two.")
            lines[at] = key.start_mark.line + 1
            waiting.append((at, value))
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
