"""TraCI-style controllers: an existing TraCI or libsumo script moves over with few changes.

``traci`` is an object handed to the controller in place of the module of that name: TraCI's own names over the three
vehicles of the AV's cell, commands for the AV alone. Names, units and answers are those of the ``traci`` package 1.28;
docs/controllers.md lists every difference. What a script may not do here is refused with the reason.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from functools import partial
from types import ModuleType
from typing import Any, ClassVar, NoReturn

import numpy as np

from harness.controllers.protocol import EpisodeStart, Observation
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M

__all__ = ["StepListenerController", "TraCIException", "TraciStyleController"]

VEH_ID = "AV"
ROAD = "cell0"
LANES = {"LV": 1, "BV": 1, VEH_ID: 0}
"""Vehicles of a cell, and their lanes (0 right, 1 left) before a cut-in."""
LANE_CENTRES_M = (-1.6, 1.6)
MAX_SPEED_MPS = 100.0
HEADING_DEGREES = 90.0
_ROUNDING = 1e-9
_SAFE_SPEED, _ACCEL, _DECEL = 1, 2, 4
"""Bits of a speed mode."""
_CHANGES_LANE = 0b1100_1111_1111
"""Bits of a lane change mode that let SUMO change lanes, but for how much room it leaves."""
_DEFAULT_VARIABLES = 0x50, 0x56
_NUMBERS = 0x32, 0x40, 0x41, 0x42, 0x43, 0x44, 0x4C, 0x4F, 0x50, 0x51, 0x52, 0x56, 0x68, 0x72, 0x78, 0xB8
_GETTERS = (
    *("getLateralSpeed", "getSpeed", "getMaxSpeed", "getPosition", "getAngle", "getLength", "getMinGap", "getTypeID"),
    *("getRoadID", "getLaneID", "getLaneIndex", "getLanePosition", "getLeader", "getAcceleration", "getFollower"),
    "getLateralLanePosition",
)
_VARIABLES = dict(zip(_NUMBERS, _GETTERS, strict=True))
"""What number of ``traci.constants`` can be subscribed to, and what gets it."""

_WOULD_MOVE = "it would move vehicles past the harness and invalidate the likelihood ratios"
_STEPS = "the harness itself starts, steps and ends the simulation"
_WHY = {
    "addStepListener": "name the listener in the campaign, as av.controller",
    "changeLane": "the AV stays on its lane; " + _WOULD_MOVE,
}
_REFUSED_BEGINNINGS = ("set", "add", "remove", "move", "change", "reroute", "openGap", "replace", "insert", "resume")
_REFUSED_OF_SIMULATION = (
    *("start", "init", "connect", "switch", "setOrder", "close"),
    *("load", "loadState", "saveState", "simulationStep", "step", "executeMove", "addStepListener"),
)


class TraCIException(Exception):  # noqa: N818 - TraCI's own name
    """A command or question that TraCI, or the harness, does not answer."""


class Domain:
    """Part of the facade: what it lacks is refused with the reason, or unknown with a list of what there is."""

    _path: ClassVar[str]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        why = _WHY.get(name) or (_STEPS if name in _REFUSED_OF_SIMULATION else None)
        why = why or (_WOULD_MOVE if name.startswith(_REFUSED_BEGINNINGS) else None)
        if why is None:
            there = ", ".join(entry for entry in dir(self) if not entry.startswith("_") and entry != "see")
            raise AttributeError(f"{self._path} has no {name} here; it has {there}")

        def refused(*_arguments: Any, **_named: Any) -> NoReturn:
            raise TraCIException(f"{self._path}.{name} is refused: {why}.")

        return refused


def _question(about: str, answer_of: Callable[[VehicleDomain], Any]) -> Callable[[VehicleDomain, str], Any]:
    """A question about a vehicle that one of the tables by vehicle answers, or a value that is the same for all."""

    def answer(self: VehicleDomain, vehID: str) -> Any:
        known = answer_of(self)
        return self._of(known if isinstance(known, dict) else dict.fromkeys(self._lane, known), vehID)

    answer.__doc__ = about
    return answer


def _neighbours(name: str, mode: int) -> Callable[..., tuple[tuple[str, float], ...]]:
    def answer(self: VehicleDomain, vehID: str, blockingOnly: bool = False) -> tuple[tuple[str, float], ...]:
        return self.getNeighbors(vehID, mode | 4 * blockingOnly)

    answer.__doc__, answer.__name__ = f"`getNeighbors` in mode {mode}; with ``blockingOnly`` in {mode | 4}.", name
    return answer


def _accepted(name: str, holds: Callable[[Any], bool], what_holds: str) -> Callable[..., None]:
    """A setter of the AV that changes nothing: it is refused unless it asks for what holds anyway."""

    def accept(self: VehicleDomain, vehID: str, value: Any, *_more: Any) -> None:
        self._require_own(vehID, name)
        if not holds(value):
            raise TraCIException(f"vehicle.{name}('{vehID}', {value}) is refused: {what_holds}.")

    accept.__doc__ = f"Accepted as far as it changes nothing: {what_holds}."
    return accept


class VehicleDomain(Domain):
    """``traci.vehicle`` of one cell."""

    _path = "traci.vehicle"

    def __init__(self, set_speed_mps: float = math.nan) -> None:
        self.legacy_leader = True
        self._set_speed = {"LV": MAX_SPEED_MPS, "BV": MAX_SPEED_MPS, VEH_ID: set_speed_mps}
        self._plan: Iterator[float] = iter(())
        """Accelerations (m/s²) of the coming steps; empty without a command."""
        self._command: Callable[[], Iterator[float]] | None = None
        """What begins the plan anew: nothing for a command that is over after a step."""
        self._told = math.nan
        """Speed (m/s) that the AV will have if it does what it is told."""
        self._accel = self._decel = math.inf
        self._speed_mode = _ACCEL | _DECEL
        self._subscribed: dict[str, tuple[int, ...]] = {}
        self._speed: dict[str, float] = {}
        self._position: dict[str, float] = {}
        self._acceleration: dict[str, float] = {}
        self._lane = dict(LANES)
        self._lateral_m = dict.fromkeys(LANES, 0.0)
        self._lateral_mps = dict(self._lateral_m)

    def see(self, now: Observation) -> None:
        """Take in what is there before a step."""
        bv, lv = now.bv, now.lv
        before = self._speed
        self._speed = {"LV": lv.speed_mps, "BV": bv.speed_mps, VEH_ID: now.speed_mps}
        self._position = {"LV": lv.position_m, "BV": bv.position_m, VEH_ID: now.position_m}
        self._lane["BV"] = bv.lane
        # SUMO counts to the left; once BV overlaps it counts as a vehicle of the right lane, in its middle.
        self._lateral_m["BV"] = 0.0 if now.bv_overlaps else -now.bv_lateral_m
        self._lateral_mps["BV"] = -now.bv_lateral_speed_mps
        self._acceleration = {VEH_ID: now.acceleration_mps2, "LV": 0.0, "BV": 0.0}
        if before:
            self._acceleration["LV"] = (lv.speed_mps - before["LV"]) / STEP_S
            self._acceleration["BV"] = (bv.speed_mps - before["BV"]) / STEP_S
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
        self._told = max(0.0, self._speed[VEH_ID] + acceleration * STEP_S)
        return acceleration

    def _of(self, table: dict[str, Any], vehID: str) -> Any:
        try:
            return table[vehID]
        except KeyError:
            raise TraCIException(f"Vehicle '{vehID}' is not known: a cell has LV, BV and AV.") from None

    def getIDList(self) -> tuple[str, ...]:
        """The cell's vehicles."""
        return tuple(self._speed)

    def getIDCount(self) -> int:
        """Their number."""
        return len(self._speed)

    getSpeed = _question("Speed (m/s).", lambda self: self._speed)
    getAcceleration = _question(
        "Acceleration of the last step (m/s²); of LV and BV 0 at the first call.", lambda self: self._acceleration
    )
    getLanePosition = _question("Front bumper along the lane (m).", lambda self: self._position)
    getLateralLanePosition = _question(
        "How far (m) to the left of its lane's middle; a BV that comes over is right of it.",
        lambda self: self._lateral_m,
    )
    getLateralSpeed = _question("Speed (m/s) to the left.", lambda self: self._lateral_mps)
    getLaneIndex = _question("0 right, 1 left.", lambda self: self._lane)
    getRoadID = _question("The cell's road.", lambda _: ROAD)
    getAngle = _question("Heading (degrees, 90 is along x).", lambda _: HEADING_DEGREES)
    getLength = _question("Length (m).", lambda _: VEHICLE_LENGTH_M)
    getMinGap = _question("MinGap (m): zero, so that gaps are bumper to bumper.", lambda _: 0.0)
    getMaxSpeed = _question("Speed (m/s) that the vehicle allows; of the AV that at which it cruises.",
                            lambda self: self._set_speed)  # fmt: skip
    getAllowedSpeed = getMaxSpeed
    getTypeID = _question("Vehicle type.", lambda _: "exact")

    def getPosition(self, vehID: str) -> tuple[float, float]:
        """Front bumper (m) along, and the vehicle's middle across, the cell's own road."""
        along = self._of(self._position, vehID)
        return along, LANE_CENTRES_M[self._lane[vehID]] + self._lateral_m[vehID]

    def getLaneID(self, vehID: str) -> str:
        """Road and lane index."""
        return f"{ROAD}_{self.getLaneIndex(vehID)}"

    def getSpeedMode(self, vehID: str) -> int:
        """What `setSpeedMode` has set; 6 without."""
        self._require_own(vehID, "getSpeedMode", "is not known of traffic")
        return self._speed_mode

    def subscribe(self, objectID: str, varIDs: Sequence[int] | None = None, *_when: float) -> None:
        """Ask for variables (numbers of ``traci.constants``), for the whole test; by default road and position."""
        self._of(self._lane, objectID)
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
        return {number: getattr(self, _VARIABLES[number])(objectID) for number in self._subscribed.get(objectID, ())}

    def getAllSubscriptionResults(self) -> dict[str, dict[int, Any]]:
        """The same of all vehicles that have been subscribed to."""
        return {name: self.getSubscriptionResults(name) for name in self._subscribed}

    def getAccel(self, vehID: str) -> float:
        """Bound that `setAccel` has put on commands (m/s²), infinite without."""
        self._require_own(vehID, "getAccel", "is not known of traffic")
        return self._accel

    def getDecel(self, vehID: str) -> float:
        """Bound that `setDecel` has put on commands (m/s², positive), infinite without."""
        self._require_own(vehID, "getDecel", "is not known of traffic")
        return self._decel

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
        lane = self._of(self._lane, vehID) + (-1 if mode & 1 else 1)
        found = self._nearest(vehID, 1.0 if mode & 2 else -1.0, lane)
        return () if found is None or (mode & 4 and found[1] > 0.0) else (found,)

    getLeftFollowers = _neighbours("getLeftFollowers", 0)
    getRightFollowers = _neighbours("getRightFollowers", 1)
    getLeftLeaders = _neighbours("getLeftLeaders", 2)
    getRightLeaders = _neighbours("getRightLeaders", 3)

    def _nearest(self, vehID: str, direction: float, lane: int | None = None) -> tuple[str, float] | None:
        here = self._of(self._position, vehID)
        lane = self._lane[vehID] if lane is None else lane
        found: tuple[str, float] | None = None
        for other, there in self._position.items():
            distance = direction * (there - here)
            if other == vehID or self._lane[other] != lane or distance < 0.0:
                continue
            # Operation by operation as the observed gap: bit-equal to what other controllers see.
            gap = (there - VEHICLE_LENGTH_M - here) if direction > 0.0 else (here - VEHICLE_LENGTH_M - there)
            if found is None or gap < found[1]:
                found = other, gap
        return found

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
            yield (speed - self._speed[VEH_ID]) / STEP_S

    def _accelerate(self, acceleration: float, duration: float) -> Iterator[float]:
        """For whole steps, and a share of a last one."""
        left = duration / STEP_S
        while left >= _ROUNDING:
            yield acceleration if left > 1.0 - _ROUNDING else acceleration * left
            left -= 1.0

    def _approach(self, target: float, duration: float) -> Iterator[float]:
        start, steps, done = self._speed[VEH_ID], max(duration / STEP_S, 1.0), 0
        while done <= steps - _ROUNDING:
            done += 1
            share = min(1.0, done / steps)
            yield (start + (target - start) * share - self._speed[VEH_ID]) / STEP_S

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

    setLaneChangeMode = _accepted(
        "setLaneChangeMode", lambda mode: not mode & _CHANGES_LANE, "the AV stays on its lane, as in mode 0, 256 or 512"
    )
    setMinGap = _accepted("setMinGap", lambda gap: gap == 0.0, "gaps are bumper to bumper, minGap is 0")
    setLength = _accepted("setLength", lambda length: length == VEHICLE_LENGTH_M, "vehicles are 5 m long")
    setActionStepLength = _accepted("setActionStepLength", lambda step: step == STEP_S, "the AV acts in every 0.1 s")
    setSpeedFactor = _accepted("setSpeedFactor", lambda factor: factor == 1.0, "the speed factor is 1")
    setColor = _accepted("setColor", lambda _: True, "nobody sees a colour")

    def _require_own(self, vehID: str, name: str, why: str = "") -> None:
        if vehID != VEH_ID:
            self._of(self._lane, vehID)
            raise TraCIException(
                f"vehicle.{name}('{vehID}') is refused: {why or _WOULD_MOVE}. Commands are for 'AV' only."
            )


