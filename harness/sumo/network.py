"""The committed networks, and the settings under which SUMO does exactly what it is told."""

from __future__ import annotations

from pathlib import Path

from harness.campaign.testing import MOST_SUMO_CELLS
from harness.errors import CampaignError
from harness.outcomes import AV, BV, LV

_CHECKOUT = Path(__file__).parents[2] / "sumo_networks"
_INSTALLED = Path(__file__).parents[1] / "sumo_networks"

EXACT_OPTIONS = (
    "--step-length", "0.1",
    "--step-method.ballistic", "true",
    "--collision.action", "warn",
    "--collision.mingap-factor", "0",
    "--time-to-teleport", "-1",
    "--default.speeddev", "0",
    "--no-step-log", "true",
    "--no-warnings", "true",
    "--xml-validation", "never",
    "--xml-validation.net", "never",
)  # fmt: skip
"""Ballistic update; collisions reported and otherwise ignored; no teleports; nothing random."""

LEFT, RIGHT = 1, 0
OBEY = 0
"""Speed mode in which commands are taken as they are."""
NEVER_PLAN_S, PLAN_NOW_S = 1000.0, 0.1
"""Action steps: SUMO's own planning is switched off, except for the one step in which BV changes lanes."""
PARKED_M = {LV: 300.0, BV: 200.0, AV: 100.0}
"""Where the vehicles of a cell stand that has not been given an episode."""


def network_file(n_cells: int) -> Path:
    """Smallest committed network with at least ``n_cells`` roads; a campaign asks for at most `MOST_SUMO_CELLS`."""
    return committed_file("highway-1.net.xml" if n_cells == 1 else f"highway-{MOST_SUMO_CELLS}.net.xml")


def committed_file(name: str) -> Path:
    """A file of ``sumo_networks/``, from the installed package or from the checkout."""
    path = (_INSTALLED if _INSTALLED.exists() else _CHECKOUT) / name
    if not path.exists():
        raise CampaignError(
            str(path), found="no file", expected="the committed network", mend="Reinstall the harness from a checkout."
        )
    return path


def sumo_program(name: str) -> Path | None:
    """``sumo`` or ``sumo-gui`` of the extra ``harness[sumo]``, or None where it is not installed."""
    try:
        import sumo  # noqa: PLC0415 - an extra
    except ImportError:
        return None
    path = Path(str(sumo.SUMO_HOME)) / "bin" / name
    return path if path.exists() else None
