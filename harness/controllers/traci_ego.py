"""Which vehicle a TraCI script commands: it is tried before a car that cuts in, and the one vehicle is the AV."""

from __future__ import annotations

import ast
import io
import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import closing, redirect_stdout
from functools import partial
from itertools import chain, islice
from pathlib import Path

import numpy as np
import sumo_data

from harness.campaign.python_files import TRACI_MODULES, file_and_function
from harness.campaign.vehicle import AutomatedVehicle, TraciStyle
from harness.controllers.hosts import Guard, cause_of
from harness.controllers.protocol import EpisodeStart, Neighbour, Observation
from harness.controllers.traci_script import ScriptController, ScriptTraci, TraciScript
from harness.controllers.traci_style import WAITS, TriedScript
from harness.controllers.traci_vehicle import DECEL, SAFE_SPEED, VEH_ID, SeenVehicle, VehicleDomain
from harness.errors import CampaignError
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M

OTHERS = "LV", "BV", "SV"
SPEED_MPS = 25.0
FAILS = "fails when it is tried before a cut-in"
DRIVES = "setSpeed", "slowDown", "setAcceleration"
COMMANDS_NONE = "commands no vehicle before a cut-in"
NEVER_DRIVES = "gives no speed or acceleration, in 15 s in which a car cuts in, to"


def script_maker(av: AutomatedVehicle, guard: Guard) -> Callable[[], ScriptController]:
    """Makes controllers that run the script ``av.controller``.

    Raises `CampaignError`: it cannot be compiled; or, where ``av.traci_style.ego`` is not given, it fails when it is
    tried before a car that cuts in, or does not command one vehicle there.
    """
    name, style = str(av.controller), av.traci_style
    try:
        script = TraciScript(name, dict(av.parameters))
    except SyntaxError as error:
        found, place = f"{name}, which is no Python", f"{error.msg} in line {error.lineno}"
        raise CampaignError("av.controller", found, "a TraCI script", f"Fix it: {place}.") from error
    os.environ.setdefault("SUMO_HOME", sumo_data.__path__[0])  # as libsumo does: scripts look for it
    if (ego := style.ego) is None:
        with guard:
            answer, cause = guard.call(_found, script, makes=True)
        ego, wrong = answer[:2] if answer else (None, f"{FAILS}: {cause}")
    else:
        wrong = f"calls its vehicle {ego}, as one of the others is called" if ego in OTHERS else ""
    if wrong or ego is None:
        raise _unusable(name, wrong, ego)

    def vehicle(set_speed_mps: float, lv_name: str, bv_name: str) -> VehicleDomain:
        made = VehicleDomain(set_speed_mps, ego, lv_name, bv_name)
        made.setAccel(ego, style.accel_mps2)
        made.setDecel(ego, style.decel_mps2)
        return made

    return partial(ScriptController, script, vehicle)


def _unusable(name: str, wrong: str, ego: str | None) -> CampaignError:
    """The error of a script with which something is ``wrong``, and how to mend it."""
    expected, mend = "a script that commands one vehicle", "Name its vehicle: --set av.traci_style.ego=NAME."
    if wrong.startswith((NEVER_DRIVES, COMMANDS_NONE)):
        mend = f"{WAITS}. If it drives later, --set av.traci_style.ego={ego or 'NAME'}."
    if wrong.startswith(FAILS):
        expected = "a script that gets through a cut-in"
        mend, line = "Fix the script in that line.", re.search(r":(\d+)\)", wrong)
        if lacking := ", ".join(_lacking(name)):
            mend = f"Take out, or replace, {lacking}: docs/controllers.md has the calls that are there."
            if line is not None and f"(line {line[1]})" not in lacking:
                mend = f"Fix the script in that line. {mend}"
        mend += " If it asks for other vehicles, add --set av.traci_style.ego=NAME." if "is not known" in wrong else ""
        if re.search("unknown url type|FileNotFoundError", wrong):  # so says sumolib.net.readNet
            mend += " A file that it reads itself must be there; the road is straight, of two lanes."
    return CampaignError("av.controller", f"{name}, which {wrong}", expected, mend)


