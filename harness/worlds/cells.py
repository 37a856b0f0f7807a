"""The settings under which SUMO does exactly what it is told, and K roads in it, each with LV, BV and AV.

With the committed networks, whose ``vehicles.add.xml`` holds the vehicle types; `harness.worlds.sumo` checks what SUMO
did. Also how cells are placed, and who touched whom.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from harness.campaign.combinations import MOST_SUMO_CELLS
from harness.errors import CampaignError
from harness.vocabulary import AV, BV, LV, VEHICLES, BoolArray, FloatArray

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


class SumoCells:
    """K roads in a SUMO, each with LV, BV and AV.

    ``x``, ``v`` (K, 3) are as of `harness.worlds.protocol.World`.
    """

    def __init__(self, n_cells: int) -> None:
        self.x: FloatArray = np.zeros((n_cells, 3))
        self.v: FloatArray = np.zeros((n_cells, 3))
        self._park(np.arange(n_cells))
        self._names = [[f"{vehicle}{k}" for vehicle in VEHICLES] for k in range(n_cells)]
        self._flat = [name for cell in self._names for name in cell]
        self._cell_of = {name: k for k, cell in enumerate(self._names) for name in cell}
        self._contact: BoolArray = np.zeros(n_cells, np.bool_)

    @property
    def n_cells(self) -> int:
        """K."""
        return int(self.x.shape[0])

    def _park(self, cells: Any) -> None:
        self.x[cells], self.v[cells] = [PARKED_M[LV], PARKED_M[BV], PARKED_M[AV]], 0.0

    def _arguments(self) -> list[str]:
        """SUMO's command line, without the name of the program."""
        types = ",".join(map(str, self._type_files()))
        return ["-n", str(network_file(self.n_cells)), "-a", types, *EXACT_OPTIONS]

    def _type_files(self) -> list[Path]:
        """Files with the vehicle types."""
        return [committed_file("vehicles.add.xml")]

    def _type_of(self, vehicle: int) -> str:  # noqa: ARG002 - worlds whose AV is of another type look at it
        """Name of the vehicle type of LV, BV or AV."""
        return "exact"

    def _populate(self, api: Any) -> None:
        """Put the vehicles of all cells on the road, parked."""
        for k, names in enumerate(self._names):
            api.route.add(f"cell{k}", [f"cell{k}"])
            for vehicle, name in enumerate(names):
                lane, position = str(RIGHT if vehicle == AV else LEFT), str(PARKED_M[vehicle])
                api.vehicle.add(name, f"cell{k}", typeID=self._type_of(vehicle), departLane=lane, departPos=position)
                api.vehicle.setSpeedMode(name, OBEY)
                api.vehicle.setLaneChangeMode(name, 0)
                self._move(api.vehicle, k, vehicle, PARKED_M[vehicle], 0.0)
        # A vehicle that is still pending after the first step ignores moveTo: all stand on the road before it.
        api.simulationStep()

    def _move(self, to: Any, k: int, vehicle: int, x: float, v: float) -> None:
        name = self._names[k][vehicle]
        to.moveTo(name, f"cell{k}_{RIGHT if vehicle == AV else LEFT}", x)
        to.setPreviousSpeed(name, v)
        to.setSpeed(name, v)

    def _contacts(self, get_collisions: Callable[[], Iterable[Any]]) -> BoolArray:
        """Cells with a collision in this step.

        SUMO's shorter list of colliding vehicles names a pair only when its collision is new. A pair that collided at
        the end of one episode and again in the first step of the next would be missed.
        """
        self._contact[:] = False
        for collision in get_collisions():
            self._contact[self._cell_of[collision.collider]] = True
        return self._contact


def network_file(n_cells: int) -> Path:
    """Smallest committed network with at least ``n_cells`` roads; a campaign asks for at most `MOST_SUMO_CELLS`."""
    return committed_file("highway-1.net.xml" if n_cells == 1 else f"highway-{MOST_SUMO_CELLS}.net.xml")


def committed_file(name: str) -> Path:
    """A file of ``sumo_networks/``, from the installed package or from the checkout."""
    path = (_INSTALLED if _INSTALLED.exists() else _CHECKOUT) / name
    if not path.exists():
        raise CampaignError(str(path), "no file", "the committed network", "Reinstall the harness from a checkout.")
    return path


def sumo_program(name: str) -> Path | None:
    """``sumo`` or ``sumo-gui`` of the extra ``harness[sumo]``, or None where it is not installed."""
    try:
        import sumo  # noqa: PLC0415 - an extra
    except ImportError:
        return None
    path = Path(str(sumo.SUMO_HOME)) / "bin" / name
    return path if path.exists() else None
