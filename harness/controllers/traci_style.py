"""TraCI-style controllers: an existing TraCI or libsumo script moves over with few changes.

``traci`` is an object handed to the controller in place of the module of that name: TraCI's own names over the three
vehicles of the AV's cell, commands for the AV alone. Names, units and answers are those of the ``traci`` package 1.28;
docs/controllers.md lists every difference. What a script may not do here is refused with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any, ClassVar, NoReturn

import numpy as np

from harness.controllers.protocol import EpisodeStart, Observation
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M

__all__ = ["StepListenerController", "TraCIException", "TraciStyleController"]

VEH_ID = "AV"
ROAD = "cell0"
LANE_CENTRES_M = (-1.6, 1.6)
MAX_SPEED_MPS = 100.0
HEADING_DEGREES = 90.0
_ROUNDING = 1e-9

_WOULD_MOVE = "it would move vehicles past the harness and invalidate the likelihood ratios"
_STEPS = "the harness itself starts, steps and ends the simulation"
_WHY = {
    "setSpeedMode": "it has no effect here: what the AV is told it does exactly, as under speed mode 32",
    "setLaneChangeMode": "it has no effect here: the AV stays on its lane",
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


class VehicleDomain(Domain):
    """``traci.vehicle`` of one cell."""

    _path = "traci.vehicle"

    def __init__(self, set_speed_mps: float = math.nan) -> None:
        self.legacy_leader = True
        self._set_speed = {"LV": MAX_SPEED_MPS, "BV": MAX_SPEED_MPS, VEH_ID: set_speed_mps}
        self._plan: Iterator[float] = iter(())
        """Accelerations (m/s²) of the coming steps; empty without a command."""
        self._accel = self._decel = math.inf
        self._speed: dict[str, float] = {}
        self._position: dict[str, float] = {}
        self._acceleration: dict[str, float] = {}
        self._lane = {"LV": 1, "BV": 1, VEH_ID: 0}
        self._lateral_m = {"LV": 0.0, "BV": 0.0, VEH_ID: 0.0}
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

    def next_acceleration(self) -> float:
        """What the AV is told for the coming step (m/s²); without a command it keeps its speed."""
        acceleration = next(self._plan, None)
        return 0.0 if acceleration is None else min(max(acceleration, -self._decel), self._accel)

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

    def _nearest(self, vehID: str, direction: float) -> tuple[str, float] | None:
        here, lane = self._of(self._position, vehID), self._lane[vehID]
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
        self._plan = iter(()) if speed < 0.0 else self._hold(_finite(speed))

    def setAcceleration(self, vehID: str, acceleration: float, duration: float) -> None:
        """Accelerate (m/s²) for a duration (s)."""
        self._require_own(vehID, "setAcceleration")
        if duration < 0.0:
            raise TraCIException("Duration must not be negative.")
        self._plan = self._accelerate(_finite(acceleration), duration)

    def slowDown(self, vehID: str, speed: float, duration: float) -> None:
        """Change speed linearly to a value (m/s) in a duration (s)."""
        self._require_own(vehID, "slowDown")
        if not speed >= 0.0:
            raise TraCIException("Speed must not be negative.")
        if duration < 0.0:
            raise TraCIException("Invalid time interval.")
        self._plan = self._approach(self._speed[VEH_ID], _finite(speed), duration)

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

    def _approach(self, start: float, target: float, duration: float) -> Iterator[float]:
        steps, done = max(duration / STEP_S, 1.0), 0
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


class Traci(Domain):
    """What stands for the module ``traci``: one episode of one cell."""

    TraCIException = TraCIException
    _path = "traci"

    def __init__(self, set_speed_mps: float = math.nan) -> None:
        self.vehicle, self.simulation = VehicleDomain(set_speed_mps), SimulationDomain()
        self.exceptions = self  # so that ``traci.exceptions.TraCIException`` is found

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