def _lacking(name: str) -> Iterator[str]:
    """Calls of ``traci`` in a script that are not there, or refused; with their lines."""
    facade = ScriptTraci(VehicleDomain(SPEED_MPS, VEH_ID))
    tree = ast.parse(Path(file_and_function(name)[0]).read_bytes())
    for node in (each for each in ast.walk(tree) if isinstance(each, ast.Attribute)):
        module, *path = ast.unparse(node).split(".")
        if module in TRACI_MODULES and len(path) == 2:
            function = getattr(getattr(facade, path[0], None), path[1], None)
            if function is None or getattr(function, "__name__", "") == "refused":
                yield f"{'.'.join(path)} (line {node.lineno})"


class _AnyName(str):
    """The AV's name as long as it is not known: equal to any name that a script compares it with (``asked``)."""

    def __init__(self, _name: str) -> None:
        self.asked = dict[str, None]()

    def __eq__(self, other: object) -> bool:
        if type(other) is str and other not in OTHERS:
            self.asked[other] = None
            return True
        return str.__eq__(self, other)

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = str.__hash__


class _Anybody(dict[str, SeenVehicle]):
    """Vehicles by name, where every unknown one is the AV."""

    def __init__(self, there: dict[str, SeenVehicle], ego: _AnyName) -> None:
        super().__init__(there)
        self._ego = ego

    def __missing__(self, name: str) -> SeenVehicle:
        self._ego.asked[name] = None
        return self[self._ego]


class _Tried(VehicleDomain):
    """Notes what a script does.

    Which vehicles it commands, whether it ``drives``, its ``hardest`` braking (m/s²) that its vehicle's type bounds,
    infinite where a speed mode lets nothing bound it, how many steps it is ``idle``, looking at no vehicle, and in how
    many with somebody ahead no command holds: they are ``left`` to SUMO's own model.
    """

    def __init__(self, ego: str) -> None:
        super().__init__(SPEED_MPS, ego)
        self.commanded, self.hardest, self.drives = dict[str, None](), 0.0, False
        self.left = 0
        self.idle, self._looks = -2, False  # the first step is seen at the start, the second after a step
        if isinstance(ego, _AnyName):
            self._seen = _Anybody(self._seen, ego)

    getAccel, getDecel = staticmethod(lambda _: 2.6), staticmethod(lambda _: 4.5)  # of SUMO's default type

    def told(self, every: int, of: TraciStyle) -> TriedScript:
        """What is known of it in the end, where it acts in one of ``every`` steps, and its vehicle is ``of`` a type."""
        step_s, safe = STEP_S * (every or 1), bool(self._speed_mode & SAFE_SPEED)
        accel = self._accel if math.isfinite(self._accel) else of.accel_mps2
        decel = self._decel if math.isfinite(self._decel) else of.decel_mps2
        return TriedScript(step_s, self.idle * step_s, self.left * step_s, safe, accel, decel)

    def next_acceleration(self) -> float:
        told = [*islice(self._plan, 1)]
        own, others = self._own, (self._lv, self._bv)
        ahead = any(other.lane == own.lane and other.position > own.position for other in others)
        self.left += ahead and not told
        self._plan = chain(told, self._plan)
        acceleration = super().next_acceleration()
        if math.isinf(self._decel) and acceleration < 0.0:  # no bound of its own
            self.hardest = max(self.hardest, -acceleration if self._speed_mode & DECEL else math.inf)
        return acceleration

    def see(self, now: Observation) -> None:
        super().see(now)
        self._looks = self._looks and self.idle >= 0  # what comes before a step is no look
        self.idle += not self._looks

    def _of(self, vehID: str) -> SeenVehicle:
        self._looks = True
        return super()._of(vehID)

    def _require_own(self, vehID: str, name: str, why: str = "") -> None:  # noqa: ARG002
        self._of(vehID)
        if name[:3] != "get":
            self.commanded[vehID] = None
        self.drives |= name in DRIVES