class SimulationDomain(Domain):
    """``traci.simulation`` of one cell."""

    _path = "traci.simulation"

    def __init__(self) -> None:
        self.time_s = 0.0

    def getTime(self) -> float:
        """Time since the episode began (s)."""
        return self.time_s

    def getDeltaT(self) -> float:
        """Step (s)."""
        return STEP_S

    def getMinExpectedNumber(self) -> int:
        """Vehicles that are there as long as a test runs."""
        return len(LANES)

    def getCollidingVehiclesNumber(self) -> int:
        """None: a crash ends the test."""
        return 0

    def getCollidingVehiclesIDList(self) -> tuple[str, ...]:
        """As `getCollidingVehiclesNumber`."""
        return ()

    getCollisions = getArrivedIDList = getCollidingVehiclesIDList


class Traci(Domain):
    """What stands for the module ``traci``: one episode of one cell."""

    TraCIException = TraCIException
    _path = "traci"

    def __init__(self, set_speed_mps: float = math.nan) -> None:
        self.vehicle, self.simulation = VehicleDomain(set_speed_mps), SimulationDomain()
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


class TraciStyleController:
    """Base class: implement `on_step`, and `on_start` if there is anything to forget between episodes.

    Examples
    --------
    >>> class KeepsDistance(TraciStyleController):
    ...     def on_step(self, traci, veh_id, time):
    ...         leader = traci.vehicle.getLeader(veh_id)
    ...         if leader is not None and leader[1] < 30.0:
    ...             traci.vehicle.setAcceleration(veh_id, -3.0, 0.1)
    """

    _traci: Traci

    def on_start(self, random: np.random.Generator) -> None:
        """An episode begins; ``random`` is the only randomness that a controller may use."""

    def on_step(self, traci: Traci, veh_id: str, time: float) -> None:
        """Look around and command ``veh_id``, as after ``traci.simulationStep()``, at this time (s) of the episode."""
        raise NotImplementedError(f"{type(self).__name__} needs on_step(self, traci, veh_id, time)")

    def start(self, episode: EpisodeStart) -> None:
        """See `harness.controllers.VehicleController`."""
        self._traci = Traci(episode.set_speed_mps)
        self.on_start(episode.random)

    def step(self, observation: Observation) -> float:
        """See `harness.controllers.VehicleController`."""
        traci = self._traci
        traci.see(observation)
        self.on_step(traci, VEH_ID, observation.time_s)
        return traci.vehicle.next_acceleration()

    def close(self) -> None:
        """See `harness.controllers.VehicleController`."""


class StepListenerController(TraciStyleController):
    """Runs an object with the shape of ``traci.StepListener``: ``step(t)``, and ``cleanUp()`` if it has one.

    ``listener``, its class, is called for every episode, with the object that stands for ``traci`` and the
    ``parameters``. As under TraCI it is removed when ``step`` returns something false, and the AV then follows its
    last command.
    """

    def __init__(self, listener: Callable[..., Any], **parameters: Any) -> None:
        self._make, self._parameters = listener, parameters
        self._listener: Any = None

    def on_start(self, random: np.random.Generator) -> None:  # noqa: ARG002 - listeners know no randomness
        """Make the episode's listener."""
        self.close()
        self._listener = self._make(self._traci, **deepcopy(self._parameters))

    def on_step(self, traci: Traci, veh_id: str, time: float) -> None:  # noqa: ARG002 - a listener has its own
        """Call the listener with the time (s), as ``traci.simulationStep(time)`` would."""
        if self._listener is not None and not self._listener.step(time):
            self.close()

    def close(self) -> None:
        """Remove the last listener."""
        listener, self._listener = self._listener, None
        clean_up = getattr(listener, "cleanUp", None)
        if clean_up is not None:
            clean_up()
