"""What stands for the module ``traci`` in TraCI-style controllers: the vehicles of one cell, commands for the AV alone.

Names, units and answers are those of the ``traci`` package 1.28; docs/controllers.md lists every difference.
"""

from __future__ import annotations

import importlib
import math
from types import ModuleType

from harness.controllers.protocol import Observation
from harness.controllers.traci_vehicle import VEH_ID, Domain, FatalTraCIError, TraCIException, VehicleDomain
from harness.vehicles.kinematics import STEP_S

__all__ = ["VEH_ID", "TraCIException", "Traci"]


class SimulationDomain(Domain):
    """``traci.simulation`` of one cell: a crash ends the test, so that nobody has collided; nobody arrives."""

    _path = "traci.simulation"
    time_s = 0.0

    def getTime(self) -> float:
        """Time since the episode began (s)."""
        return self.time_s

    getDeltaT = staticmethod(lambda: STEP_S)
    getMinExpectedNumber = staticmethod(lambda: 3)
    getCollidingVehiclesNumber = staticmethod(lambda: 0)
    getCollidingVehiclesIDList = getCollisions = getArrivedIDList = staticmethod(tuple)


class Traci(Domain):
    """What stands for the module ``traci``: one episode of one cell."""

    TraCIException, FatalTraCIError = TraCIException, FatalTraCIError
    _path = "traci"

    def __init__(self, set_speed_mps: float = math.nan, lv_name: str = "LV", bv_name: str = "BV") -> None:
        self.vehicle, self.simulation = VehicleDomain(set_speed_mps, VEH_ID, lv_name, bv_name), SimulationDomain()
        self.exceptions = self  # so that ``traci.exceptions.TraCIException`` is found

    @property
    def constants(self) -> ModuleType:
        """Numbers to subscribe by."""
        return importlib.import_module("traci.constants")

    def see(self, now: Observation) -> None:
        """Take in what is there before a step."""
        self.simulation.time_s = now.time_s
        self.vehicle.see(now)

    def setLegacyGetLeader(self, enabled: bool) -> None:
        """Whether `getLeader` answers None (as 1.28 does by default) or ``("", -1.0)`` when nobody is ahead."""
        self.vehicle.legacy_leader = enabled
