"""The intelligent driver model as a TraCI script: `av: {controller: "examples.idm_traci_style:IDM"}`."""

from typing import Any

from examples.idm import idm_acceleration
from harness.controllers.traci_style import TraciStyleController


class IDM(TraciStyleController):
    """As it would be written after ``traci.simulationStep()``."""

    def on_step(self, traci: Any, veh_id: str, time: float) -> None:
        """Look ahead, accelerate for a step."""
        leader = traci.vehicle.getLeader(veh_id)
        if leader is not None:
            name, gap = leader
            acceleration = idm_acceleration(traci.vehicle.getSpeed(veh_id), traci.vehicle.getSpeed(name), gap)
            traci.vehicle.setAcceleration(veh_id, acceleration, traci.simulation.getDeltaT())
        else:
            traci.vehicle.setSpeed(veh_id, traci.vehicle.getAllowedSpeed(veh_id))


class Listener:
    """The same with the shape of SUMO's ``traci.StepListener``."""

    def __init__(self, traci: Any) -> None:
        self.traci = traci

    def step(self, t: float) -> bool:
        """True: stay."""
        IDM().on_step(self.traci, "AV", t)
        return True
