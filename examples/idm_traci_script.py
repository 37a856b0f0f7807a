"""The intelligent driver model as a whole TraCI script: `harness run examples/idm_traci_script.py`."""

import traci
from idm import idm_acceleration
from sumolib import checkBinary

EGO = "ego"


def drive() -> None:
    """Look ahead, accelerate for a step."""
    leader = traci.vehicle.getLeader(EGO)
    if leader is not None:
        name, gap = leader
        acceleration = idm_acceleration(traci.vehicle.getSpeed(EGO), traci.vehicle.getSpeed(name), gap)
        traci.vehicle.setAcceleration(EGO, acceleration, traci.simulation.getDeltaT())
    else:
        traci.vehicle.setSpeed(EGO, traci.vehicle.getAllowedSpeed(EGO))


def main() -> None:
    """Until nobody is left."""
    traci.start([checkBinary("sumo"), "-c", "highway.sumocfg", "--step-length", "0.1"])
    while traci.simulation.getMinExpectedNumber() > 0:
        traci.simulationStep()
        if EGO in traci.vehicle.getIDList():
            drive()
    traci.close()


if __name__ == "__main__":
    main()
