"""Until TraCI ends it; nobody ahead is an empty name."""

import traci
from traci.exceptions import FatalTraCIError

traci.start(["sumo", "-c", "highway.sumocfg"])
traci.setLegacyGetLeader(False)
try:
    while True:
        traci.simulationStep()
        if "ego" not in traci.vehicle.getIDList():
            continue
        name, gap = traci.vehicle.getLeader("ego")
        if name:
            closing = traci.vehicle.getSpeed("ego") - traci.vehicle.getSpeed(name)
            traci.vehicle.setAcceleration("ego", -4.0 if 4.0 * closing > gap else 0.0, 0.1)
except FatalTraCIError:
    pass
