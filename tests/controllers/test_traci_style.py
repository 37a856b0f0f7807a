"""The facade answers as TraCI 1.28 does (numbers below were read from a SUMO), and commands only the AV."""

from contextlib import suppress
from operator import attrgetter

import numpy as np
import pytest

from harness.controllers import traci_vehicle
from harness.controllers.protocol import EpisodeStart, Neighbour, Observation
from harness.controllers.traci_style import Traci, TraciStyleController


def seen(time_s=0.0, speed=20.0, *lateral, bv_lane=0, lead_speed=20.0):
    ahead = (195.0, lead_speed) if bv_lane == 0 else (float("inf"), float("nan"))
    bv, lv = Neighbour(300.0, lead_speed, bv_lane), Neighbour(400.0, 20.0, 1)
    return Observation(time_s, 100.0, speed, 0.0, *ahead, bv, lv, *lateral)


@pytest.fixture
def traci():
    made = Traci()
    made.see(seen())
    return made


def drive(traci, n, speed):
    """Speeds of the AV over the coming steps."""
    speeds = []
    for i in range(n):
        speed += 0.1 * traci.vehicle.next_acceleration()
        speeds.append(round(speed, 9))
        traci.see(seen(0.1 * (i + 1), speed))
    return speeds


def test_readings(traci):
    vehicle = traci.vehicle
    assert vehicle.getIDList() == ("LV", "BV", "AV")
    assert vehicle.getLeader("AV", 0) == ("BV", 195.0)
    assert (vehicle.getLeader("BV"), vehicle.getFollower("AV")) == (None, ("", -1.0))
    assert vehicle.getFollower("BV") == ("AV", 195.0)
    assert vehicle.getPosition("LV") == (400.0, 1.6)
    assert (vehicle.getPosition("AV"), vehicle.getLanePosition("AV")) == ((100.0, -1.6), 100.0)
    assert (vehicle.getLaneID("BV"), vehicle.getRoadID("BV"), vehicle.getAngle("BV")) == ("cell0_0", "cell0", 90.0)
    assert (vehicle.getLength("AV"), vehicle.getMinGap("AV")) == (5.0, 0.0)
    assert (vehicle.getWidth("LV"), vehicle.getVehicleClass("BV")) == (1.8, "passenger")
    assert (traci.simulation.getTime(), traci.simulation.getDeltaT()) == (0.0, 0.1)
    assert vehicle.getAcceleration("BV") == 0.0
    traci.see(seen(0.1, lead_speed=19.8))  # accelerations of traffic are differences of speeds
    assert (vehicle.getAcceleration("BV"), vehicle.getAcceleration("LV")) == (pytest.approx(-2.0), 0.0)


def test_a_bv_that_comes_over_is_on_the_right_of_its_lane_until_it_is_on_the_other(traci):
    vehicle = traci.vehicle
    traci.see(seen(0.0, 20.0, 0.5, 0.7, bv_lane=1))
    assert (vehicle.getLateralLanePosition("BV"), vehicle.getLateralSpeed("BV")) == (-0.5, -0.7)
    assert (vehicle.getPosition("BV"), vehicle.getLaneIndex("BV")) == ((300.0, pytest.approx(1.1)), 1)
    assert (vehicle.getLateralLanePosition("AV"), vehicle.getLateralSpeed("LV")) == (0.0, 0.0)
    assert (vehicle.getLeader("AV"), vehicle.getLeader("BV")) == (None, ("LV", 95.0))
    traci.setLegacyGetLeader(False)
    assert vehicle.getLeader("AV") == ("", -1.0)
    traci.see(seen(0.1, 20.0, 1.7, 0.0, True))
    assert (vehicle.getLateralLanePosition("BV"), vehicle.getPosition("BV")) == (0.0, (300.0, -1.6))


@pytest.mark.parametrize(
    ("commands", "speeds"),
    [
        ([("slowDown", 18.0, 0.5)], [19.6, 19.2, 18.8, 18.4, 18.0, 18.0]),
        ([("slowDown", 15.0, 0.25)], [18.0, 16.0, 15.0, 15.0]),
        ([("setAcceleration", -2.0, 0.3)], [19.8, 19.6, 19.4, 19.4]),
        ([("setAcceleration", -2.0, 0.25)], [19.8, 19.6, 19.5, 19.5]),
        ([("setSpeed", 19.0)], [19.0, 19.0, 19.0]),
        ([("setDecel", 4.5), ("setSpeed", 0.0)], [19.55, 19.1, 18.65]),
        ([("setAcceleration", -4.0, 10.0)], [19.8, 19.6, 19.4]),
        ([("setDecel", 4.5), ("slowDown", 18.0, 0.2)], [19.55, 19.1, 18.65, 18.65]),
        ([("setDecel", 4.5), ("setAcceleration", -10.0, 0.2)], [19.55, 19.1, 18.65, 18.65]),
    ],
)
def test_commands_lead_to_the_speeds_of_sumo(traci, commands, speeds):
    for name, *arguments in commands:
        getattr(traci.vehicle, name)("AV", *arguments)
    assert drive(traci, len(speeds), 20.0) == speeds
    traci.vehicle.setSpeed("AV", -1)  # releases it
    assert drive(traci, 2, speeds[-1]) == [speeds[-1]] * 2


