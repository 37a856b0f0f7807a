"""What stands for the module ``traci`` in TraCI-style controllers: the vehicles of one cell, commands for the AV alone.

Names, units and answers are those of the ``traci`` package 1.28; docs/controllers.md lists every difference. What a
script may not do here is refused with the reason.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import ModuleType
from typing import Any, ClassVar, NoReturn

from harness.controllers.protocol import Observation
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M

VEH_ID = "AV"
ROAD = "cell0"
LANE_CENTRES_M = (-1.6, 1.6)
MAX_SPEED_MPS = 100.0
_ROUNDING = 1e-9
_SAFE_SPEED, _ACCEL, _DECEL = 1, 2, 4
"""Bits of a speed mode."""
_CHANGES_LANE = 0b1100_1111_1111
"""Bits of a lane change mode that let SUMO change lanes, but for how much room it leaves."""
_DEFAULT_VARIABLES = 0x50, 0x56

_WOULD_MOVE = "it would move vehicles past the harness and invalidate the likelihood ratios"
_STEPS = "the harness itself starts, steps and ends the simulation"
_REFUSED = {
    **dict.fromkeys(("start", "init", "connect", "switch", "setOrder", "close", "load", "loadState"), _STEPS),
    **dict.fromkeys(("saveState", "simulationStep", "step", "executeMove"), _STEPS),
    "addStepListener": "name the listener in the campaign, as av.controller",
    "changeLane": "the AV stays on its lane; " + _WOULD_MOVE,
}
_REFUSED_BEGINNINGS = ("set", "add", "remove", "move", "change", "reroute", "openGap", "replace", "insert", "resume")


class TraCIException(Exception):  # noqa: N818 - TraCI's own name
    """A command or question that TraCI, or the harness, does not answer."""


class Domain:
    """Part of the facade: what it lacks is refused with the reason, or unknown with a list of what there is."""

    _path: ClassVar[str]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        why = _REFUSED.get(name, _WOULD_MOVE if name.startswith(_REFUSED_BEGINNINGS) else None)
        if why is None:
            there = ", ".join(entry for entry in dir(self) if not entry.startswith("_") and entry != "see")
            raise AttributeError(f"{self._path} has no {name} here; it has {there}")

        def refused(*_arguments: Any, **_named: Any) -> NoReturn:
            raise TraCIException(f"{self._path}.{name} is refused: {why}.")

        return refused


class Seen:
    """What a script may ask of one vehicle: m, m/s, m/s²; lane 0 right, 1 left; sideways positive to the left."""

    __slots__ = "acceleration", "lane", "max_speed", "position", "sideways", "sideways_speed", "speed"
    position: float
    speed: float
    acceleration: float

    def __init__(self, lane: int, max_speed: float) -> None:
        self.lane, self.max_speed = lane, max_speed
        self.sideways = self.sideways_speed = 0.0

    def __getattr__(self, name: str) -> NoReturn:
        raise TraCIException(f"The {name} of a vehicle is not known before the first step.")


_QUESTIONS: dict[str, tuple[int, Callable[[Seen], Any]]] = {
    "getLateralSpeed": (0x32, lambda of: of.sideways_speed),
    "getSpeed": (0x40, lambda of: of.speed),
    "getMaxSpeed": (0x41, lambda of: of.max_speed),  # of the AV that at which it cruises
    "getPosition": (0x42, lambda of: (of.position, LANE_CENTRES_M[of.lane] + of.sideways)),
    "getAngle": (0x43, lambda _: 90.0),  # degrees: along x
    "getLength": (0x44, lambda _: VEHICLE_LENGTH_M),
    "getMinGap": (0x4C, lambda _: 0.0),  # gaps are bumper to bumper
    "getTypeID": (0x4F, lambda _: "exact"),
    "getRoadID": (0x50, lambda _: ROAD),
    "getLaneID": (0x51, lambda of: f"{ROAD}_{of.lane}"),
    "getLaneIndex": (0x52, lambda of: of.lane),
    "getLanePosition": (0x56, lambda of: of.position),
    "getAcceleration": (0x72, lambda of: of.acceleration),
    "getLateralLanePosition": (0xB8, lambda of: of.sideways),
}
"""Questions about a vehicle: their numbers in ``traci.constants``, and what answers them. Front bumpers count."""
_VARIABLES = {number: name for name, (number, _) in _QUESTIONS.items()}
_VARIABLES |= {0x68: "getLeader", 0x78: "getFollower"}
"""What can be subscribed to, by number."""
_OF_THE_AV = {"getSpeedMode": "_speed_mode", "getAccel": "_accel", "getDecel": "_decel"}
"""What has been set of it, and where that is kept: bounds of its commands (m/s²) are infinite without."""
_NEIGHBOURS = ("getLeftFollowers", "getRightFollowers", "getLeftLeaders", "getRightLeaders")
"""Modes of `VehicleDomain.getNeighbors`, from 0; with ``blockingOnly`` each is four more."""
_ACCEPTED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "setLaneChangeMode": (lambda mode: not mode & _CHANGES_LANE, "the AV stays on its lane, as in mode 0, 256 or 512"),
    "setMinGap": (lambda gap: gap == 0.0, "gaps are bumper to bumper, minGap is 0"),
    "setLength": (lambda length: length == VEHICLE_LENGTH_M, "vehicles are 5 m long"),
    "setActionStepLength": (lambda step: step == STEP_S, "the AV acts in every 0.1 s"),
    "setSpeedFactor": (lambda factor: factor == 1.0, "the speed factor is 1"),
    "setColor": (lambda _: True, "nobody sees a colour"),
}
"""Setters of the AV that change nothing: each is refused unless it asks for what holds anyway."""


class VehicleDomain(Domain):
    """``traci.vehicle`` of one cell: what is here, and what the tables above have."""

    _path = "traci.vehicle"

    def __init__(self, set_speed_mps: float, lv_name: str, bv_name: str) -> None:
        self.legacy_leader = True
        self._plan: Iterator[float] = iter(())
        """Accelerations (m/s²) of the coming steps; empty without a command."""
        self._command: Callable[[], Iterator[float]] | None = None
        """What begins the plan anew: nothing for a command that is over after a step."""
        self._told = math.nan
        """Speed (m/s) that the AV will have if it does what it is told."""
        self._accel = self._decel = math.inf
        self._speed_mode = _ACCEL | _DECEL
        self._subscribed: dict[str, tuple[int, ...]] = {}
        self._lv, self._bv, self._own = Seen(1, MAX_SPEED_MPS), Seen(1, MAX_SPEED_MPS), Seen(0, set_speed_mps)
        named = (lv_name, self._lv), (bv_name, self._bv), (VEH_ID, self._own)
        self._vehicles = {name: vehicle for name, vehicle in named if name}
        self._seen = self._vehicles.copy()
        self._begun = False

    def see(self, now: Observation) -> None:
        """Take in what is there before a step."""
        for other, there in ((self._lv, now.lv), (self._bv, now.bv)):
            change = there.speed_mps - other.speed if self._begun else math.nan  # also where it was not seen before
            other.acceleration = 0.0 if math.isnan(change) else change / STEP_S
            other.position, other.speed, other.lane = there
        self._seen = {
            name: one for name, one in self._vehicles.items() if one is self._own or not math.isnan(one.position)
        }
        self._lv.sideways = 0.0 if now.lv.lane else now.lv_lateral_m
        self._lv.sideways_speed = now.lv_lateral_speed_mps
        # SUMO counts to the left; once BV overlaps it counts as a vehicle of the right lane, in its middle.
        self._bv.sideways = 0.0 if now.bv_overlaps else -now.bv_lateral_m
        self._bv.sideways_speed = -now.bv_lateral_speed_mps
        own = self._own
        own.position, own.speed, own.acceleration = now.position_m, now.speed_mps, now.acceleration_mps2
        self._begun = True
        # In the warm-up, and as long as it is held, the AV does not do what it is told. A command of longer than a step
        # waits for it: else it would ask, at the hand-over, for speeds that it should have reached by then.
        if self._command is not None and abs(now.speed_mps - self._told) > _ROUNDING:
            self._plan = self._command()

    def next_acceleration(self) -> float:
        """What the AV is told for the coming step (m/s²); without a command it keeps its speed."""
        if (acceleration := next(self._plan, None)) is None:
            self._command, acceleration = None, 0.0
        elif self._speed_mode & _DECEL:
            acceleration = max(acceleration, -self._decel)
        if self._speed_mode & _ACCEL:
            acceleration = min(acceleration, self._accel)
        self._told = max(0.0, self._own.speed + acceleration * STEP_S)
        return acceleration

    def _of(self, vehID: str) -> Seen:
        try:
            return self._seen[vehID]
        except KeyError:
            *first, last = self._vehicles
            there = f"a cell has {', '.join(first)} and {last}"
            raise TraCIException(f"Vehicle '{vehID}' is not known, or not seen yet: {there}.") from None

    # -- questions --

    def getIDList(self) -> tuple[str, ...]:
        """The cell's vehicles."""
        return tuple(self._seen)

    def getIDCount(self) -> int:
        """Their number."""
        return len(self._seen)

    def subscribe(self, objectID: str, varIDs: Sequence[int] | None = None, *_when: float) -> None:
        """Ask for variables (numbers of ``traci.constants``), for the whole test; by default road and position."""
        self._of(objectID)
        wanted = tuple(_DEFAULT_VARIABLES if varIDs is None else varIDs)
        if unknown := [hex(number) for number in wanted if number not in _VARIABLES]:
            raise TraCIException(
                f"Variable {unknown[0]} of vehicles is not known here: it has {', '.join(map(hex, _VARIABLES))}."
            )
        self._subscribed[objectID] = wanted

    def unsubscribe(self, objectID: str) -> None:
        """Ask for nothing more."""
        self._subscribed.pop(objectID, None)

    def getSubscriptionResults(self, objectID: str) -> dict[int, Any]:
        """Values of what has been subscribed to, by number; none without."""
        asked = self._subscribed.get(objectID, ()) if objectID in self._seen else ()
        return {number: getattr(self, _VARIABLES[number])(objectID) for number in asked}

    def getAllSubscriptionResults(self) -> dict[str, dict[int, Any]]:
        """The same of all vehicles that have been subscribed to."""
        return {name: self.getSubscriptionResults(name) for name in self._subscribed}

    def getLeader(self, vehID: str, dist: float = 100.0) -> tuple[str, float] | None:  # noqa: ARG002 - TraCI's signature
        """Vehicle ahead on the lane and the gap to it (m, less the minGap of zero), however far away.

        Without one None, or ``("", -1.0)`` after ``traci.setLegacyGetLeader(False)``.
        """
        ahead = self._nearest(vehID, 1.0)
        return ahead if ahead is not None or self.legacy_leader else ("", -1.0)

    def getFollower(self, vehID: str, dist: float = 0.0) -> tuple[str, float]:  # noqa: ARG002 - TraCI's signature
        """Vehicle behind on the lane and the gap from it (m); ``("", -1.0)`` without one."""
        return self._nearest(vehID, -1.0) or ("", -1.0)

    def getNeighbors(self, vehID: str, mode: int) -> tuple[tuple[str, float], ...]:
        """Nearest vehicle on a lane beside, and the gap (m): 1 the right one, not the left; 2 ahead, not behind.

        With 4 only one that is in the way of a lane change: one beside.
        """
        lane = self._of(vehID).lane + (-1 if mode & 1 else 1)
        found = self._nearest(vehID, 1.0 if mode & 2 else -1.0, lane)
        return () if found is None or (mode & 4 and found[1] > 0.0) else (found,)

    def _nearest(self, vehID: str, direction: float, lane: int | None = None) -> tuple[str, float] | None:
        own = self._of(vehID)
        here, lane = own.position, own.lane if lane is None else lane
        found: tuple[str, float] | None = None
        for name, other in self._seen.items():
            there = other.position
            if name == vehID or other.lane != lane or direction * (there - here) < 0.0:
                continue
            # Operation by operation as the observed gap: bit-equal to what other controllers see.
            gap = (there - VEHICLE_LENGTH_M - here) if direction > 0.0 else (here - VEHICLE_LENGTH_M - there)
            if found is None or gap < found[1]:
                found = name, gap
        return found

    # -- commands --

    def setSpeed(self, vehID: str, speed: float) -> None:
        """Drive at this speed (m/s) from the next step on until told otherwise; -1 releases."""
        self._require_own(vehID, "setSpeed")
        self._begin(None if speed < 0.0 else partial(self._hold, _finite(speed)), math.inf)

    def setAcceleration(self, vehID: str, acceleration: float, duration: float) -> None:
        """Accelerate (m/s²) for a duration (s)."""
        self._require_own(vehID, "setAcceleration")
        if duration < 0.0:
            raise TraCIException("Duration must not be negative.")
        self._begin(partial(self._accelerate, _finite(acceleration), duration), duration)

    def slowDown(self, vehID: str, speed: float, duration: float) -> None:
        """Change speed linearly to a value (m/s) in a duration (s)."""
        self._require_own(vehID, "slowDown")
        if not speed >= 0.0:
            raise TraCIException("Speed must not be negative.")
        if duration < 0.0:
            raise TraCIException("Invalid time interval.")
        self._begin(partial(self._approach, _finite(speed), duration), duration)

    def _begin(self, command: Callable[[], Iterator[float]] | None, duration: float) -> None:
        self._plan = iter(()) if command is None else command()
        self._command = command if duration > STEP_S + _ROUNDING else None

    def _hold(self, speed: float) -> Iterator[float]:
        """Until further notice."""
        while True:
            yield (speed - self._own.speed) / STEP_S

    def _accelerate(self, acceleration: float, duration: float) -> Iterator[float]:
        """For whole steps, and a share of a last one."""
        left = duration / STEP_S
        while left >= _ROUNDING:
            yield acceleration if left > 1.0 - _ROUNDING else acceleration * left
            left -= 1.0

    def _approach(self, target: float, duration: float) -> Iterator[float]:
        start, steps, done = self._own.speed, max(duration / STEP_S, 1.0), 0
        while done <= steps - _ROUNDING:
            done += 1
            share = min(1.0, done / steps)
            yield (start + (target - start) * share - self._own.speed) / STEP_S

    def setAccel(self, vehID: str, accel: float) -> None:
        """Bound the acceleration (m/s²) that later commands lead to."""
        self._require_own(vehID, "setAccel")
        self._accel = accel

    def setDecel(self, vehID: str, decel: float) -> None:
        """Bound the braking (m/s², positive) that later commands lead to."""
        self._require_own(vehID, "setDecel")
        self._decel = decel

    def setSpeedMode(self, vehID: str, speedMode: int) -> None:
        """Whether `setAccel` (bit 2) and `setDecel` (bit 4) bound commands."""
        self._require_own(vehID, "setSpeedMode")
        if speedMode & _SAFE_SPEED:
            why = "SUMO's safe speeds (bit 1) do not bound the AV here: what it is told it does, as under speed mode 32"
            raise TraCIException(f"vehicle.setSpeedMode('{vehID}', {speedMode}) is refused: {why}.")
        self._speed_mode = speedMode

    def _require_own(self, vehID: str, name: str, why: str = _WOULD_MOVE) -> None:
        if vehID != VEH_ID:
            self._of(vehID)
            raise TraCIException(f"vehicle.{name}('{vehID}') is refused: {why}. Commands are for 'AV' only.")


