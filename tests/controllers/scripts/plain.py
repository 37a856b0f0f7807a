"""From top to bottom."""

import traci

traci.start(["sumo", "-c", "highway.sumocfg"])
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    leader = traci.vehicle.getLeader("ego")
    if leader is not None:
        closing = traci.vehicle.getSpeed("ego") - traci.vehicle.getSpeed(leader[0])
        traci.vehicle.setAcceleration("ego", -4.0 if 4.0 * closing > leader[1] else 0.0, 0.1)
traci.close()
