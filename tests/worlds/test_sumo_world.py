"""What the SUMO world refuses, what it notices, and that it is used again without memory of what was."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable

import libsumo
import numpy as np
import pytest

from harness.errors import EXIT_TOO_MANY_FAILED, CampaignError, WorldDisagreementError
from harness.families.cut_in.vocabulary import STATE_DTYPE
from harness.loop.loop import EpisodeLoop, RecordPolicy, Shard
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vocabulary import BV, CONTACT, CRASH, LV, TIMEOUT, VEHICLES
from harness.worlds import sumo
from harness.worlds.sumo import open_shim, shim_library
from harness.worlds.twin import TwinWorld
from tests.episode.test_path import BESIDE, at_once, beside
from tests.worlds.running import smoke

X, V = (np.tile(values, (8, 1)) for values in ([300.0, 200.0, 100.0], [30.0, 28.0, 35.0]))
"""Positions and speeds of vehicles that do not meet."""
LANES = np.tile(np.array([1, 1, 0], np.int8), (8, 1))


@pytest.fixture
def driving(open_world) -> Callable:
    """Make a world of so many cells, all placed at X and V."""

    def make(n_cells: int, **options):
        world = open_world(n_cells, **options)
        world.place(np.arange(n_cells), X[:n_cells], V[:n_cells], LANES[:n_cells])
        return world

    return make


def drive(world, *, steps: int = 1) -> None:
    for _ in range(steps):
        world.step(V[: world.n_cells], LANES[: world.n_cells])


def test_a_second_simulation_is_refused_and_closing_twice_leaves_the_next_one_alone(open_world, driving):
    first = driving(2)
    with pytest.raises(CampaignError, match="already runs in this process"):
        open_world(2)
    drive(first)
    assert first.x[1, LV] == pytest.approx(303.0)
    first.close()
    second = driving(2)
    first.close()
    drive(second)


@pytest.mark.parametrize("shim", [True, False])
@pytest.mark.parametrize("victim", ["BV3", "AV7"])
def test_a_vehicle_one_unit_in_the_last_place_off_is_noticed_at_once(victim, shim, driving):
    world = driving(8, shim=shim)
    drive(world)
    lane = libsumo.vehicle.getLaneID(victim)
    libsumo.vehicle.moveTo(victim, lane, np.nextafter(libsumo.vehicle.getLanePosition(victim), 1e9))
    with pytest.raises(WorldDisagreementError, match=f"{victim}, m: found ") as raised:
        drive(world)
    assert raised.value.exit_code == EXIT_TOO_MANY_FAILED
    assert str(pickle.loads(pickle.dumps(raised.value))) == str(raised.value)  # as a worker sends it
    found, expected = raised.value.found, raised.value.expected.split(",")[0]
    assert float.fromhex(found) == np.nextafter(float.fromhex(expected), np.inf)


@pytest.mark.parametrize(("shim", "steps"), [(True, 1), (False, 10)])
@pytest.mark.parametrize("victim", ["LV1", "AV2"])
def test_a_speed_one_unit_in_the_last_place_off_is_noticed_within_ten_steps(victim, shim, steps, driving):
    """It does not show in a position of some 100 m: the shim compares speeds always, Python asks now and then."""
    if shim and shim_library() is None:
        pytest.skip("no compiled shim")
    world = driving(3, shim=shim)
    libsumo.vehicle.setSpeed(victim, np.nextafter(libsumo.vehicle.getSpeed(victim), 0.0))
    with pytest.raises(WorldDisagreementError, match=f"{victim}, m"):
        drive(world, steps=steps)


def place_and_cut_in(world) -> None:
    world.place(np.arange(4), X[:4] + 22.0, np.nextafter(V[:4], 0.0), LANES[:4])
    lanes = LANES[:4].copy()
    lanes[2, BV] = 0
    world.step(V[:4], lanes)


@pytest.mark.parametrize(
    ("command", "victim", "quantity"),
    [("setPreviousSpeed", "AV1", "m/s"), ("moveTo", "BV2", "m"), ("changeLane", "BV2", "lane")],
)
def test_a_command_to_one_vehicle_that_has_no_effect_is_noticed(command, victim, quantity, driving, monkeypatch):
    world, do = driving(4), getattr(libsumo.vehicle, command)
    monkeypatch.setattr(libsumo.vehicle, command, lambda name, *how: None if name == victim else do(name, *how))
    with pytest.raises(WorldDisagreementError, match=f"{victim}, {quantity}: "):
        place_and_cut_in(world)


class LyingTwin(TwinWorld):
    """Flags no collision, or one in cell 3 at its 20th step, when nobody touches anybody."""

    def __init__(self, n_cells, *, nervous):
        super().__init__(n_cells)
        self.steps, self.nervous = 0, nervous

    def step(self, speed, lane):
        self.steps += 1
        flag = super().step(speed, lane)
        return flag | ((self.steps == 20) & (np.arange(self.n_cells) == 3)) if self.nervous else flag & False


def run_in(world) -> Shard:
    prepared = prepare(resolve(smoke()))
    return EpisodeLoop(world, prepared.scenario, RecordPolicy("none", 0.0)).run(500, prepared.tests(500, 60))


def test_a_flag_that_the_positions_do_not_show_or_lack_stops_the_run_and_names_the_episode():
    run = run_in(TwinWorld(16)).episode
    crashes = {f"test {500 + row}, step {run['n_steps'][row]}" for row in np.flatnonzero(run["outcome"] == CRASH)}
    with pytest.raises(WorldDisagreementError, match="found no collision where the positions show one") as raised:
        run_in(LyingTwin(16, nervous=False))
    assert raised.value.where in crashes
    with pytest.raises(WorldDisagreementError, match="test 503, step 20: found a collision that the positions do"):
        run_in(LyingTwin(16, nervous=True))


def test_a_collision_in_the_first_step_of_a_refilled_cell_is_flagged(open_world):
    world = open_world(2)
    speed = np.tile([0.0, 30.0, 20.0], (2, 1))
    for _ in range(3):
        world.place(np.arange(2), np.tile([172.3, 166.0, 100.0], (2, 1)), speed, LANES[:2])
        assert world.step(speed, LANES[:2]).tolist() == [True, True]
    world.place(np.array([0]), X[:2], speed, LANES[:2])
    assert world.step(speed, LANES[:2]).tolist() == [False, True]


compiled_shim = pytest.mark.skipif(shim_library() is None, reason="no compiled shim")


@compiled_shim
def test_vehicles_that_are_gone_are_an_error_and_those_of_another_simulation_are_found_anew(driving):
    world, names = driving(2), [f"{vehicle}{k}" for k in range(2) for vehicle in VEHICLES]
    shim = open_shim(names, V[:2].copy(), X[:2] + 0.1 * V[:2], V[:2].copy())  # a second one for the same vehicles
    libsumo.vehicle.moveTo("LV0", "cell0_1", libsumo.lane.getLength("cell0_1") - 1.0)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="a vehicle has left the road"):
            shim.step(V[:2])
    with pytest.raises(RuntimeError, match="LV0"):
        shim.find_vehicles()
    world.load_again()
    world.place(np.arange(2), X[:2], V[:2], LANES[:2])
    drive(world, steps=3)
    assert world.x[0, 0] == libsumo.vehicle.getLanePosition("LV0") > 300.0


STATES = np.array(
    [
        (21.0, 0.3, -4.0, 30.0, -8.0),  # BV is over LV's rear when it has left the lane
        (21.0, 3.0, -4.0, 30.0, -8.0),  # in good time
        (21.0, 30.0, 0.0, 0.5, -8.0),  # in front of the AV's bumper
        (21.0, 0.3, -4.0, 0.5, -8.0),  # both at once
    ],
    STATE_DTYPE,
)
OUTCOMES = [CONTACT, TIMEOUT, CRASH, CONTACT]


def loop_in(world, model: str) -> EpisodeLoop:
    resolved = resolve(smoke("testing.method=shells", f"av={{model: {model}}}"))
    return EpisodeLoop(world, resolved.scenario, RecordPolicy("all", 0.0))


def run(world) -> Shard:
    return loop_in(world, "idm").run(0, at_once(STATES))


@pytest.mark.parametrize("shim", [True, False])
@pytest.mark.parametrize("n_cells", [1, 64])
def test_sumo_agrees_also_with_cells_that_stay_empty(open_world, n_cells, shim):
    twin, sumo = run(TwinWorld(4)), run(open_world(n_cells, shim=shim))
    assert twin.episode["outcome"].tolist() == OUTCOMES
    assert twin.episode["n_steps"].tolist() == [1, 200, 1, 1]
    assert twin.episode.tobytes() == sumo.episode.tobytes()
    for row, trace in twin.traces.items():
        assert np.array_equal(trace, sumo.traces[row], equal_nan=True)


def test_sumo_flags_vehicles_beside_each_other_by_the_rule_of_the_first_overlap(open_world):
    """Around -0.001 and -9.999 m: the loop stops where SUMO's own flag says something else than the positions."""
    traffic = beside([r2_m for r2_m, _ in BESIDE])
    episode = {}
    for name, world in (("twin", TwinWorld(4)), ("sumo", open_world(4))):
        episode[name] = loop_in(world, "constant").run(0, traffic).episode
    assert episode["sumo"].tobytes() == episode["twin"].tobytes()
    for row, (_, outcome) in zip(episode["sumo"], BESIDE, strict=True):
        assert (row["n_steps"] > 1) if outcome is None else (row["outcome"], row["n_steps"]) == (outcome, 1)


def test_sumo_reads_its_files_from_an_installation_in_a_folder_of_any_name(driving, tmp_path, monkeypatch):
    folder = tmp_path / "a,b ${HOME}"
    shutil.copytree(sumo.NETWORKS, folder)
    monkeypatch.setattr(sumo, "NETWORKS", folder)
    drive(driving(2))
