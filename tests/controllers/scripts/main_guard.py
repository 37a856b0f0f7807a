"""As SUMO's tutorials begin."""

import os
import sys
from optparse import OptionParser

if "SUMO_HOME" in os.environ:
    sys.path.append(os.path.join(os.environ["SUMO_HOME"], "tools"))
else:
    sys.exit("please declare environment variable 'SUMO_HOME'")

import traci
from sumolib import checkBinary


def get_options():
    parser = OptionParser()
    parser.add_option("--nogui", action="store_true", default=False)
    options, _ = parser.parse_args()
    return options


def run():
    step = 0
    while traci.simulation.getMinExpectedNumber() > 0:
        traci.simulationStep()
        if "ego" in traci.vehicle.getIDList():
            control()
        step += 1
    traci.close()
    sys.stdout.flush()


def control():
    leader = traci.vehicle.getLeader("ego", 150)
    if leader:
        closing = traci.vehicle.getSpeed("ego") - traci.vehicle.getSpeed(leader[0])
        traci.vehicle.setAcceleration("ego", -4.0 if 4.0 * closing > leader[1] else 0.0, 0.1)


if __name__ == "__main__":
    binary = checkBinary("sumo" if get_options().nogui else "sumo-gui")
    traci.start([binary, "-c", "data/cross.sumocfg", "--tripinfo-output", "tripinfo.xml"], port=8873)
    run()
    sys.exit()
