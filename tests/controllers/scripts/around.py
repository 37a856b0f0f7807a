"""A context subscription; the leader is looked for among the vehicles around."""

import traci
from traci.constants import CMD_GET_VEHICLE_VARIABLE, VAR_LANE_INDEX, VAR_LANEPOSITION, VAR_SPEED

traci.start(["sumo"])
traci.vehicle.subscribeContext("ego", CMD_GET_VEHICLE_VARIABLE, 1000.0, [VAR_LANE_INDEX, VAR_LANEPOSITION, VAR_SPEED])
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    around = traci.vehicle.getContextSubscriptionResults("ego")
    own = around["ego"]
    here = own[VAR_LANEPOSITION]
    ahead = [
        (other[VAR_LANEPOSITION] - 5.0 - here, other[VAR_SPEED])
        for name, other in around.items()
        if name != "ego" and other[VAR_LANE_INDEX] == own[VAR_LANE_INDEX] and other[VAR_LANEPOSITION] >= here
    ]
    if ahead:
        gap, speed = min(ahead)
        traci.vehicle.setAcceleration("ego", -4.0 if 4.0 * (own[VAR_SPEED] - speed) > gap else 0.0, 0.1)
traci.close()
