"""Write a campaign with every value spelled out, so that the run folder says what was run."""

from __future__ import annotations

from io import StringIO
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter
from ruamel.yaml.scalarstring import DoubleQuotedScalarString

from harness.campaign.models import AV_SOURCES, Campaign, Section

_HEADER = """\
# Campaign {name}, resolved: every value is written out, defaults included.
# Lists of allowed keys and values: harness schema. Run it again: harness run THIS_FILE --out DIR
"""
_NEVER_FOLD = 1_000_000


class _Representer(RoundTripRepresenter):
    """Writes ``null``; by itself the library leaves the place empty, which looks like something forgotten."""

    def represent_none(self, _: None) -> ScalarNode:
        """Node of a missing value."""
        return self.represent_scalar("tag:yaml.org,2002:null", "null")


_Representer.add_representer(type(None), _Representer.represent_none)


def dump_campaign(campaign: Campaign) -> str:
    """YAML text of a campaign; `harness.campaign.loading.load_campaign` reads an equal campaign from it.

    Parameters
    ----------
    campaign : Campaign
        Any campaign; a relative ``environment.parameters`` stays relative.
    """
    parts = [_HEADER.format(name=campaign.name)]
    for key, value in written_out(campaign).items():
        about = _about(campaign, key)
        parts.append(f"\n# {about}\n{_yaml({key: value})}")
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


def _yaml(data: dict[str, Any]) -> str:
    writer = YAML()
    writer.width = _NEVER_FOLD
    # Escapes keep every character, control characters included, through any editor.
    writer.allow_unicode = False
    writer.Representer = _Representer
    stream = StringIO()
    writer.dump(_quoted(data), stream)
    return stream.getvalue()


def _quoted(value: Any) -> Any:
    """Quote every text that is not a plain word, for other YAML readers see numbers, dates and truth values in many."""
    if isinstance(value, dict):
        return {_quoted(key): _quoted(item) for key, item in value.items()}
    if isinstance(value, str) and not _is_plain_word(value):
        return DoubleQuotedScalarString(value)
    return value


def _is_plain_word(text: str) -> bool:
    ambiguous = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}
    letters = text.replace("_", "").replace("-", "")
    return letters.isascii() and letters[:1].isalpha() and letters.isalnum() and text.lower() not in ambiguous
