"""The facade answers as TraCI 1.28 does (numbers below were read from a SUMO), and commands only the AV."""

from operator import attrgetter

import numpy as np
import pytest

from harness.controllers import EpisodeStart, Neighbour, Observation
from harness.controllers.traci_style import StepListenerController, Traci, TraciStyleController


def seen(time_s=0.0, speed=20.0, *, bv_lane=0, lead_speed=20.0):
    ahead = (195.0, lead_speed) if bv_lane == 0 else (float("inf"), float("nan"))
    bv, lv = Neighbour(300.0, lead_speed, bv_lane), Neighbour(400.0, 20.0, 1)
    return Observation(time_s, 100.0, speed, 0.0, *ahead, bv, lv)


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
    assert vehicle.getLeader("BV") is None
    assert vehicle.getFollower("AV") == ("", -1.0)
    assert vehicle.getFollower("BV") == ("AV", 195.0)
    assert vehicle.getPosition("LV") == (400.0, 1.6)
    assert (vehicle.getPosition("AV"), vehicle.getLanePosition("AV")) == ((100.0, -1.6), 100.0)
    assert (vehicle.getLaneID("BV"), vehicle.getRoadID("BV"), vehicle.getAngle("BV")) == ("cell0_0", "cell0", 90.0)
    assert (vehicle.getLength("AV"), vehicle.getMinGap("AV")) == (5.0, 0.0)
    assert (traci.simulation.getTime(), traci.simulation.getDeltaT()) == (0.0, 0.1)


def test_nobody_ahead_is_none_or_by_the_future_behaviour_a_pair():
    traci = Traci()
    traci.see(seen(bv_lane=1))
    assert traci.vehicle.getLeader("AV") is None
    assert traci.vehicle.getLeader("BV") == ("LV", 95.0)
    traci.setLegacyGetLeader(False)
    assert traci.vehicle.getLeader("AV") == ("", -1.0)


def test_accelerations_of_traffic_are_differences_of_speeds(traci):
    assert traci.vehicle.getAcceleration("BV") == 0.0
    traci.see(seen(0.1, lead_speed=19.8))
    assert traci.vehicle.getAcceleration("BV") == pytest.approx(-2.0)
    assert traci.vehicle.getAcceleration("LV") == 0.0


@pytest.mark.parametrize(
    ("commands", "speeds"),
    [
        ([("slowDown", 18.0, 0.5)], [19.6, 19.2, 18.8, 18.4, 18.0, 18.0]),
        ([("slowDown", 15.0, 0.25)], [18.0, 16.0, 15.0, 15.0]),
        ([("setAcceleration", -2.0, 0.3)], [19.8, 19.6, 19.4, 19.4]),
        ([("setAcceleration", -2.0, 0.25)], [19.8, 19.6, 19.5, 19.5]),
        ([("setSpeed", 19.0)], [19.0, 19.0, 19.0]),
        ([("setDecel", 4.5), ("setSpeed", 0.0)], [19.55, 19.1, 18.65]),
    ],
)
def test_commands_lead_to_the_speeds_of_sumo(traci, commands, speeds):
    for name, *arguments in commands:
        getattr(traci.vehicle, name)("AV", *arguments)
    assert drive(traci, len(speeds), 20.0) == speeds
    traci.vehicle.setSpeed("AV", -1)  # releases it
    assert drive(traci, 2, speeds[-1]) == [speeds[-1]] * 2


MOVES = ("moveTo", "moveToXY", "changeLane", "remove", "add", "setRoute", "rerouteTraveltime")
ENDS = ("simulationStep", "load", "close", "start", "switch")
COMMANDS = {"setSpeed": (3.0,), "setAcceleration": (1.0, 1.0), "slowDown": (1.0, 1.0), "setDecel": (1.0,)}
RATIOS = "invalidate the likelihood ratios"
REFUSED = [
    *(
        (f"{name}.*{of}.*{RATIOS}", f"vehicle.{name}", of, *rest)
        for name, rest in COMMANDS.items()
        for of in ("LV", "BV")
    ),
    *((RATIOS, f"vehicle.{name}", "AV", 1, 2) for name in MOVES),
    *(("the harness itself starts, steps and ends", name) for name in ENDS),
    ("as under speed mode 32", "vehicle.setSpeedMode", "AV", 31),
    ("stays on its lane", "vehicle.setLaneChangeMode", "AV", 0),
    *(("'AV7' is not known", f"vehicle.{name}", "AV7") for name in ("getSpeed", "getLeader", "getLaneIndex")),
    ("'AV7' is not known", "vehicle.setSpeed", "AV7", 1.0),
    ("", "vehicle.slowDown", "AV", -1.0, 1.0),
    ("", "vehicle.slowDown", "AV", 1.0, -1.0),
    ("", "vehicle.setAcceleration", "AV", 1.0, -1.0),
    ("", "vehicle.setAcceleration", "AV", float("nan"), 1.0),
]


@pytest.mark.parametrize(("reason", "name", "arguments"), [(reason, name, rest) for reason, name, *rest in REFUSED])
def test_what_is_not_the_avs_or_not_possible_is_refused(traci, reason, name, arguments):
    with pytest.raises(traci.exceptions.TraCIException, match=reason or None):
        attrgetter(name)(traci)(*arguments)
    assert traci.vehicle.next_acceleration() == 0.0


def test_an_unknown_name_lists_what_there_is(traci):
    with pytest.raises(AttributeError, match=r"traci.vehicle has no getCO2Emission here; it has .*getLeader.*setSpeed"):
        traci.vehicle.getCO2Emission("AV")
    with pytest.raises(AttributeError, match=r"traci has no trafficlight here; it has .*simulation.*vehicle"):
        traci.trafficlight.getIDList()


def start(episode=0):
    return EpisodeStart(episode, 0.1, np.random.default_rng(episode))


def test_an_episode_forgets_the_last_ones_command():
    class Once(TraciStyleController):
        def on_step(self, traci, veh_id, time):
            if time == 0.0:
                traci.vehicle.setAcceleration(veh_id, -1.0, 60.0)

    controller = Once()
    controller.start(start(0))
    assert [controller.step(seen(0.0)), controller.step(seen(0.1))] == [-1.0, -1.0]
    controller.start(start(1))
    assert controller.step(seen(0.2)) == 0.0


class Twice:
    log = []

    def __init__(self, traci, speed, told):
        self.traci, self.speed = traci, speed
        told.append(speed)

    def step(self, t):
        self.log.append(t)
        self.traci.vehicle.setSpeed("AV", self.speed)
        return len(self.log) < 2

    def cleanUp(self):  # noqa: N802 - TraCI's own name
        self.log.append("clean")


def test_a_step_listener_is_removed_when_it_says_so():
    log, told = Twice.log, []
    controller = StepListenerController(f"{__name__}:Twice", speed=19.0, told=told)
    controller.start(start())
    assert [controller.step(seen(0.1 * i)) for i in range(3)] == pytest.approx([-10.0] * 3)
    assert log == [0.0, 0.1, "clean"]
    controller.close()
    assert log == [0.0, 0.1, "clean"]
    assert told == []  # each episode's listener has parameters of its own