def _question(answer: Callable[[Seen], Any]) -> Callable[[VehicleDomain, str], Any]:
    return lambda self, vehID: answer(self._of(vehID))


def _of_the_av(name: str, kept: str) -> Callable[[VehicleDomain, str], Any]:
    def ask(self: VehicleDomain, vehID: str) -> Any:
        self._require_own(vehID, name, "is not known of traffic")
        return getattr(self, kept)

    return ask


def _neighbours(mode: int) -> Callable[..., tuple[tuple[str, float], ...]]:
    return lambda self, vehID, blockingOnly=False: self.getNeighbors(vehID, mode | 4 * blockingOnly)


def _accepted(name: str, holds: Callable[[Any], bool], what_holds: str) -> Callable[..., None]:
    def accept(self: VehicleDomain, vehID: str, value: Any, *_more: Any) -> None:
        self._require_own(vehID, name)
        if not holds(value):
            raise TraCIException(f"vehicle.{name}('{vehID}', {value}) is refused: {what_holds}.")

    return accept


_FROM_TABLES: dict[str, Callable[..., Any]] = {
    **{name: _question(answer) for name, (_, answer) in _QUESTIONS.items()},
    **{name: _of_the_av(name, kept) for name, kept in _OF_THE_AV.items()},
    **{name: _neighbours(mode) for mode, name in enumerate(_NEIGHBOURS)},
    **{name: _accepted(name, *row) for name, row in _ACCEPTED.items()},
}
for _name, _method in (*_FROM_TABLES.items(), ("getAllowedSpeed", _FROM_TABLES["getMaxSpeed"])):
    setattr(VehicleDomain, _name, _method)


