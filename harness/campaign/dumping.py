"""Write a campaign with every value spelled out, so that the run folder says what was run."""

from __future__ import annotations

import math
from typing import Any

import yaml

from harness.campaign.models import Campaign
from harness.campaign.section import Section
from harness.campaign.vehicle import AV_SOURCES

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
    """YAML text of a campaign; `harness.campaign.loading.load_campaign` reads an equal campaign from it."""
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
