"""The usual way to drive SUMO: one episode at a time, its vehicles removed at the end and added again at the start.

What the harness is measured against, so it is done as well as this way allows. The simulation lives as long as the
campaign, vehicles are placed without a step to insert them, SUMO plans in every step (vanilla action step), every
position and speed is read after every step: by getters in libsumo, where they are faster than subscriptions, and by
subscriptions over TraCI, where a single answer to the step brings all values.
"""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import traci
from sumolib.miscutils import getFreeSocketPort

from harness.vocabulary import VEHICLES, BoolArray, FloatArray, Int8Array, IntArray
from harness.worlds import World
from harness.worlds.sumo import EXACT_OPTIONS, NETWORKS, as_shared, network_file

LEFT, RIGHT = 1, 0


def sumo_arguments() -> list[str]:
    """Network, vehicle types and options, the same as for the harness."""
    files = as_shared(network_file(1)), as_shared(NETWORKS / "vehicles.add.xml")
    return ["-n", str(files[0].path), "-a", str(files[1].path), *EXACT_OPTIONS]


class OneAtATime(World):
    """World of one cell over either API of SUMO."""

    def __init__(self, api: Any) -> None:
        super().__init__(1)
        self._api = api
        self._n_placed = 0
        self._names: list[str] = []
        api.route.add("cell0", ["cell0"])

    def place(
        self,
        cells: IntArray,  # noqa: ARG002 - there is one
        x: FloatArray,
        v: FloatArray,
        lane: Int8Array,
    ) -> None:
        """Remove the vehicles of the last episode, add new ones."""
        vehicle = self._api.vehicle
        for name in self._names:
            self._end_reading(name)
            vehicle.remove(name)
        self._names = [f"{name}{self._n_placed}" for name in VEHICLES]
        self._n_placed += 1
        for i, name in enumerate(self._names):
            vehicle.add(name, "cell0", typeID="vanilla")
            vehicle.setSpeedMode(name, 0)
            vehicle.setLaneChangeMode(name, 0)
            vehicle.moveTo(name, f"cell0_{lane[0, i]}", float(x[0, i]))
            vehicle.setPreviousSpeed(name, float(v[0, i]))
        self.lane[0] = lane[0]
        self._begin_reading()

    def step(self, speed: FloatArray, lane: Int8Array) -> BoolArray:
        """Tell three speeds, step, read everything."""
        vehicle = self._api.vehicle
        for i in np.flatnonzero(lane[0] != self.lane[0]).tolist():
            vehicle.changeLane(self._names[i], int(lane[0, i]), 0.0)
        self.lane[0] = lane[0]
        for name, wanted in zip(self._names, speed[0].tolist(), strict=True):
            vehicle.setSpeed(name, wanted)
        self._api.simulationStep()
        self._contact[0] = self._read()
        return self._contact

    def _begin_reading(self) -> None:
        """Ask for what will be read in every step."""

    def _end_reading(self, name: str) -> None:
        """A vehicle is about to be removed."""

    def _read(self) -> bool:
        """Positions and speeds into ``x`` and ``v``; whether vehicles collided."""
        vehicle = self._api.vehicle
        for i, name in enumerate(self._names):
            self.x[0, i], self.v[0, i] = vehicle.getLanePosition(name), vehicle.getSpeed(name)
        return bool(self._api.simulation.getCollidingVehiclesNumber() > 0)

    def close(self) -> None:
        """End the simulation."""
        self._api.close()


def in_libsumo() -> OneAtATime:
    """One episode at a time in this process."""
    libsumo.start(["sumo", *sumo_arguments()])
    return OneAtATime(libsumo)


class OverTraci(OneAtATime):
    """One episode at a time in a server process of SUMO, over a socket, with subscriptions."""

    def __init__(self, binary: Path) -> None:
        port = getFreeSocketPort()
        self._server = subprocess.Popen(
            [str(binary), *sumo_arguments(), "--remote-port", str(port)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        connection = traci.connect(port, numRetries=100, proc=self._server, waitBetweenRetries=0.05)
        self._variables: Sequence[int] = (traci.constants.VAR_LANEPOSITION, traci.constants.VAR_SPEED)
        self._colliding = traci.constants.VAR_COLLIDING_VEHICLES_NUMBER
        super().__init__(connection)
        connection.simulation.subscribe([self._colliding])

    def _begin_reading(self) -> None:
        for name in self._names:
            self._api.vehicle.subscribe(name, self._variables)

    def _end_reading(self, name: str) -> None:
        self._api.vehicle.unsubscribe(name)

    def _read(self) -> bool:
        position, speed = self._variables
        for i, name in enumerate(self._names):
            values = self._api.vehicle.getSubscriptionResults(name)
            self.x[0, i], self.v[0, i] = values[position], values[speed]
        return bool(self._api.simulation.getSubscriptionResults()[self._colliding] > 0)

    def close(self) -> None:
        """End the simulation and its server."""
        super().close()
        self._server.wait()
