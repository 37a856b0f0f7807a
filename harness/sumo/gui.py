"""The same calls over a socket to a sumo-gui (extra ``harness[sumo]``), to look at an episode."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

from harness.errors import CampaignError
from harness.sumo.network import sumo_program


def start_gui(arguments: Sequence[str]) -> Any:
    """Start sumo-gui and connect to it; returns traci, which has libsumo's functions.

    Raises
    ------
    CampaignError
        It is not installed, or has no screen to open its window on.
    """
    import traci  # noqa: PLC0415 - comes with libsumo, wanted only here

    program = sumo_program("sumo-gui")
    if program is None:
        raise CampaignError(
            "--gui", found="no sumo-gui", expected="the extra 'sumo'", mend="Install it: pip install 'harness[sumo]'."
        )
    display = os.environ.get("DISPLAY")
    if sys.platform.startswith("linux") and not display:
        raise _no_window("no screen (the environment variable DISPLAY is not set)")
    try:
        traci.start([str(program), "--start", "--delay", "100", *arguments])
    except (traci.TraCIException, traci.FatalTraCIError) as error:
        raise _no_window(f"a sumo-gui that cannot be reached ({error}; DISPLAY is {display})") from error
    return traci


def _no_window(found: str) -> CampaignError:
    return CampaignError(
        "--gui",
        found=found,
        expected="a desktop that sumo-gui can open its window on",
        mend="Start it from a desktop session (or with ssh -X), or write the motion to a file: --out FILE.csv.",
    )
