"""TraCI-style controllers: an existing TraCI or libsumo script moves over with few changes.

``traci`` is an object handed to the controller in place of the module of that name: it reads the AV's own cell and
commands the AV alone.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np

from harness.controllers.protocol import EpisodeStart, Observation
from harness.controllers.traci_facade import VEH_ID, Traci, TraCIException

__all__ = ["StepListenerController", "TraCIException", "TraciStyleController"]


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
        """Look around and command ``veh_id``, as after ``traci.simulationStep()``.

        Parameters
        ----------
        traci : Traci
        veh_id : str
            The AV.
        time : float
            Time since the episode began (s), as ``traci.simulation.getTime()``.
        """
        raise NotImplementedError(f"{type(self).__name__} needs on_step(self, traci, veh_id, time)")

    def start(self, episode: EpisodeStart) -> None:
        """See `harness.controllers.VehicleController`."""
        self._traci = Traci()
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

    A new listener is made for every episode. As under TraCI it is removed when ``step`` returns something false, and
    the AV then follows its last command.

    Parameters
    ----------
    listener : str
        ``package.module:Class``, called with the object that stands for ``traci``.
    **parameters
        Further keyword arguments of the class.
    """

    def __init__(self, listener: str, **parameters: Any) -> None:
        from harness.controllers.loading import controller_class  # noqa: PLC0415 - loading knows the hosts

        self._make: Callable[..., Any] = controller_class(listener)
        self._parameters = parameters
        self._listener: Any = None

    def on_start(self, random: np.random.Generator) -> None:  # noqa: ARG002 - listeners know no randomness
        """Make the episode's listener."""
        self._remove()
        self._listener = self._make(self._traci, **deepcopy(self._parameters))

    def on_step(self, traci: Traci, veh_id: str, time: float) -> None:  # noqa: ARG002 - a listener has its own
        """Call the listener with the time (s), as ``traci.simulationStep(time)`` would."""
        if self._listener is not None and not self._listener.step(time):
            self._remove()

    def _remove(self) -> None:
        listener, self._listener = self._listener, None
        clean_up = getattr(listener, "cleanUp", None)
        if clean_up is not None:
            clean_up()

    def close(self) -> None:
        """Remove the last listener."""
        self._remove()
