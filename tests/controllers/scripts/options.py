"""Options, a configuration that is not there, libsumo, a fixed time, and a look whether the vehicle has departed."""

import argparse
import contextlib

import libsumo as traci


def main(arguments):
    traci.start(["sumo", "-c", arguments.config, "--step-length", "0.1", "--seed", str(arguments.seed)])
    traci.simulationStep()
    while arguments.ego not in traci.vehicle.getIDList():
        traci.simulationStep()
    traci.vehicle.setSpeedMode(arguments.ego, 0)
    with contextlib.suppress(traci.FatalTraCIError, traci.TraCIException):
        while traci.simulation.getTime() < arguments.end:
            leader = traci.vehicle.getLeader(arguments.ego)
            if leader is not None:
                closing = traci.vehicle.getSpeed(arguments.ego) - traci.vehicle.getSpeed(leader[0])
                braking = arguments.horizon * closing > leader[1]
                asked = -arguments.hardest if braking else 0.0
                traci.vehicle.setAcceleration(arguments.ego, asked, traci.simulation.getDeltaT())
            traci.simulationStep()
    traci.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", default="nowhere.sumocfg")
    parser.add_argument("--ego", default="av_0")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--end", type=float, default=3600.0)
    parser.add_argument("--horizon", type=float, default=4.0)
    parser.add_argument("--hardest", type=float, default=4.0)
    main(parser.parse_args())
