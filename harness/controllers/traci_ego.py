"""Which vehicle a TraCI script commands: it is tried before a car that cuts in, and the one vehicle is the AV."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import partial

import numpy as np
import sumo_data

from harness.campaign.vehicle import AutomatedVehicle
from harness.controllers.hosts import Guard
from harness.controllers.protocol import EpisodeStart, Neighbour, Observation
from harness.controllers.traci_script import Script, ScriptController
from harness.controllers.traci_vehicle import VEH_ID, Seen, VehicleDomain
from harness.errors import CampaignError
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M

OTHERS = "LV", "BV"


def script_maker(av: AutomatedVehicle, guard: Guard) -> Callable[[], ScriptController]:
    """Makes controllers that run the script ``av.controller``.

    Raises `CampaignError`: it cannot be compiled; or, where ``av.traci_style.ego`` is not given, it fails when it is
    tried before a car that cuts in, or does not command one vehicle there.
    """
    name, style = str(av.controller), av.traci_style
    try:
        script = Script(name, dict(av.parameters))
    except SyntaxError as error:
        found, place = f"{name}, which is no Python", f"{error.msg} in line {error.lineno}"
        raise CampaignError("av.controller", found, "a TraCI script", f"Mend it: {place}.") from error
    os.environ.setdefault("SUMO_HOME", sumo_data.__path__[0])  # as libsumo does: scripts look for it
    ego, found, mend = style.ego, "", "Name its vehicle: --set av.traci_style.ego=NAME."
    if ego in OTHERS:
        ego, found = None, f"a script whose vehicle is called {ego}, as one of the others in every test"
    elif ego is None:
        with guard:
            commanded, wrong = guard.call(_commanded_by, script, makes=True)
        if wrong is not None:
            found, mend = f"{name}, which fails when it is tried before a cut-in: {wrong}", "Mend the script."
        elif len(commanded) != 1:
            found = f"{name}, which commands {' and '.join(commanded) or 'no vehicle'} when it is tried before a cut-in"
        else:
            (ego,) = commanded
    if ego is None:
        raise CampaignError("av.controller", found, "a script that commands one vehicle", mend)

    def vehicle(set_speed_mps: float) -> VehicleDomain:
        made = VehicleDomain(set_speed_mps, ego)
        for bound, value in (made.setAccel, style.accel_mps2), (made.setDecel, style.decel_mps2):
            if value is not None:
                bound(ego, value)
        return made

    return partial(ScriptController, script, vehicle)


class _AnyName(str):
    """The AV's name as long as nobody knows it: whatever a script holds it against, which is ``asked``."""

    asked: set[str]

    def __eq__(self, other: object) -> bool:
        if type(other) is str and other not in (*OTHERS, VEH_ID):
            self.asked.add(other)
            return True
        return str.__eq__(self, other)

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = str.__hash__


class _Anybody(dict[str, Seen]):
    """Vehicles by name, where every unknown one is the AV."""

    def __missing__(self, name: str) -> Seen:
        return self[VEH_ID]


class _Tried(VehicleDomain):
    """Notes which vehicles a script commands."""

    def __init__(self, set_speed_mps: float) -> None:
        self.any_name = _AnyName(VEH_ID)
        self.any_name.asked = set()
        super().__init__(set_speed_mps, self.any_name)
        self._seen = _Anybody(self._seen)
        self.commanded = dict[str, None]()

    def _require_own(self, vehID: str, name: str, why: str = "") -> None:  # noqa: ARG002
        if name[:3] != "get":
            self.commanded[vehID] = None

    def names(self) -> list[str]:
        """Those commanded; one without a name of its own is the one that was asked for, or AV."""
        named = [name for name in self.commanded if name is not self.any_name]
        if len(named) < len(self.commanded):
            named += [name for name in sorted(self.any_name.asked) or [VEH_ID] if name not in named]
        return named


def _commanded_by(script: Script) -> list[str]:
    """Names of the vehicles that a script commands, when a car cuts in 12 m before it that is 10 m/s slower."""
    tried = _Tried(25.0)
    controller = ScriptController(script, lambda _: tried)
    controller.start(EpisodeStart(0, STEP_S, np.random.default_rng(0), 25.0))
    position = acceleration = 0.0
    speed, bv_position, cut_in = 25.0, 60.0, False
    for step in range(100):
        gap = bv_position - VEHICLE_LENGTH_M - position
        cut_in = cut_in or gap < 12.0 or step > 60
        ahead = (gap, 15.0) if cut_in else (math.inf, math.nan)
        bv, lv = Neighbour(bv_position, 15.0, 0 if cut_in else 1), Neighbour(bv_position + 50.0, 15.0, 1)
        own = STEP_S * step, position, speed, acceleration
        answer = controller.step(Observation(*own, *ahead, bv, lv, bv_overlaps=cut_in, set_speed_mps=25.0))
        acceleration = min(max(answer, -10.0), 3.0)
        speed = max(0.0, speed + STEP_S * acceleration)
        position, bv_position = position + STEP_S * speed, bv_position + STEP_S * 15.0
    controller.close()
    return tried.names()
