"""Clients that misbehave, each in one way: `misbehaving_client.py FAULT --port P --cells K`."""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "examples/traci_client"))

import idm_client

FAULT_STEP = 60


def changes_lane(traci):
    for k in range(4):
        traci.vehicle.setActionStepLength(f"AV{k}", 0.1, True)
        traci.vehicle.changeLane(f"AV{k}", 1, 0.0)


FAULTS = {
    "exits": lambda traci: sys.exit(7),
    "hangs": lambda traci: time.sleep(600),
    "closes": lambda traci: (traci.close(), time.sleep(600)),
    "moves_bv": lambda traci: traci.vehicle.moveTo("BV1", "cell1_1", 500.0),
    "changes_lane": changes_lane,
    "stops_dead": lambda traci: traci.vehicle.setSpeed("AV0", 0.0),
    "removes_av": lambda traci: (traci.vehicle.remove("AV1"), [traci.simulationStep() for _ in range(9)]),
}


class Faulty:
    """A connection that does something wrong at step `FAULT_STEP`, or pushes a held AV in every one."""

    def __init__(self, connection, fault):
        self._connection, self._fault, self._step = connection, fault, 0

    def __getattr__(self, name):
        return getattr(self._connection, name)

    def simulationStep(self):
        self._step += 1
        if self._step == FAULT_STEP and self._fault in FAULTS:
            FAULTS[self._fault](self._connection)
        if self._fault == "pushes_held_avs" and self._step > 1:
            self._connection.vehicle.setSpeed("AV0", max(self._connection.vehicle.getSpeed("AV0") - 1.0, 3.0))
        return self._connection.simulationStep()


def main():
    fault, port, cells = sys.argv[1], int(sys.argv[3]), int(sys.argv[5])
    if fault == "never_connects":
        time.sleep(600)
    idm_client.drive(Faulty(idm_client.connect(port), fault), cells)


if __name__ == "__main__":
    main()
