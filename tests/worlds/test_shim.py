"""The compiled shim is used where it is built, compares all values in every step, and never reads what SUMO deleted."""

import libsumo
import numpy as np
import pytest

from harness.worlds.shim import Shim, open_shim, shim_library

pytestmark = pytest.mark.skipif(shim_library() is None, reason="no compiled shim")

NOBODY = np.zeros(2, np.int8)
NAMES = [f"{vehicle}{k}" for k in range(2) for vehicle in ("LV", "BV", "AV")]
X, V = np.tile([300.0, 200.0, 100.0], (2, 1)), np.tile([30.0, 28.0, 35.0], (2, 1))


@pytest.fixture
def world(open_world):
    """Two cells whose vehicles drive at speeds V."""
    world = open_world(2)
    world.place(np.arange(2), X, V)
    return world


@pytest.fixture
def shim(world):
    """A second shim for the same vehicles, with arrays of its own: those wanted are one step on, at unchanged speed."""
    shim = open_shim(NAMES, V.copy(), X + 0.1 * V, V.copy())
    yield shim
    shim.close()


def read(getter):
    return [getter(name) for name in NAMES]


@pytest.mark.parametrize(("switch", "used"), [("1", True), ("0", False)])
def test_where_it_is_built_it_is_used_unless_it_is_switched_off(switch, used, open_world, monkeypatch):
    steps, step = [], Shim.step
    monkeypatch.setattr(Shim, "step", lambda shim, wanted: steps.append(wanted) or step(shim, wanted))
    monkeypatch.setenv("HARNESS_SHIM", switch)
    world = open_world(2)
    world.place(np.arange(2), X, V)
    world.step(V, NOBODY)
    assert len(steps) == used


def test_it_answers_whether_everything_is_as_wanted(shim):
    x, v, position, speed = shim.x, shim.v, shim.position, shim.speed
    assert shim.step(V)
    assert position.tolist() == x.ravel().tolist() == read(libsumo.vehicle.getLanePosition)
    assert speed.tolist() == v.ravel().tolist() == read(libsumo.vehicle.getSpeed)
    assert not shim.step(V)  # they have driven on
    x[:] = position.reshape(2, 3) + 0.1 * V
    v[:] = np.nextafter(V, 0.0)
    assert not shim.step(V)
    assert position.tolist() == x.ravel().tolist()


def test_a_vehicle_that_leaves_the_road_is_an_error_and_stays_one(shim):
    libsumo.vehicle.moveTo("LV0", "cell0_1", libsumo.lane.getLength("cell0_1") - 1.0)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="a vehicle has left the road"):
            shim.step(V)


def test_vehicles_of_another_simulation_are_found_anew(world):
    world.load_again()
    world.place(np.arange(2), X, V)
    for _ in range(3):
        world.step(V, NOBODY)
    assert world.x[0, 0] == libsumo.vehicle.getLanePosition("LV0") > 300.0


def test_a_vehicle_that_does_not_exist_is_an_error(shim):
    libsumo.vehicle.remove("BV1")
    with pytest.raises(RuntimeError, match="BV1"):
        shim.find_vehicles()
