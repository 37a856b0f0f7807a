"""Files of campaigns: read, overridden (``--set``, ``--av``), checked with every problem named, and written again."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field

from harness.campaign.campaign import Campaign
from harness.campaign.problems import describe_found, read_model, validated
from harness.campaign.sections import NAME_PATTERN, Section
from harness.campaign.vehicle import AV_SOURCES, AutomatedVehicle, default_surrogates
from harness.campaign.yaml_text import Lines, YamlPath, dotted, parse_value, read_yaml
from harness.errors import CampaignError

SHIPPED_PARAMETERS = Path(__file__).parent.parent / "traffic"


def load_campaign(
    path: str | Path, overrides: Sequence[str] = (), *, av: str | None = None, check_files: bool = True
) -> Campaign:
    """Read, override and validate a campaign.

    Parameters
    ----------
    path : str or Path
        Campaign file.
    overrides : sequence of str
        ``section.key=value`` each, as after ``--set``.
    av : str, optional
        Vehicle that replaces the campaign's, as after ``--av``: ``PANEL.yaml:NAME``, or ``NAME`` in the shipped panel.
        Overrides are laid over it.
    check_files : bool
        Whether files that the campaign names must exist; False to look at a run whose environment file is gone.

    Returns
    -------
    Campaign
        With ``environment.parameters``, when it is a path, and ``av.fmu.file`` absolute.

    Raises
    ------
    CampaignError
        The file cannot be read, is not YAML, or says something wrong; the error names every place.

    Examples
    --------
    >>> load_campaign("scenarios/smoke.yaml", ["stop.rhw=0.3", "av.parameters.min_acceleration_mps2=-6"])
    """
    data, lines = read_yaml(path)
    changes = [*([] if av is None else [av_override(av)]), *map(parse_override, overrides)]
    place = Places(lines, changes)
    campaign = validated(apply_overrides(data, changes), Campaign, str(path), place)
    for where, (name, expected) in _named_files(campaign).items():
        file = (Path(path).parent / Path(name).expanduser()).resolve()
        if check_files and not file.is_file():
            raise CampaignError(
                place(where),
                found=f"{name}, but there is no file {file}",
                expected=expected,
                mend="Correct the path; it is relative to the folder of the campaign file.",
            )
        campaign = campaign.replaced(where, str(file))
    campaign = campaign.replaced(("run", "ray", "runtime_env"), _with_absolute_paths(campaign, Path(path).parent))
    name = campaign.environment.parameters
    if check_files and not names_a_file(name) and name not in shipped_parameters():
        shipped = shipped_parameters()
        close = difflib.get_close_matches(name, shipped, n=1)
        mend = f"Did you mean '{close[0]}'?" if close else "For a file of your own write its path, such as ./mine.yaml."
        raise CampaignError(
            place(("environment", "parameters")),
            found=f"'{name}', which is not shipped",
            expected=f"the name of a shipped parameter file: {', '.join(shipped)}; or a path that ends in .yaml",
            mend=mend,
        )
    return campaign


def _with_absolute_paths(campaign: Campaign, folder: Path) -> dict[str, Any]:
    """Ray's environment, in which folders of this machine are relative to the campaign's file; others are URIs."""

    def absolute(value: Any) -> Any:
        if isinstance(value, list):
            return [absolute(each) for each in value]
        if isinstance(value, str) and "://" not in value:
            return str((folder / Path(value).expanduser()).resolve())
        return value

    environment = campaign.run.ray.runtime_env
    return {
        key: absolute(value) if key in ("working_dir", "py_modules") else value for key, value in environment.items()
    }


def _named_files(campaign: Campaign) -> dict[tuple[str, ...], tuple[str, str]]:
    """Files that a campaign names: by their place in it the name and what it has to be."""
    fmu, library, parameters = campaign.av.fmu, campaign.pool.library, campaign.environment.parameters
    files: dict[tuple[str, ...], tuple[str, str]] = {}
    if fmu is not None:
        files["av", "fmu", "file"] = fmu.file, "an FMI 2.0 co-simulation FMU"
    if names_a_file(library):
        files["pool", "library"] = library, "a surrogate library, or the name of a shipped one"
    if names_a_file(parameters):
        expected = f"a parameter file, or the name of a shipped one: {', '.join(shipped_parameters())}"
        files["environment", "parameters"] = parameters, expected
    return files


def shipped_parameters() -> list[str]:
    """Names of the environment parameter files that come with the harness."""
    return sorted(file.stem for file in SHIPPED_PARAMETERS.glob("*.yaml"))


def names_a_file(parameters: str) -> bool:
    """Tell a path to a parameter file from the name of a shipped one."""
    return parameters.endswith((".yaml", ".yml")) or "/" in parameters


@dataclass(frozen=True)
class Override:
    """One ``--set`` (or ``--av``): where, and the value that replaces what is there."""

    path: tuple[str, ...]
    value: Any
    text: str
    flag: str = "--set"

    @property
    def option(self) -> str:
        """The option as it was typed."""
        return f"{self.flag} {self.text}"


def parse_override(text: str) -> Override:
    """Read ``testing.epsilon=0.2``; the value is read by the same rules as in a campaign file.

    Raises
    ------
    CampaignError
        There is no ``=``, an empty part in the path, or no YAML value after the ``=``.
    """
    path, equals, value = text.partition("=")
    parts = tuple(part.strip() for part in path.split("."))
    if not equals or not all(parts):
        raise CampaignError(
            f"--set {text}",
            found="no path and value",
            expected="section.key=value",
            mend="For example: --set testing.epsilon=0.2",
        )
    return Override(parts, parse_value(value, f"--set {text}"), text)


def apply_overrides(data: dict[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
    """Lay each override over ``data``, later ones over earlier ones; ``data`` itself stays as it is.

    Raises
    ------
    CampaignError
        The path leads through something that is not a section.
    """
    changed = dict(data)
    for override in overrides:
        if override.path[0] == "surrogates" and len(override.path) > 1 and "surrogates" not in changed:
            # The file leaves the surrogates to their default: changing one must not drop the others.
            changed["surrogates"] = {name: driver.model_dump() for name, driver in default_surrogates().items()}
        _lay_over(changed, override)
    return changed


def _lay_over(data: dict[str, Any], override: Override) -> None:
    section = data
    for depth, part in enumerate(override.path[:-1], start=1):
        inner = section.get(part, {})
        if not isinstance(inner, dict):
            raise CampaignError(
                override.option,
                found=f"{describe_found(inner)} at {dotted(override.path[:depth])}",
                expected="a section with keys",
                mend=f"Set {dotted(override.path[:depth])} itself, or correct the path.",
            )
        # A copy on the way, because an anchor makes several places share one section.
        copied = dict(inner)
        section[part] = copied
        section = copied
    section[override.path[-1]] = override.value


class Places:
    """Says where a value was written: in the file, or by one of the overrides, in the order they were applied in."""

    def __init__(self, lines: Lines, overrides: Sequence[Override]) -> None:
        self._lines = lines
        self._overrides = overrides

    def __call__(self, path: YamlPath) -> str:
        """``--set a.b=c``, or ``a.b (file:line)`` with the overrides that changed parts of it."""
        for override in reversed(self._overrides):
            if tuple(path[: len(override.path)]) == override.path:
                return override.option
        inside = [item.option for item in self._overrides if item.path[: len(path)] == tuple(path)]
        place = self._lines.place(path)
        return f"{place} with {' '.join(inside)}" if inside and path else place


_CHECKOUT = Path(__file__).parents[2] / "scenarios"
_INSTALLED = Path(__file__).parents[1] / "scenarios"
SHIPPED_PANEL = (_INSTALLED if _INSTALLED.exists() else _CHECKOUT) / "av_panel.yaml"

VehicleName = Annotated[str, Field(pattern=NAME_PATTERN)]


class Panel(Section):
    """Automated vehicles by name."""

    format: Literal["av-panel"]
    version: Literal[1]
    description: str = ""
    avs: dict[VehicleName, AutomatedVehicle] = Field(min_length=1, description="av sections by name")


def load_panel(path: str | Path = SHIPPED_PANEL) -> Panel:
    """Read a panel; an FMU's file, relative to the panel's folder, becomes absolute.

    Raises
    ------
    CampaignError
        The file cannot be read or says something wrong; the error names every place.
    """
    panel = read_model(path, Panel)
    for name, av in panel.avs.items():
        if av.fmu is not None:
            file = (Path(path).parent / Path(av.fmu.file).expanduser()).resolve()
            panel = panel.replaced(("avs",), panel.avs | {name: av.replaced(("fmu", "file"), str(file))})
    return panel


def panel_av(text: str) -> AutomatedVehicle:
    """The vehicle that ``PANEL.yaml:NAME`` names, or a bare ``NAME`` in the shipped panel.

    Raises
    ------
    CampaignError
        There is no such panel, or no such vehicle in it.
    """
    file, _, name = text.rpartition(":")
    avs = load_panel(file or SHIPPED_PANEL).avs
    if name not in avs:
        close = difflib.get_close_matches(name, avs, n=1)
        raise CampaignError(
            f"--av {text}",
            found=f"no vehicle '{name}' in {file or 'the shipped panel'}",
            expected=f"one of {', '.join(avs)}; or PANEL.yaml:NAME for a panel of your own",
            mend=f"Did you mean '{close[0]}'?" if close else "Name one of them.",
        )
    return avs[name]


def av_override(text: str) -> Override:
    """``--av``: the vehicle's section in place of the campaign's own, with only what the panel writes."""
    return Override(("av",), panel_av(text).model_dump(exclude_unset=True), text, flag="--av")


_HEADER = """\
# Campaign {name}, resolved: every value is written out, defaults included.
# Lists of allowed keys and values: harness schema. Run it again: harness run THIS_FILE --out DIR
"""


class _Dumper(yaml.SafeDumper):
    """Quotes every text that is not a plain word: other YAML readers see numbers, dates and truth values in many."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 - the library's signature
        """Write every value out."""
        return True

    def represent_text(self, text: str) -> yaml.ScalarNode:
        """Node of a text."""
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=None if _is_plain_word(text) else '"')


