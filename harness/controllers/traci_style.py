"""TraCI-style controllers: an existing TraCI or libsumo script moves over with few changes.

It is handed what stands for the module ``traci``: the vehicles of one cell, and commands for the AV alone. Names, units
and answers are those of the ``traci`` package 1.28; docs/controllers.md lists every difference.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from copy import deepcopy
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from harness.controllers.protocol import EpisodeStart, Observation
from harness.controllers.traci_refused import Domain, FatalTraCIError, RefusedError, TraCIException
from harness.controllers.traci_vehicle import VEH_ID, VehicleDomain
from harness.vehicles.kinematics import STEP_S

__all__ = ["StepListenerController", "TraCIException", "TraciStyleController"]
WAITS = (
    "A test is one run of it from its first line: leave out steps that only wait, or set its option for that, "
    "--set av.parameters.NAME=…"
)
"""What to do about a script that waits."""


class TriedScript(NamedTuple):
    """What a TraCI script does when it is tried: for 15 s, in which a car cuts in, and then drives ahead.

    ``step_s`` is the step that it asks for. It is ``idle_s``, looking at no vehicle, before it begins; and ``left_s``
    is how long, with somebody ahead, it gives no command, so that SUMO's own model would drive. ``safe_speeds``: its
    speed mode is SUMO's own, in which safe speeds would bound its commands. The last two are what its vehicle's type
    is left with.
    """

    step_s: float
    idle_s: float
    left_s: float
    safe_speeds: bool
    accel_mps2: float
    decel_mps2: float


class SimulationDomain(Domain):
    """``traci.simulation`` of one cell: a crash ends the test, so that nobody has collided; nobody arrives."""

    _path = "traci.simulation"
    time_s = 0.0

    def getTime(self) -> float:
        return self.time_s

    getDeltaT = staticmethod(lambda: STEP_S)
    getMinExpectedNumber = staticmethod(lambda: 3)
    getCollidingVehiclesNumber = staticmethod(lambda: 0)
    getCollidingVehiclesIDList = getCollisions = getArrivedIDList = staticmethod(tuple)


class Traci(Domain):
    """What stands for the module ``traci``: one episode of one cell."""

    TraCIException, FatalTraCIError = TraCIException, FatalTraCIError
    _path = "traci"

    def __init__(self, set_speed_mps: float = math.nan, lv_name: str = "LV", bv_name: str = "BV") -> None:
        self.vehicle, self.simulation = VehicleDomain(set_speed_mps, VEH_ID, lv_name, bv_name), SimulationDomain()
        self.exceptions = self  # so that ``traci.exceptions.TraCIException`` is found

    @property
    def constants(self) -> ModuleType:
        return importlib.import_module("traci.constants")

    def see(self, now: Observation) -> None:
        """Take in what is there before a step."""
        self.simulation.time_s = now.time_s
        self.vehicle.see(now)

    def setLegacyGetLeader(self, enabled: bool) -> None:
        """Whether `getLeader` answers None (as 1.28 does by default) or ``("", -1.0)`` when nobody is ahead."""
        self.vehicle.legacy_leader = enabled


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
        self._traci = Traci(episode.set_speed_mps, episode.lv_name, episode.bv_name)
        self.on_start(episode.random)

    def step(self, observation: Observation) -> float:
        traci = self._traci
        traci.see(observation)
        self.on_step(traci, VEH_ID, observation.time_s)
        if RefusedError.last is not None:
            raise RefusedError.last
        return traci.vehicle.next_acceleration()


class StepListenerController(TraciStyleController):
    """Runs an object with the shape of ``traci.StepListener``: ``step(t)``, and ``cleanUp()`` if it has one.

    ``listener``, its class, is called in every episode with what stands for ``traci`` and the ``parameters``. As under
    TraCI it is removed when ``step`` returns something false; the AV then follows its last command.
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
