"""A class that runs the simulation, with settings in a dataclass; subscriptions, by numbers of traci.constants."""

from __future__ import annotations

from dataclasses import dataclass, field

import traci
import traci.constants as tc


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
        name, _ = self.own[tc.VAR_LEADER]
        return self.own[tc.VAR_SPEED] - self.seen[name][tc.VAR_SPEED]

    def run(self):
        while traci.simulation.getMinExpectedNumber():
            traci.simulationStep()
            for name in traci.simulation.getDepartedIDList():
                traci.vehicle.subscribe(name, [tc.VAR_SPEED, tc.VAR_LANEPOSITION])
                if name == self.settings.ego:
                    traci.vehicle.subscribeLeader(name, dist=50.0, begin=0.0)
            self.seen = traci.vehicle.getAllSubscriptionResults()
            self.own = traci.vehicle.getSubscriptionResults(self.settings.ego)
            self.history.append(self.own)
            if self.own and self.own[tc.VAR_LEADER] is not None:
                brakes = self.settings.horizon_s * self.closing > self.own[tc.VAR_LEADER][1]
                traci.vehicle.setAcceleration(self.settings.ego, -4.0 if brakes else 0.0, 0.1)


with Simulation(Settings()) as simulation:
    simulation.run()
