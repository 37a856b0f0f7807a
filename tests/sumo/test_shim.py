"""The compiled shim is used where it is built, compares all values in every step, and never reads what SUMO deleted."""

import libsumo
import numpy as np
import pytest

from harness.errors import WorldDisagreementError
from harness.sumo.shim import shim_library

pytestmark = pytest.mark.skipif(shim_library() is None, reason="no compiled shim")

NOBODY = np.zeros(2, np.int8)


@pytest.fixture
def moving(open_world):
    """A world of two cells whose vehicles drive, and their speeds (2, 3)."""
    world, v = open_world(2), np.tile([30.0, 28.0, 35.0], (2, 1))
    world.place(np.arange(2), np.tile([300.0, 200.0, 100.0], (2, 1)), v)
    return world, v


def test_where_it_is_built_it_is_used(moving):
    world, v = moving
    world.step(v, NOBODY)
    assert world._shim.position.tolist() == [libsumo.vehicle.getLanePosition(name) for name in world._flat]
    assert world._shim.speed.tolist() == [libsumo.vehicle.getSpeed(name) for name in world._flat] == v.ravel().tolist()


def test_without_it_the_world_does_without(open_world, monkeypatch):
    monkeypatch.setenv("HARNESS_SHIM", "0")
    assert open_world(2)._shim is None


def test_it_answers_whether_everything_is_as_wanted(moving):
    world, v = moving
    shim, x = world._shim, world.x + 0.1 * v
    assert shim.step(v, world._told, x, v)
    assert not shim.step(v, world._told, x, v)  # they have driven on
    x = shim.position.reshape(2, 3) + 0.1 * v
    assert not shim.step(v, world._told, x, np.nextafter(v, 0.0))
    assert shim.position.tolist() == x.ravel().tolist()


@pytest.mark.parametrize("victim", ["LV0", "BV1", "AV1"])
def test_a_speed_one_unit_in_the_last_place_off_is_noticed_at_once(victim, moving):
    world, v = moving
    libsumo.vehicle.setSpeed(victim, np.nextafter(libsumo.vehicle.getSpeed(victim), 0.0))
    with pytest.raises(WorldDisagreementError, match=f"{victim}, m/s"):
        world.step(v, NOBODY)


def test_a_speed_below_zero_gives_the_vehicle_back_to_sumo(moving):
    """As with setSpeed itself: the AV, told nothing any more, drives its own speed."""
    world, v = moving
    wanted = v.copy()
    wanted[0, 2] = -1.0
    world._shim.step(wanted, world._told, world.x, v)
    assert world._told[0, 2] == -1.0
    assert world._shim.speed[2] != v[0, 2]
    libsumo.vehicle.setSpeed("AV1", -1.0)
    libsumo.vehicle.setPreviousSpeed("AV0", 35.0)
    libsumo.vehicle.setPreviousSpeed("AV1", 35.0)
    for name in ("AV0", "AV1"):
        libsumo.vehicle.setActionStepLength(name, 0.1, True)
    libsumo.simulationStep()
    assert libsumo.vehicle.getSpeed("AV0") == libsumo.vehicle.getSpeed("AV1") != 35.0


def test_a_vehicle_that_leaves_the_road_is_an_error_and_stays_one(moving):
    world, v = moving
    length = libsumo.lane.getLength("cell0_1")
    libsumo.vehicle.moveTo("LV0", "cell0_1", length - 1.0)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="a vehicle has left the road"):
            world._shim.step(v, world._told, world.x, world.v)


def test_vehicles_of_another_simulation_are_found_anew(moving):
    world, v = moving
    libsumo.load(world._arguments())
    world._populate()
    world._told[:] = 0.0
    world.place(np.arange(2), np.tile([300.0, 200.0, 100.0], (2, 1)), v)
    for _ in range(3):
        world.step(v, NOBODY)
    assert world._shim.position[0] == libsumo.vehicle.getLanePosition("LV0") > 300.0


def test_a_vehicle_that_does_not_exist_is_an_error(moving):
    world, _ = moving
    libsumo.vehicle.remove("BV1")
    with pytest.raises(RuntimeError, match="BV1"):
        world._shim.find_vehicles()
