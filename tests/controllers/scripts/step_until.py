"""Steps to times, with the leader subscribed to."""

import traci
import traci.constants as tc

traci.start(["sumo", "-c", "highway.sumocfg"])
time = 0.0
while traci.simulation.getMinExpectedNumber() > 0:
    time += traci.simulation.getDeltaT()
    traci.simulationStep(time)
    if not traci.vehicle.getSubscriptionResults("ego"):
        if traci.vehicle.getIDCount() == 0:
            break
        traci.vehicle.subscribe("ego", [tc.VAR_SPEED])
        traci.vehicle.subscribeLeader("ego")
    seen = traci.vehicle.getSubscriptionResults("ego")
    if seen[tc.VAR_LEADER] is not None:
        name, gap = seen[tc.VAR_LEADER]
        closing = seen[tc.VAR_SPEED] - traci.vehicle.getSpeed(name)
        traci.vehicle.setAcceleration("ego", -4.0 if 4.0 * closing > gap else 0.0, 0.1)
traci.close()
