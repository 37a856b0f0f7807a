"""All settings of the campaign as tables, each with the meaning that the campaign models give it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError

from harness.campaign.models import Campaign
from harness.report.number_format import value


@dataclass(frozen=True)
class Setting:
    """One setting: its path inside the section, its value as text, and what it means."""

    path: str
    value: str
    meaning: str


@dataclass(frozen=True)
class SettingSection:
    """The settings under one top-level key of the campaign."""

    title: str
    settings: tuple[Setting, ...]


def setting_sections(campaign: dict[str, Any], *, reproducible: bool | None = None) -> list[SettingSection]:
    """Sections in the order of the file; top-level scalars come first, as ``campaign``, with what the manifest adds."""
    meanings = _meanings(campaign)
    scalars = {key: content for key, content in campaign.items() if not isinstance(content, dict)}
    top = _settings(scalars, "", meanings)
    if reproducible is not None:
        top += (Setting("reproducible", value(reproducible), "whether an episode runs again bit for bit (manifest)"),)
    sections = [SettingSection("campaign", top)]
    for key, content in campaign.items():
        if isinstance(content, dict):
            sections.append(SettingSection(str(key), _settings(content, f"{key}.", meanings)))
    return [section for section in sections if section.settings]


def flat(content: Any, path: str = "") -> list[tuple[str, Any]]:
    """Leaves of nested mappings as (dotted path, value), in order."""
    if isinstance(content, dict) and content:
        return [leaf for key, part in content.items() for leaf in flat(part, f"{path}.{key}" if path else str(key))]
    return [(path, content)]


def _settings(content: dict[str, Any], prefix: str, meanings: dict[str, str]) -> tuple[Setting, ...]:
    return tuple(Setting(path, value(leaf), meanings.get(prefix + path, "")) for path, leaf in flat(content))


def _meanings(campaign: dict[str, Any]) -> dict[str, str]:
    """Descriptions by dotted path; none when the campaign is from a version with other settings."""
    try:
        return dict(_described(Campaign.model_validate(campaign), ""))
    except ValidationError:
        return {}


def _described(content: Any, path: str) -> list[tuple[str, str]]:
    """Follow the validated instances, not the schema, so that the chosen driver model decides what a name means."""
    found: list[tuple[str, str]] = []
    if isinstance(content, BaseModel):
        for name, info in type(content).model_fields.items():
            inner = f"{path}.{name}" if path else name
            found.append((inner, info.description or ""))
            found += _described(getattr(content, name), inner)
    elif isinstance(content, dict):
        for name, part in content.items():
            found += _described(part, f"{path}.{name}")
    return found