def _found(script: TraciScript) -> tuple[str | None, str, _Tried]:
    """Name of the one vehicle that a script commands, or what is wrong with it; and what else it did.

    Names are first taken as they come, each for the AV; those that came are then tried, one after the other.
    """
    anybody = _AnyName(VEH_ID)
    tried, *wrong = _commanded(script, anybody)
    commanded = list(tried.commanded)
    named = [name for name in commanded if name is not anybody]
    for name in dict.fromkeys((named + list(anybody.asked)) or [VEH_ID] * bool(commanded)):
        if len(named) < 2:
            tried, failed = _commanded(script, name)
            named = list(tried.commanded)
            wrong.insert(-1, failed)
        if len(named) > 1:
            return None, f"commands {' and '.join(named)}", tried
        if named == [name] and not failed:
            return name, "" if tried.drives else f"{NEVER_DRIVES} {name}", tried
    why = next(filter(None, wrong), "")
    return None, f"{FAILS}: {why}" if why else COMMANDS_NONE, tried


def _commanded(script: TraciScript, ego: str) -> tuple[_Tried, str]:
    """What a script does when a car cuts in before it; and what it raises."""
    tried = _Tried(ego)
    try:
        # What it prints there is of no test.
        with redirect_stdout(io.StringIO()), closing(ScriptController(script, lambda *_: tried)) as controller:
            _drive(controller)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever a user's code raises
        return tried, cause_of(error)
    return tried, ""


def asked_for(av: AutomatedVehicle) -> tuple[TriedScript, float, int]:
    """What a script does, ``hardest`` of `_Tried`, and the harness's steps in one that it asks for, 0 if none."""
    script, ego = TraciScript(str(av.controller), dict(av.parameters)), av.traci_style.ego
    tried = _Tried(ego or _AnyName(VEH_ID))
    controller = ScriptController(script, lambda *_: tried)
    with (guard := Guard(av.limits)):
        guard.call(_drive, controller, 1, makes=True)
        if ego is None:
            answer, _ = guard.call(_found, script, makes=True)
            tried = answer[-1] if answer else tried
        else:
            answer, _ = guard.call(_commanded, script, ego, makes=True)
            tried = answer[0] if answer else tried
    return tried.told(every := controller.traci.every, av.traci_style), tried.hardest, every


def _drive(controller: ScriptController, n_steps: int = 150) -> None:
    """For ten seconds, in which a car that is 10 m/s slower cuts in 12 m ahead; then five in which it is 40 m ahead."""
    controller.start(EpisodeStart(0, STEP_S, np.random.default_rng(0), SPEED_MPS))
    position = acceleration = 0.0
    speed, bv_position, bv_speed, cut_in = SPEED_MPS, 60.0, SPEED_MPS - 10.0, False
    for step in range(n_steps):
        if step >= 100:
            bv_position, bv_speed = position + VEHICLE_LENGTH_M + 40.0, speed
        gap = bv_position - VEHICLE_LENGTH_M - position
        cut_in = cut_in or gap < 12.0 or step > 60
        ahead = (gap, bv_speed) if cut_in and gap > -10.0 else (math.inf, math.nan)
        bv, lv = Neighbour(bv_position, bv_speed, 0 if cut_in else 1), Neighbour(bv_position + 50.0, bv_speed, 1)
        own = STEP_S * step, position, speed, acceleration
        answer = controller.step(Observation(*own, *ahead, bv, lv, bv_overlaps=cut_in, set_speed_mps=SPEED_MPS))
        acceleration = min(max(answer, -10.0), 3.0)
        speed = max(0.0, speed + STEP_S * acceleration)
        position, bv_position = position + STEP_S * speed, bv_position + STEP_S * bv_speed
