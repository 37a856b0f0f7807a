"""A labelled connection in the place of the module; several episodes in a loop."""

import traci

for episode in range(3):
    traci.start(["sumo"], port=8813 + episode, label=f"sim{episode}", numRetries=3)
    connection = traci.getConnection(f"sim{episode}")
    traci.switch(f"sim{episode}")
    while connection.simulation.getMinExpectedNumber() > 0:
        connection.simulationStep()
        try:
            leader = connection.vehicle.getLeader("ego")
        except traci.exceptions.TraCIException:
            continue
        if leader is not None:
            closing = connection.vehicle.getSpeed("ego") - connection.vehicle.getSpeed(leader[0])
            connection.vehicle.setAcceleration("ego", -4.0 if 4.0 * closing > leader[1] else 0.0, 0.1)
    connection.close()
