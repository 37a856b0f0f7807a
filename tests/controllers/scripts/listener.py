"""A step listener does it all."""

import traci


class Controller(traci.StepListener):
    def __init__(self, name):
        self.name = name

    def step(self, t=0):
        if self.name not in traci.vehicle.getIDList():
            return True
        leader = traci.vehicle.getLeader(self.name)
        if leader is not None:
            closing = traci.vehicle.getSpeed(self.name) - traci.vehicle.getSpeed(leader[0])
            traci.vehicle.setAcceleration(self.name, -4.0 if 4.0 * closing > leader[1] else 0.0, 0.1)
        return True


class Once(traci.StepListener):
    def step(self, t=0):
        return False


traci.start(["sumo"])
traci.addStepListener(Once())
traci.addStepListener(Controller("ego"))
for _ in range(10_000):
    traci.simulationStep()
traci.close()
