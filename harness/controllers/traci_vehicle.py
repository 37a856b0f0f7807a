"""What stands for ``traci.vehicle`` (see `harness.controllers.traci_style`): questions and commands."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NoReturn

from harness.controllers.protocol import Observation
from harness.controllers.traci_refused import WOULD_MOVE, Domain, RefusedError, TraCIException
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M

VEH_ID = "AV"
ROAD = "cell0"
LANE_CENTRES_M = (-1.6, 1.6)
MAX_SPEED_MPS = 100.0
_ROUNDING = 1e-9
SAFE_SPEED, _ACCEL, DECEL = 1, 2, 4
"""Bits of a speed mode."""
LOOSE = ": the script has set speed mode {}, in which decel does not bound setSpeed; use mode 30, or bound it yourself"
_SUMOS_OWN = 31
"""The speed mode of a script that sets none."""
_CHANGES_LANE = 0b1100_1111_1111
"""Bits of a lane change mode that let SUMO change lanes, but for how much room it leaves."""
_ROAD_AND_POSITION, _VEHICLES, _LEADER = (0x50, 0x56), 0xA4, 0x68


class SeenVehicle:
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


_QUESTIONS: dict[str, tuple[int, Callable[[SeenVehicle], Any]]] = {
    "getLateralSpeed": (0x32, lambda car: car.sideways_speed),
    "getSpeed": (0x40, lambda car: car.speed),
    "getMaxSpeed": (0x41, lambda car: car.max_speed),  # of the AV that at which it cruises
    "getPosition": (0x42, lambda car: (car.position, LANE_CENTRES_M[car.lane] + car.sideways)),
    "getAngle": (0x43, lambda _: 90.0),  # degrees: along x
    "getLength": (0x44, lambda _: VEHICLE_LENGTH_M),
    "getVehicleClass": (0x49, lambda _: "passenger"),
    "getMinGap": (0x4C, lambda _: 0.0),  # gaps are bumper to bumper
    "getWidth": (0x4D, lambda _: 1.8),  # SUMO's of passenger cars
    "getTypeID": (0x4F, lambda _: "exact"),
    "getRoadID": (0x50, lambda _: ROAD),
    "getLaneID": (0x51, lambda car: f"{ROAD}_{car.lane}"),
    "getLaneIndex": (0x52, lambda car: car.lane),
    "getLanePosition": (0x56, lambda car: car.position),
    "getSpeedFactor": (0x5E, lambda _: 1.0),
    "getDistance": (0x84, lambda car: car.position),  # as if it had departed where the road begins
    "getAcceleration": (0x72, lambda car: car.acceleration),
    "getLateralLanePosition": (0xB8, lambda car: car.sideways),
}
"""Questions about a vehicle: their numbers in ``traci.constants``, and what answers them. Front bumpers count."""
_VARIABLES = {number: name for name, (number, _) in _QUESTIONS.items()} | {_LEADER: "getLeader", 0x78: "getFollower"}
"""What can be subscribed to, by number."""
_OF_THE_AV = {"getSpeedMode": "_speed_mode", "getAccel": "_accel", "getDecel": "_decel"}
"""What can be set of the AV, and which attribute keeps it."""
_NEIGHBOURS = ("getLeftFollowers", "getRightFollowers", "getLeftLeaders", "getRightLeaders")
"""Modes of `VehicleDomain.getNeighbors`, from 0; with ``blockingOnly`` each is four more."""
_ACCEPTED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "setLaneChangeMode": (lambda mode: not mode & _CHANGES_LANE, "the AV stays on its lane, as in mode 0, 256 or 512"),
    "setMinGap": (lambda gap: gap == 0.0, "gaps are bumper to bumper, minGap is 0"),
    "setLength": (lambda length: length == VEHICLE_LENGTH_M, "vehicles are 5 m long"),
    "setActionStepLength": (lambda step: step == STEP_S, "the AV acts in every 0.1 s"),
    "setSpeedFactor": (lambda factor: factor == 1.0, "the speed factor is 1"),
    "setColor": (lambda _: True, "nobody sees a colour"),
    "highlight": (lambda _: True, "nobody sees it"),
}
"""Setters of the AV that change nothing: each is refused unless it asks for what holds anyway."""


class VehicleDomain(Domain):
    """``traci.vehicle`` of one cell: what is here, and what the tables above have."""

    _path = "traci.vehicle"

    def __init__(
        self, set_speed_mps: float = math.nan, ego: str = VEH_ID, lv_name: str = "LV", bv_name: str = "BV"
    ) -> None:
        self.legacy_leader, self.set_speed_mps = True, set_speed_mps
        self._ego = ego
        self._plan: Iterator[float] = iter(())
        """Accelerations (m/s²) of the coming steps; empty without a command."""
        self._command: Callable[[], Iterator[float]] | None = None
        """What begins the plan anew: nothing for a command that is over after a step."""
        self.told_at = "", 0, DECEL
        """File and line of the last command, and the speed mode then."""
        self._commanded_mps = math.nan
        """Speed (m/s) that the AV will have if it does what it is told."""
        self._accel = self._decel = math.inf
        self._speed_mode = _SUMOS_OWN
        self._subscribed: dict[str, tuple[int, ...]] = {}
        self._around: dict[str, dict[float, tuple[int, ...]]] = {}
        """Range (m) and variables of what has been subscribed to around a vehicle."""
        self._lv, self._bv = SeenVehicle(1, MAX_SPEED_MPS), SeenVehicle(1, MAX_SPEED_MPS)
        self._own = SeenVehicle(0, set_speed_mps)
        self._others = {name: other for name, other in ((lv_name, self._lv), (bv_name, self._bv)) if name}
        self._seen = {**self._others, ego: self._own}
        self._begun = False
        self.step_s = STEP_S
        """How often the script is asked, whose commands hold until then."""

    def see(self, now: Observation) -> None:
        """Take in what is there before a step; what was refused before it is forgotten."""
        RefusedError.last = None
        for other, seen in ((self._lv, now.lv), (self._bv, now.bv)):
            change = seen.speed_mps - other.speed if self._begun else math.nan  # also where it was not seen before
            other.acceleration = 0.0 if math.isnan(change) else change / self.step_s
            other.position, other.speed, other.lane = seen
        for name, other in self._others.items():
            if math.isnan(other.position):
                self._seen.pop(name, None)
            else:
                self._seen[name] = other
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
        if self._command is not None and abs(now.speed_mps - self._commanded_mps) > _ROUNDING:
            self._plan = self._command()

    def leave(self) -> None:
        """All vehicles are gone: the test has ended."""
        self._seen, self._subscribed, self._around = {}, {}, {}

    def next_acceleration(self) -> float:
        """What the AV is told for the coming step (m/s²); without a command it keeps its speed."""
        if (acceleration := next(self._plan, None)) is None:
            self._command, acceleration = None, 0.0
        elif self._speed_mode & DECEL:
            acceleration = max(acceleration, -self._decel)
        if self._speed_mode & _ACCEL:
            acceleration = min(acceleration, self._accel)
        self._commanded_mps = max(0.0, self._own.speed + acceleration * self.step_s)
        return acceleration

    def _of(self, vehID: str) -> SeenVehicle:
        try:
            return self._seen[vehID]
        except KeyError:
            there = ", ".join(self._seen) or "none"
            raise TraCIException(f"Vehicle '{vehID}' is not known, or not seen yet: there are {there}.") from None

    # -- questions --

    def getIDList(self) -> tuple[str, ...]:
        return tuple(self._seen)

    def getIDCount(self) -> int:
        return len(self._seen)

    def subscribe(self, objectID: str, varIDs: Sequence[int] | None = None, *_when: Any, **_how: Any) -> None:
        self._of(objectID)
        wanted = known_variables(varIDs, _VARIABLES, "vehicles")
        self._subscribed[objectID] = *self._subscribed.get(objectID, ()), *wanted

    def subscribeLeader(self, vehID: str, *_when: Any, **_how: Any) -> None:
        self._of(vehID)
        self._subscribed[vehID] = *self._subscribed.get(vehID, ()), _LEADER

    def unsubscribe(self, objectID: str) -> None:
        self._subscribed.pop(objectID, None)

    def getSubscriptionResults(self, objectID: str) -> dict[int, Any]:
        return self._values(objectID, self._subscribed.get(objectID, ()) if objectID in self._seen else ())

    def _values(self, objectID: str, variables: Sequence[int]) -> dict[int, Any]:
        return {number: getattr(self, _VARIABLES[number])(objectID) for number in variables}

    def getAllSubscriptionResults(self) -> dict[str, dict[int, Any]]:
        return {name: self.getSubscriptionResults(name) for name in self._subscribed}

    def subscribeContext(
        self, objectID: str, domain: int, dist: float, varIDs: Sequence[int] | None = None, *_when: Any, **_how: Any
    ) -> None:
        self._of(objectID)
        if domain != _VEHICLES:
            raise RefusedError(f"vehicle.subscribeContext of domain {domain:#x} is refused: there are vehicles alone.")
        around = self._around.setdefault(objectID, {})
        around[dist] = *around.get(dist, ()), *known_variables(varIDs, _VARIABLES, "vehicles")

    def getContextSubscriptionResults(self, objectID: str) -> dict[str, dict[int, Any]]:
        centre, results = self.getPosition(objectID), dict[str, dict[int, Any]]()
        for dist, variables in self._around.get(objectID, {}).items():
            for name in (name for name in self._seen if math.dist(centre, self.getPosition(name)) <= dist):
                results.setdefault(name, {}).update(self._values(name, variables))
        return results

    def getLeader(self, vehID: str, dist: float = 100.0) -> tuple[str, float] | None:  # noqa: ARG002 - TraCI's signature
        """Vehicle ahead on the lane and the gap to it (m, less the minGap of zero), however far away.

        Without one None, or ``("", -1.0)`` after ``traci.setLegacyGetLeader(False)``.
        """
        ahead = self._nearest(vehID, 1.0)
        return ahead if ahead is not None or self.legacy_leader else ("", -1.0)

    def getFollower(self, vehID: str, dist: float = 0.0) -> tuple[str, float]:  # noqa: ARG002 - TraCI's signature
        return self._nearest(vehID, -1.0) or ("", -1.0)

    def getNeighbors(self, vehID: str, mode: int) -> tuple[tuple[str, float], ...]:
        """Nearest vehicle on a lane beside, and the gap (m): 1 the right one, not the left; 2 ahead, not behind."""
        if mode & 4:
            raise RefusedError("blockingOnly is refused: SUMO's lane change model, which says who blocks, is not here.")
        lane = self._of(vehID).lane + (-1 if mode & 1 else 1)
        neighbour = self._nearest(vehID, 1.0 if mode & 2 else -1.0, lane)
        return () if neighbour is None else (neighbour,)

    def _nearest(self, vehID: str, direction: float, lane: int | None = None) -> tuple[str, float] | None:
        own = self._of(vehID)
        here = own.position
        lane = own.lane if lane is None else lane
        nearest: tuple[str, float] | None = None
        for name, other in self._seen.items():
            there = other.position
            if name == vehID or other.lane != lane or direction * (there - here) < 0.0:
                continue
            # Operation by operation as the observed gap: bit-equal to what other controllers see.
            gap = (there - VEHICLE_LENGTH_M - here) if direction > 0.0 else (here - VEHICLE_LENGTH_M - there)
            if nearest is None or gap < nearest[1]:
                nearest = name, gap
        return nearest

    # -- commands --

    def add(self, vehID: str, *_arguments: Any, **_named: Any) -> None:
        """Accepted of its own vehicle, which is there."""
        self._require_own(vehID, "add")

    def setSpeed(self, vehID: str, speed: float) -> None:
        self._require_own(vehID, "setSpeed")
        self._begin(None if speed < 0.0 else partial(self._hold, _finite(speed)), math.inf)

    def setAcceleration(self, vehID: str, acceleration: float, duration: float) -> None:
        self._require_own(vehID, "setAcceleration")
        self._begin(partial(self._accelerate, _finite(acceleration), _finite(duration, 0.0)), duration)

    def slowDown(self, vehID: str, speed: float, duration: float) -> None:
        self._require_own(vehID, "slowDown")
        self._begin(partial(self._approach, _finite(speed, 0.0), _finite(duration, 0.0)), duration)

    def _begin(self, command: Callable[[], Iterator[float]] | None, duration: float) -> None:
        caller = sys._getframe(2)
        self.told_at = caller.f_code.co_filename, caller.f_lineno, self._speed_mode
        self._plan = iter(()) if command is None else command()
        self._command = command if duration > self.step_s + _ROUNDING else None

    def _hold(self, speed: float) -> Iterator[float]:
        while True:
            yield (speed - self._own.speed) / self.step_s

    def _accelerate(self, acceleration: float, duration: float) -> Iterator[float]:
        """To the speed at its end, as SUMO: what would stand before it brakes the more gently."""
        if (steps := duration / self.step_s) > 1.0 + _ROUNDING:
            yield from self._approach(max(0.0, self._own.speed + acceleration * duration), duration)
        elif steps >= _ROUNDING:
            yield acceleration if steps > 1.0 - _ROUNDING else acceleration * steps

    def _approach(self, target: float, duration: float) -> Iterator[float]:
        start, steps, done = self._own.speed, max(duration / self.step_s, 1.0), 0
        while done <= steps + _ROUNDING:  # SUMO's last step is the one after its duration
            done += 1
            share = min(1.0, done / steps)
            yield (start + (target - start) * share - self._own.speed) / self.step_s

    def setAccel(self, vehID: str, accel: float) -> None:
        """Bound the acceleration (m/s²) that later commands lead to."""
        self._require_own(vehID, "setAccel")
        self._accel = _finite(accel, 0.0)

    def setDecel(self, vehID: str, decel: float) -> None:
        """Bound the braking (m/s², positive) that later commands lead to."""
        self._require_own(vehID, "setDecel")
        self._decel = _finite(decel, 0.0)

    def setSpeedMode(self, vehID: str, speedMode: int) -> None:
        """Whether `setAccel` (bit 2) and `setDecel` (bit 4) bound commands."""
        self._require_own(vehID, "setSpeedMode")
        if speedMode & SAFE_SPEED and speedMode != _SUMOS_OWN:
            why = "SUMO's safe speeds (bit 1) do not bound the AV here: what it is told it does, as under speed mode 32"
            raise RefusedError(f"vehicle.setSpeedMode('{vehID}', {speedMode}) is refused: {why}.")
        self._speed_mode = speedMode

    def _require_own(self, vehID: str, name: str, why: str = WOULD_MOVE) -> None:
        if vehID != self._ego:
            self._of(vehID)
            raise RefusedError(f"vehicle.{name}('{vehID}') is refused: {why}. Commands are for '{self._ego}' only.")


def known_variables(numbers: Sequence[int] | None, known: Mapping[int, str], what: str) -> tuple[int, ...]:
    """Variables to subscribe to, by default road and position; refused where one is not among the ``known``."""
    wanted = _ROAD_AND_POSITION if numbers is None else tuple(numbers)
    if unknown := [hex(number) for number in wanted if number not in known]:
        raise RefusedError(f"Variable {unknown[0]} of {what} is not known here: it has {', '.join(map(hex, known))}.")
    return wanted


def _question(answer: Callable[[SeenVehicle], Any]) -> Callable[[VehicleDomain, str], Any]:
    return lambda self, vehID: answer(self._of(vehID))


def _of_the_av(name: str, attribute: str) -> Callable[[VehicleDomain, str], Any]:
    def ask(self: VehicleDomain, vehID: str) -> Any:
        self._require_own(vehID, name, "is not known of traffic")
        if (value := getattr(self, attribute)) == math.inf:
            raise RefusedError(f"vehicle.{name}('{vehID}') is refused before set{name[3:]}: nothing bounds the AV.")
        return value

    return ask


def _neighbours(mode: int) -> Callable[..., tuple[tuple[str, float], ...]]:
    return lambda self, vehID, blockingOnly=False: self.getNeighbors(vehID, mode | 4 * blockingOnly)


def _accepted(name: str, holds: Callable[[Any], bool], what_holds: str) -> Callable[..., None]:
    def accept(self: VehicleDomain, vehID: str, value: Any = None, *_more: Any, **_named: Any) -> None:
        self._require_own(vehID, name)
        if not holds(value):
            raise RefusedError(f"vehicle.{name}('{vehID}', {value}) is refused: {what_holds}.")

    return accept


_FROM_TABLES: dict[str, Callable[..., Any]] = {
    **{name: _question(answer) for name, (_, answer) in _QUESTIONS.items()},
    **{name: _of_the_av(name, attribute) for name, attribute in _OF_THE_AV.items()},
    **{name: _neighbours(mode) for mode, name in enumerate(_NEIGHBOURS)},
    **{name: _accepted(name, *row) for name, row in _ACCEPTED.items()},
}
for _name, _method in (("getAllowedSpeed", _FROM_TABLES["getMaxSpeed"]), *_FROM_TABLES.items()):
    _method.__qualname__ = f"vehicle.{_name}"  # which a TypeError names
    setattr(VehicleDomain, _name, _method)


def _finite(value: float, least: float = -math.inf) -> float:
    if not math.isfinite(value) or value < least:
        raise RefusedError(f"{value} is no command for a vehicle.")  # TraCI takes it: a script must not hide this
    return value
