"""K roads in a SUMO, each with LV, BV and AV: how they are placed, and who touched whom."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from harness.arrays import BoolArray, FloatArray
from harness.outcomes import AV, BV, LV, VEHICLES
from harness.sumo.network import EXACT_OPTIONS, LEFT, OBEY, PARKED_M, RIGHT, committed_file, network_file


class SumoCells:
    """K roads in a SUMO, each with LV, BV and AV.

    ``x``, ``v`` (K, 3) are as of `harness.world.World`.
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
