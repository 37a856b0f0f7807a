"""A class that runs the simulation, with settings in a dataclass."""

from __future__ import annotations

from dataclasses import dataclass, field

import traci


@dataclass
class Settings:
    ego: str = "ego"
    horizon_s: float = 4.0
    binary: list[str] = field(default_factory=lambda: ["sumo", "--no-step-log"])


class Simulation:
    def __init__(self, settings: Settings) -> None:
        self.settings, self.history = settings, []

    def __enter__(self):
        traci.start(self.settings.binary)
        return self

    def __exit__(self, *_):
        traci.close(False)

    @property
    def closing(self):
        name, _ = self.leader
        return traci.vehicle.getSpeed(self.settings.ego) - traci.vehicle.getSpeed(name)

    def run(self):
        while traci.simulation.getMinExpectedNumber():
            traci.simulationStep()
            self.leader = traci.vehicle.getLeader(self.settings.ego)
            self.history.append(self.leader)
            if self.leader is not None:
                brakes = self.settings.horizon_s * self.closing > self.leader[1]
                traci.vehicle.setAcceleration(self.settings.ego, -4.0 if brakes else 0.0, 0.1)


with Simulation(Settings()) as simulation:
    simulation.run()
