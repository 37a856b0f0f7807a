"""Run as `with_main.py:main`."""

import typing

import traci


class Ahead(typing.NamedTuple):
    name: str
    gap: float


def main(ego: str = "vehicle.1", hardest: float = 4.0) -> None:
    traci.start(["sumo-gui", "-c", "highway.sumocfg", "--start"])
    traci.gui.trackVehicle("View #0", ego)
    traci.vehicle.setColor(ego, (255, 0, 0))
    traci.vehicle.highlight(ego)
    assert traci.vehicle.getDistance(ego) == traci.vehicle.getLanePosition(ego)
    while traci.simulation.getMinExpectedNumber() > 0:
        traci.simulationStep()
        if (leader := traci.vehicle.getLeader(ego)) is not None:
            ahead = Ahead(*leader)
            closing = traci.vehicle.getSpeed(ego) - traci.vehicle.getSpeed(ahead.name)
            traci.vehicle.setAcceleration(ego, -hardest if 4.0 * closing > ahead.gap else 0.0, 0.1)
    traci.close()