def test_questions_about_neighbours_and_subscriptions_are_answered_as_sumo_does(traci):
    vehicle, constants = traci.vehicle, traci.constants
    assert (vehicle.getLeftLeaders("AV"), vehicle.getRightFollowers("LV")) == ((("LV", 295.0),), (("BV", 95.0),))
    assert (vehicle.getLeftFollowers("AV"), vehicle.getRightLeaders("BV")) == ((), ())
    assert vehicle.getNeighbors("AV", 2) == (("LV", 295.0),)
    vehicle.subscribe("AV")
    for number in (constants.VAR_SPEED, constants.VAR_LANE_INDEX):  # one beside the other
        vehicle.subscribe("BV", [number])
        vehicle.subscribeContext("AV", constants.CMD_GET_VEHICLE_VARIABLE, 250.0, [number])
    vehicle.subscribeContext("AV", constants.CMD_GET_VEHICLE_VARIABLE, 500.0, [constants.VAR_LANE_INDEX])
    assert vehicle.getSubscriptionResults("AV") == {constants.VAR_ROAD_ID: "cell0", constants.VAR_LANEPOSITION: 100.0}
    traci.see(seen(0.1, lead_speed=19.0))
    assert vehicle.getAllSubscriptionResults()["BV"] == {constants.VAR_SPEED: 19.0, constants.VAR_LANE_INDEX: 0}
    assert vehicle.getSubscriptionResults("LV") == {}
    around = vehicle.getContextSubscriptionResults("AV")
    assert (around["BV"], around["LV"]) == (vehicle.getSubscriptionResults("BV"), {constants.VAR_LANE_INDEX: 1})
    with pytest.raises(traci.TraCIException, match="Variable 0x60 of vehicles is not known here"):
        vehicle.subscribe("AV", [constants.VAR_CO2EMISSION])
    for number in traci_vehicle._VARIABLES:
        vehicle.unsubscribe("AV")
        vehicle.subscribe("AV", [number])
        assert list(vehicle.getSubscriptionResults("AV")) == [number]
    assert traci.simulation.getCollidingVehiclesIDList() == traci.simulation.getCollisions() == ()
    assert traci.simulation.getMinExpectedNumber() == 3


@pytest.mark.parametrize(
    ("command", "answer"),
    [(("slowDown", 17.0, 10.0), -0.3), (("setAcceleration", -1.0, 3.0), -1.0), (("setAcceleration", -1.0, 0.1), 0.0)],
)
def test_a_command_that_the_av_does_not_follow_waits_until_it_does(traci, command, answer):
    """In the warm-up it keeps its speed: nothing is owed then; what was for one step is over."""
    name, *arguments = command
    getattr(traci.vehicle, name)("AV", *arguments)
    for step in range(1, 21):
        traci.vehicle.next_acceleration()
        traci.see(seen(0.1 * step))
    n = round(arguments[1] / 0.1)
    speeds = drive(traci, n + 1, 20.0)
    assert speeds == pytest.approx([20.0 + 0.1 * answer * min(i + 1, n) for i in range(n + 1)])


