"""Names of the module in the script's own, a server that is joined, steps by their time."""

every = importing = step = "the script's own"
from traci import *
from traci.exceptions import FatalTraCIError, TraCIException

assert every is importing is step
assert issubclass(StepListener, object)
init(8813, label="a")
setOrder(1)
route.add("straight", ["in", "out"])
vehicle.add("ego", "straight", typeID="av", departSpeed="25")
try:
    for step in range(1, 5000):
        simulationStep(0.1 * step)
        assert abs(simulation.getTime() - 0.1 * step) < 1e-6
        leader = vehicle.getLeader("ego")
        if leader is not None:
            closing = vehicle.getSpeed("ego") - vehicle.getSpeed(leader[0])
            vehicle.setAcceleration("ego", -4.0 if 4.0 * closing > leader[1] else 0.0, 0.1)
except (FatalTraCIError, TraCIException):
    print("the simulation has ended")
finally:
    close()
