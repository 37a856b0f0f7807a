"""Subscriptions, by numbers of traci.constants."""

import traci
import traci.constants as tc

SPEED = tc.VAR_SPEED

traci.start(["sumo"])
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    for name in traci.simulation.getDepartedIDList():
        traci.vehicle.subscribe(name, [SPEED, tc.VAR_LANEPOSITION])
        if name == "ego":
            traci.vehicle.subscribe(name, (SPEED, tc.VAR_LEADER))
    seen = traci.vehicle.getAllSubscriptionResults()
    own = traci.vehicle.getSubscriptionResults("ego")
    if own and own[tc.VAR_LEADER] is not None:
        name, gap = own[tc.VAR_LEADER]
        traci.vehicle.setAcceleration("ego", -4.0 if 4.0 * (own[SPEED] - seen[name][SPEED]) > gap else 0.0, 0.1)
traci.close()
