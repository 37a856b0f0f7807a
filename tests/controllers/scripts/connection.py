"""A labelled connection in the place of the module; subscriptions, also of a context; several episodes in a loop."""

import traci
from traci.constants import (
    CMD_GET_VEHICLE_VARIABLE,
    VAR_DEPARTED_VEHICLES_IDS,
    VAR_LANE_INDEX,
    VAR_LANEPOSITION,
    VAR_SPEED,
    VAR_TIME,
)

AROUND = [VAR_LANE_INDEX, VAR_LANEPOSITION, VAR_SPEED]

for episode in range(3):
    traci.start(["sumo"], port=8813 + episode, label=f"sim{episode}", numRetries=3)
    connection = traci.getConnection(f"sim{episode}")
    traci.switch(f"sim{episode}")
    connection.simulation.subscribe([VAR_DEPARTED_VEHICLES_IDS])
    connection.simulation.subscribe([VAR_TIME])
    while connection.simulation.getMinExpectedNumber() > 0:
        connection.simulationStep()
        if "ego" in connection.simulation.getSubscriptionResults()[VAR_DEPARTED_VEHICLES_IDS]:
            connection.vehicle.subscribeContext("ego", CMD_GET_VEHICLE_VARIABLE, 1000.0, AROUND, begin=0.0, end=100.0)
        around = connection.vehicle.getContextSubscriptionResults("ego")
        own = around.pop("ego")
        ahead = [
            (other[VAR_LANEPOSITION] - 5.0 - own[VAR_LANEPOSITION], other[VAR_SPEED])
            for other in around.values()
            if other[VAR_LANE_INDEX] == own[VAR_LANE_INDEX] and other[VAR_LANEPOSITION] >= own[VAR_LANEPOSITION]
        ]
        if ahead:
            gap, speed = min(ahead)
            connection.vehicle.setAcceleration("ego", -4.0 if 4.0 * (own[VAR_SPEED] - speed) > gap else 0.0, 0.1)
    connection.close()