_Dumper.add_representer(str, _Dumper.represent_text)


def dump_campaign(campaign: Campaign) -> str:
    """YAML text of a campaign; `load_campaign` reads an equal campaign from it."""
    parts = [_HEADER.format(name=campaign.name)]
    for key, value in written_out(campaign).items():
        about = _about(campaign, key)
        parts.append(f"\n# {about}\n{yaml_text({key: value})}")
    return "".join(parts)


def written_out(campaign: Campaign) -> dict[str, Any]:
    """Plain data of a campaign with every default, but of the sources of an AV only the one that drives it."""
    data = campaign.model_dump()
    data["av"] = {key: value for key, value in data["av"].items() if key not in AV_SOURCES or value is not None}
    return data


def _about(campaign: Campaign, key: str) -> str:
    """Comment above a top-level key: the field's description, or the first line of its section's docstring."""
    field = type(campaign).model_fields[key]
    value = getattr(campaign, key)
    text = (type(value).__doc__ if isinstance(value, Section) else None) or field.description or key
    return text.splitlines()[0]


def yaml_text(data: Any, *, one_line: bool = False) -> str:
    """YAML of plain data, which `harness.campaign.yaml_text` reads back as it is."""
    # Escapes keep every character, control characters included, through any editor; math.inf never folds a line.
    text: str = yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, allow_unicode=False, width=math.inf, default_flow_style=one_line
    )
    return text.removesuffix("...\n")  # after a value that is no mapping


def _is_plain_word(text: str) -> bool:
    ambiguous = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}
    letters = text.replace("_", "").replace("-", "")
    return letters.isascii() and letters[:1].isalpha() and letters.isalnum() and text.lower() not in ambiguous
