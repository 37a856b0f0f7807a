"""``--set a.b=c``: values given with the command, laid over what the campaign file says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from harness.campaign.drivers import default_surrogates
from harness.campaign.problems import describe_found
from harness.campaign.yaml_text import Lines, YamlPath, dotted, parse_value
from harness.errors import CampaignError


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
