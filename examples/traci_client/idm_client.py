"""An automated vehicle as an ordinary TraCI client: the intelligent driver model for the AVs of all cells.

    python idm_client.py --port 8813 --cells 64

It needs nothing but the package ``traci``. SUMO has two clients: this program (order 1) and the harness (order 2). In
cell k stand AVk, which is ours, on lane 0, and the others of the scenario: LVk, and BVk, SVk or nobody. Once a BVk
is on lane 0 it has cut in; until then the harness holds our speed, whatever we command.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import time

import traci
import traci.constants as tc

STEP_S = 0.1
LENGTH_M = 5.0
ACCELERATION, COMFORTABLE_DECELERATION = 2.0, 3.0
TIME_HEADWAY_S, MINIMUM_GAP_M, DESIRED_SPEED = 1.0, 2.0, 40.0
HARDEST_BRAKING, SMALLEST_GAP_M = -4.0, 0.1


def idm(speed: float, lead_speed: float, gap: float) -> float:
    """Acceleration (m/s²) at a speed (m/s), behind a leader (m/s) at a bumper-to-bumper gap (m)."""
    gap = max(gap, SMALLEST_GAP_M)
    braking = 2.0 * math.sqrt(ACCELERATION * COMFORTABLE_DECELERATION)
    desired = MINIMUM_GAP_M + max(0.0, speed * TIME_HEADWAY_S + (speed * (speed - lead_speed)) / braking)
    ratio = speed / DESIRED_SPEED
    squared = ratio * ratio
    close = desired / gap
    a = ACCELERATION * (1.0 - squared * squared - close * close)
    return min(max(a, HARDEST_BRAKING), ACCELERATION)


def connect(port: int, seconds: float = 30.0) -> traci.connection.Connection:
    """SUMO may need a moment before it listens."""
    until = time.monotonic() + seconds
    while True:
        try:
            return traci.connection.Connection("127.0.0.1", port, None, None, False)
        except OSError:
            if time.monotonic() > until:
                raise
            time.sleep(0.05)


def drive(sumo: traci.connection.Connection, cells: int) -> None:
    """Step until the harness ends the simulation."""
    sumo.setOrder(1)
    sumo.simulationStep()  # the harness has put the vehicles on the road
    others: list[list[str]] = [[] for _ in range(cells)]
    for name in sumo.vehicle.getIDList():
        sumo.vehicle.subscribe(name, [tc.VAR_LANEPOSITION, tc.VAR_SPEED, tc.VAR_LANE_INDEX])
        if not name.startswith("AV"):
            others[int(name[2:])].append(name)
    while True:
        sumo.simulationStep()
        seen = sumo.vehicle.getAllSubscriptionResults()
        for k in range(cells):
            ahead = [seen[name] for name in others[k] if seen[name][tc.VAR_LANE_INDEX] == 0]
            if ahead:
                av, lead = seen[f"AV{k}"], min(ahead, key=lambda of: of[tc.VAR_LANEPOSITION])
                speed, gap = av[tc.VAR_SPEED], lead[tc.VAR_LANEPOSITION] - LENGTH_M - av[tc.VAR_LANEPOSITION]
                sumo.vehicle.setSpeed(f"AV{k}", max(speed + idm(speed, lead[tc.VAR_SPEED], gap) * STEP_S, 0.0))


def main() -> None:
    """Connect, and drive."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--cells", type=int, required=True)
    arguments = parser.parse_args()
    with contextlib.suppress(traci.exceptions.FatalTraCIError):  # at the end the harness closes the simulation
        drive(connect(arguments.port), arguments.cells)


if __name__ == "__main__":
    main()
