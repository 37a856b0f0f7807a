"""A panel of automated vehicles: ``av`` sections by name, in one YAML file that experiments, tests and tables share."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from harness.campaign.models import AutomatedVehicle
from harness.campaign.overrides import Override
from harness.campaign.problems import read_model
from harness.campaign.section import NAME_PATTERN, Section
from harness.errors import CampaignError

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
