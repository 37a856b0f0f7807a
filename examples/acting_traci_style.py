"""A TraCI script that acts before the cut-in: `av: {controller: "examples.acting_traci_style:Speeds", ...}`."""

from typing import Any

from examples.idm import idm_acceleration
from harness.controllers.traci_style import TraciStyleController


class Speeds(TraciStyleController):
    """Speeds up by 0.8 m/s² to 38 m/s on a free lane; the intelligent driver model behind a leader."""

    def on_step(self, traci: Any, veh_id: str, time: float) -> None:
        """Look ahead, accelerate for a step."""
        speed, leader = traci.vehicle.getSpeed(veh_id), traci.vehicle.getLeader(veh_id)
        acceleration = 0.8 if speed < 38.0 else 0.0
        if leader is not None:
            name, gap = leader
            acceleration = idm_acceleration(speed, traci.vehicle.getSpeed(name), gap)
        traci.vehicle.setAcceleration(veh_id, acceleration, traci.simulation.getDeltaT())
