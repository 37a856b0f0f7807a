import libsumo

from parts.state import STATE


def step(name):
    assert STATE
    leader = libsumo.vehicle.getLeader(name) if libsumo.simulation.getMinExpectedNumber() else None
    if leader is not None:
        closing = libsumo.vehicle.getSpeed(name) - libsumo.vehicle.getSpeed(leader[0])
        libsumo.vehicle.setAcceleration(name, -4.0 if 4.0 * closing > leader[1] else 0.0, 0.1)