NAN, INFINITE, RATIOS, UNKNOWN = float("nan"), float("inf"), "the crash rate would be wrong", "'AV7' is not known"
COMMANDS = {"setSpeed": (3.0,), "setAcceleration": (1.0, 1.0), "slowDown": (1.0, 1.0), "setDecel": (1.0,)}
MOVES = ("moveTo", "changeLane", "remove", "setRoute")
IMPOSSIBLE = {
    "slowDown": [(-1.0, 1.0), (1.0, -1.0), (1.0, NAN), (1.0, INFINITE)],
    "setAcceleration": [(1.0, -1.0), (NAN, 1.0), (1.0, NAN), (-1.0, INFINITE)],
}
REFUSED = [
    *(
        (f"{name}.*{of}.*{RATIOS}", f"vehicle.{name}", of, *rest)
        for name, rest in COMMANDS.items()
        for of in ("LV", "BV")
    ),
    *((f"stays on its lane|no model of SUMO|{RATIOS}", f"vehicle.{name}", "AV", 1, 2) for name in MOVES),
    *(("the harness itself", name) for name in ("simulationStep", "close")),
    *(("is no command", f"vehicle.{name}", "AV", bound) for name in ("setAccel", "setDecel") for bound in (NAN, -3.0)),
    ("blockingOnly is refused", "vehicle.getLeftLeaders", "AV", True),
    ("refused before setDecel", "vehicle.getDecel", "AV"),
    ("as under speed mode 32", "vehicle.setSpeedMode", "AV", 7),
    ("stays on its lane", "vehicle.setLaneChangeMode", "AV", 1621),
    ("bumper to bumper", "vehicle.setMinGap", "AV", 2.5),
    (f"setColor.*BV.*{RATIOS}", "vehicle.setColor", "BV", (255, 0, 0)),
    (UNKNOWN, "vehicle.getSpeed", "AV7"),
    (UNKNOWN, "vehicle.setSpeed", "AV7", 1.0),
    *(("is no command", f"vehicle.{name}", "AV", *rest) for name, cases in IMPOSSIBLE.items() for rest in cases),
]


@pytest.mark.parametrize(("reason", "name", "arguments"), [(reason, name, rest) for reason, name, *rest in REFUSED])
def test_what_is_not_the_avs_or_not_possible_is_refused(traci, reason, name, arguments):
    with pytest.raises(traci.exceptions.TraCIException, match=reason):
        attrgetter(name)(traci)(*arguments)
    assert traci.vehicle.next_acceleration() == 0.0


def test_a_misspelt_command_is_not_taken_for_one_of_tracis_that_is_refused(traci):
    with pytest.raises(AttributeError, match="has no setAccelerations here"):
        traci.vehicle.setAccelerations("AV", 1.0, 1.0)


def start(episode=0):
    return EpisodeStart(episode, 0.1, np.random.default_rng(episode))


def test_an_episode_forgets_the_last_ones_command():
    class Once(TraciStyleController):
        def on_step(self, traci, veh_id, time):
            if time == 0.0:
                traci.vehicle.setAcceleration(veh_id, -1.0, 20.0)

    controller = Once()
    controller.start(start(0))
    assert [controller.step(seen(0.0)), controller.step(seen(0.1))] == pytest.approx([-1.0, -1.0])
    controller.start(start(1))
    assert controller.step(seen(0.2)) == 0.0


def test_a_hook_that_catches_what_is_refused_fails_its_test_all_the_same():
    class Catches(TraciStyleController):
        def on_step(self, traci, veh_id, time):
            with suppress(traci.TraCIException):
                traci.vehicle.setSpeed(veh_id, NAN)

    controller = Catches()
    controller.start(start())
    with pytest.raises(traci_vehicle.RefusedError, match="nan is no command"):
        controller.step(seen(0.0))


def test_a_question_without_a_vehicle_is_named(traci):
    with pytest.raises(TypeError, match=r"vehicle.getSpeed\(\) missing 1 .* 'vehID'"):
        traci.vehicle.getSpeed()


def test_before_the_first_step_what_moves_is_not_known_and_all_else_is():
    vehicle = Traci(31.0).vehicle
    vehicle.subscribe("AV")
    assert (vehicle.getMaxSpeed("AV"), vehicle.getLength("BV"), vehicle.getLaneIndex("LV")) == (31.0, 5.0, 1)
    for name in ("getSpeed", "getAcceleration", "getPosition", "getLeader"):
        with pytest.raises(traci_vehicle.TraCIException, match="not known before the first step"):
            getattr(vehicle, name)("AV")


def test_what_scripts_set_first_is_accepted_where_it_holds_anyway(traci):
    vehicle = traci.vehicle
    vehicle.setMinGap("AV", 0.0)
    vehicle.setLength("AV", 5.0)
    vehicle.setActionStepLength("AV", 0.1)
    vehicle.setSpeedFactor("AV", 1.0)
    vehicle.setLaneChangeMode("AV", 0)
    vehicle.setLaneChangeMode("AV", 512)
    vehicle.setColor("AV", (255, 0, 0))
    vehicle.setDecel("AV", 4.5)
    vehicle.setSpeed("AV", 10.0)
    for mode, asked in ((0, -100.0), (32, -100.0), (6, -4.5), (4, -4.5), (2, -100.0)):
        vehicle.setSpeedMode("AV", mode)
        assert (vehicle.getSpeedMode("AV"), vehicle.next_acceleration()) == (mode, pytest.approx(asked))
