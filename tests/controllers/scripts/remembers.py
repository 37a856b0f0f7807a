"""State in globals, which every run has for itself: it fails at once where it sees another run's."""

import random

import traci

random.seed(3)
braked = []
step = 0


def control(name):
    global step
    step += 1
    assert abs(traci.simulation.getTime() - 0.1 * step) < 1e-6
    leader = traci.vehicle.getLeader(name)
    if leader is None:
        assert not braked
        return
    closing = traci.vehicle.getSpeed(name) - traci.vehicle.getSpeed(leader[0])
    braked.append(4.0 * closing > leader[1])
    traci.vehicle.setAcceleration(name, -4.0 if braked[-1] else 0.0, 0.1)


traci.start(["sumo"])
first = random.random()
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    for name in traci.vehicle.getIDList():
        if name == "ego":
            control(name)
assert first == 0.23796462709189137
traci.close()
