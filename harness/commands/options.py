"""What several commands share: kinds of paths, options, and how a campaign is read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from harness.campaign.models import Campaign

FOLDER = click.Path(path_type=Path, file_okay=False)
RUN_FOLDER = click.Path(path_type=Path, file_okay=False, exists=True)
FILE = click.Path(path_type=Path, dir_okay=False)
CAMPAIGN = click.Path(path_type=Path)

set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="A.B=C",
    help="Replace a value of the campaign, e.g. --set stop.rhw=0.3. May be given several times.",
)
av_option = click.option(
    "--av",
    "av",
    metavar="[PANEL.yaml:]NAME",
    help="Test this vehicle of a panel instead of the campaign's; a bare NAME is one of the shipped panel.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON on stdout instead of text.")


def examples(*lines: str) -> str:
    """Lay out lines below a help text, kept as they are (the backspace is click's mark for that)."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def loaded(campaign_file: Path, overrides: Sequence[str], av: str | None = None) -> Campaign:
    """Read the campaign that a command was given, with what was replaced on the command line."""
    from harness.campaign.loading import load_campaign  # noqa: PLC0415 - keeps --help fast

    return load_campaign(campaign_file, overrides, av=av)