class SimulationDomain(Domain):
    """``traci.simulation`` of one cell: a crash ends the test, so that nobody has collided; nobody arrives."""

    _path = "traci.simulation"
    time_s = 0.0

    def getTime(self) -> float:
        """Time since the episode began (s)."""
        return self.time_s

    getDeltaT = staticmethod(lambda: STEP_S)
    getMinExpectedNumber = staticmethod(lambda: 3)
    getCollidingVehiclesNumber = staticmethod(lambda: 0)
    getCollidingVehiclesIDList = getCollisions = getArrivedIDList = staticmethod(tuple)


class Traci(Domain):
    """What stands for the module ``traci``: one episode of one cell."""

    TraCIException = TraCIException
    _path = "traci"

    def __init__(self, set_speed_mps: float = math.nan, lv_name: str = "LV", bv_name: str = "BV") -> None:
        self.vehicle, self.simulation = VehicleDomain(set_speed_mps, lv_name, bv_name), SimulationDomain()
        self.exceptions = self  # so that ``traci.exceptions.TraCIException`` is found

    @property
    def constants(self) -> ModuleType:
        """Numbers to subscribe by."""
        return importlib.import_module("traci.constants")

    def see(self, now: Observation) -> None:
        """Take in what is there before a step."""
        self.simulation.time_s = now.time_s
        self.vehicle.see(now)

    def setLegacyGetLeader(self, enabled: bool) -> None:
        """Whether `getLeader` answers None (as 1.28 does by default) or ``("", -1.0)`` when nobody is ahead."""
        self.vehicle.legacy_leader = enabled


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise TraCIException(f"{value} is no command for a vehicle.")
    return value
