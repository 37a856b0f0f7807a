"""K cells in one libsumo simulation: every speed is commanded, and every position compared after each step.

SUMO keeps a commanded speed until the next command. A finished cell is refilled by moving its vehicles back: nothing is
removed or added. After each step every position is read back and compared, bit for bit, with what was commanded. Speeds
are compared after each step with the optional compiled shim (`shim.cpp`, built when the package is installed, where
there is a C++ compiler); without it, or with ``HARNESS_SHIM=0``, after every tenth. A difference stops the run.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import struct
import sys
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache
from itertools import compress
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar
from weakref import finalize

import numpy as np

from harness.errors import CampaignError, WorldDisagreementError
from harness.processes import SharedFile
from harness.vocabulary import VEHICLES, BoolArray, FloatArray, Int8Array, IntArray
from harness.worlds import MOST_SUMO_CELLS, World
from harness.worlds.system_libraries import SUMO_VERSION, not_importable
from harness.worlds.twin import advance

EXACT_OPTIONS = (
    "--step-length", "0.1", "--step-method.ballistic", "true", "--collision.action", "warn",
    "--collision.mingap-factor", "0", "--time-to-teleport", "-1", "--default.speeddev", "0", "--no-step-log", "true",
    "--no-warnings", "true", "--xml-validation", "never", "--xml-validation.net", "never",
)  # fmt: skip
"""Ballistic update; collisions reported and otherwise ignored; no teleports; nothing random."""

LEFT, RIGHT = 1, 0
OBEY = 0
"""Speed mode in which commands are taken as they are."""
NEVER_PLAN_S, PLAN_NOW_S = 1000.0, 0.1
"""Action steps: SUMO's own planning is switched off, except for the one step in which BV changes lanes."""
NETWORKS = Path(__file__).parents[1] / "sumo_networks"
PARKED_M = 100.0
"""Distance between the vehicles of a cell that has not been given a test, and of the last from the road's beginning."""


class SumoCells(World):
    """K roads in a SUMO, each with V vehicles, of types that are in ``vehicles.add.xml`` and ``_more_types``."""

    _type = _av_type = "exact"
    _more_types: Sequence[SharedFile] = ()

    def __init__(self, n_cells: int, vehicles: Sequence[str] = VEHICLES) -> None:
        super().__init__(n_cells, vehicles)
        self._parked = PARKED_M * np.arange(len(vehicles), 0, -1)
        self._park(np.arange(n_cells))
        self._names = [[f"{vehicle}{k}" for vehicle in vehicles] for k in range(n_cells)]
        self._flat = [name for cell in self._names for name in cell]
        self._cell_of = {name: k for k, cell in enumerate(self._names) for name in cell}

    def _park(self, cells: Any) -> None:
        self.x[cells], self.v[cells] = self._parked, 0.0

    def _arguments(self) -> list[str]:
        """SUMO's command line, without the name of the program."""
        types = as_shared(NETWORKS / "vehicles.add.xml"), *self._more_types
        network = as_shared(network_file(self.n_cells))
        return ["-n", str(network.path), "-a", ",".join(str(each.path) for each in types), *EXACT_OPTIONS]

    def _populate(self, api: Any) -> None:
        """Put the vehicles of all cells on the road, parked."""
        self.lane[:], self.lane[:, -1] = LEFT, RIGHT
        for k, names in enumerate(self._names):
            api.route.add(f"cell{k}", [f"cell{k}"])
            for vehicle, (name, position) in enumerate(zip(names, self._parked.tolist(), strict=True)):
                lane, kind = (RIGHT, self._av_type) if name is names[-1] else (LEFT, self._type)
                api.vehicle.add(name, f"cell{k}", typeID=kind, departLane=str(lane), departPos=str(position))
                api.vehicle.setSpeedMode(name, OBEY)
                api.vehicle.setLaneChangeMode(name, 0)
                self._move(api.vehicle, k, vehicle, position, 0.0, lane)
        # A vehicle that is still pending after the first step ignores moveTo: all stand on the road before it.
        api.simulationStep()

    def _put(self, vehicle_api: Any, cells: IntArray, x: FloatArray, v: FloatArray, lane: Int8Array) -> None:
        """Move the vehicles of the given cells (n,) to ``x[cells]``, at ``v[cells]``, on ``lane[cells]``.

        SUMO keeps a list of the vehicles on each lane. It does not sort it again when a vehicle is moved within its
        lane, but puts one that comes from another lane at the right place. Vehicles may have changed their order (in a
        crash one runs through another): so of several that stay on a lane, all but one are moved to the other lane
        first, and those that change lanes are moved last.
        """
        for k, positions, speeds in zip(cells.tolist(), x[cells].tolist(), v[cells].tolist(), strict=True):
            changes = (lane[k] != self.lane[k]).tolist()
            to_lane = lane[k].tolist()
            stay: dict[int, int] = {}
            for vehicle, on_lane in enumerate(to_lane):
                if not changes[vehicle] and stay.setdefault(on_lane, vehicle) != vehicle:
                    vehicle_api.moveTo(self._names[k][vehicle], f"cell{k}_{1 - on_lane}", positions[vehicle])
                    changes[vehicle] = True
            for vehicle in sorted(range(len(changes)), key=changes.__getitem__):
                self._move(vehicle_api, k, vehicle, positions[vehicle], speeds[vehicle], to_lane[vehicle])
        self.x[cells], self.v[cells], self.lane[cells] = x[cells], v[cells], lane[cells]

    def _move(self, vehicle_api: Any, k: int, vehicle: int, x: float, v: float, lane: int) -> None:
        name = self._names[k][vehicle]
        vehicle_api.moveTo(name, f"cell{k}_{lane}", x)
        vehicle_api.setPreviousSpeed(name, v)
        vehicle_api.setSpeed(name, v)

    def _change_lanes(self, vehicle_api: Any, lane: Int8Array) -> list[tuple[str, int]]:
        """Command all changes to other lanes (K, V) in this step; returns the vehicles' names and their new lanes."""
        if lane.tobytes() == self.lane.tobytes():  # in most steps, and ten times faster to see
            return []
        changing = [(self._names[k][i], int(lane[k, i])) for k, i in np.argwhere(lane != self.lane).tolist()]
        for name, new_lane in changing:
            self._plan_every(vehicle_api, PLAN_NOW_S, name)
            vehicle_api.changeLane(name, new_lane, 0.0)
        return changing

    def _plan_every(self, vehicle_api: Any, seconds: float, name: str) -> None:
        vehicle_api.setActionStepLength(name, seconds, True)

    def _contacts(self, get_collisions: Callable[[], Iterable[Any]]) -> BoolArray:
        """Cells with a collision in this step; SUMO's list of colliding vehicles has those that are new alone."""
        self._contact[:] = False
        for collision in get_collisions():
            self._contact[self._cell_of[collision.collider]] = True
        return self._contact


def network_file(n_cells: int) -> Path:
    """Smallest committed network with at least ``n_cells`` roads, of which there are at most `MOST_SUMO_CELLS`."""
    return NETWORKS / ("highway-1.net.xml" if n_cells == 1 else f"highway-{MOST_SUMO_CELLS}.net.xml")


@cache
def as_shared(file: Path) -> SharedFile:
    """A file under a path that SUMO takes as it is: it splits others at commas, and fills in ``${HOME}``."""
    return SharedFile(file.read_bytes())


def sumo_program(name: str, where: str) -> Path:
    """``sumo`` or ``sumo-gui`` of the extra ``harness[sumo]``, which ``where`` in a campaign or call needs."""
    with suppress(ImportError):
        import sumo  # noqa: PLC0415 - an extra

        if (path := Path(str(sumo.SUMO_HOME)) / "bin" / name).exists():
            return path
    mend = "Install it, in the harness's folder: pip install -c requirements.lock -e '.[sumo]'."
    raise CampaignError(where, f"no {name}", "the extra 'sumo'", mend)


_POINTER = ctypes.c_void_p
_OBEYED, _FAILED = 0, 1


def shim_library() -> Path | None:
    """The compiled shim, or None where there is none or it is switched off."""
    if os.environ.get("HARNESS_SHIM") == "0":
        return None
    return next(iter(sorted(Path(__file__).parent.glob("_shim*.so"))), None)


def open_shim(names: Sequence[str], told: FloatArray, x: FloatArray, v: FloatArray) -> Shim | None:
    """Shim for the given vehicles, or None: not built, switched off, or another libsumo than it knows."""
    if (path := shim_library()) is None:
        return None
    import libsumo  # noqa: PLC0415 - takes half a second, and only worlds need it

    try:
        library = ctypes.CDLL(str(path))
        library.shim_open.restype = _POINTER
        library.shim_find_vehicles.argtypes = [_POINTER]
        library.shim_step.argtypes = [_POINTER] * 7
        library.shim_error.restype = ctypes.c_char_p
        library.shim_error.argtypes = library.shim_close.argtypes = [_POINTER]
    except (OSError, AttributeError):
        return None  # built for another machine, or by an earlier version
    encoded = (ctypes.c_char_p * len(names))(*map(str.encode, names))
    handle = library.shim_open(libsumo._libsumo.__file__.encode(), encoded, ctypes.c_long(len(names)))
    return Shim(library, handle, told, x, v) if handle else None


class Shim:
    """Commands, reads and compares the vehicles of a simulation in one call, in arrays (n,) that are never moved.

    ``told`` are the last commanded speeds (m/s), ``x`` and ``v`` positions and speeds as they should be after the
    coming step, ``position`` (m) and ``speed`` those that SUMO reports.
    """

    def __init__(self, library: ctypes.CDLL, handle: int, told: FloatArray, x: FloatArray, v: FloatArray) -> None:
        self.told, self.x, self.v, self.position, self.speed = told, x, v, np.zeros(x.size), np.zeros(x.size)
        self._library, self._handle = library, handle
        finalize(self, library.shim_close, handle)
        self._wanted = np.zeros_like(told)
        arrays = self._wanted, told, x, v, self.position, self.speed
        self._addresses = [array.ctypes.data for array in arrays]  # slower to get than the call itself takes
        self.find_vehicles()

    def find_vehicles(self) -> None:
        """Look the vehicles up again (`RuntimeError`: one is not there): those of an earlier simulation are gone."""
        if self._library.shim_find_vehicles(self._handle):
            raise self._error()

    def step(self, speed: FloatArray) -> bool:
        """Command the speeds that differ from ``told`` (and note them there), simulate one step, read all vehicles.

        Returns whether every position and speed is that of ``x`` and ``v``, in every bit. Raises `RuntimeError`: SUMO
        raised an error, or a vehicle has left the road.
        """
        self._wanted[:] = speed
        answer: int = self._library.shim_step(self._handle, *self._addresses)
        if answer == _FAILED:
            raise self._error()
        return answer == _OBEYED

    def _error(self) -> RuntimeError:
        return RuntimeError(self._library.shim_error(self._handle).decode())


SPEED_CHECK_STEPS = 10


class SumoWorld(SumoCells):
    """World in SUMO, one in a process: libsumo holds no more; see `harness.worlds.World`.

    ``shim`` uses the compiled shim where it is installed, with the same bits.
    """

    _open: ClassVar[bool] = False
    _shim: Shim | None = None
    lent = dict[str, Any]()

    def __init__(self, n_cells: int, vehicles: Sequence[str] = VEHICLES, *, shim: bool = True) -> None:
        if SumoWorld._open:
            mend = "Close the other world first, or use another process."
            raise CampaignError("libsumo", "a simulation that already runs in this process", "one at a time", mend)
        super().__init__(n_cells, vehicles)
        self._told: FloatArray = np.zeros_like(self.x)
        self._n_steps = 0
        self._running = False
        self._api: Any = start_libsumo(self._arguments())
        self._running = SumoWorld._open = True
        atexit.register(self.close)
        self._populate(self._api)
        # What is called in every step is called without libsumo's Python wrappers, which cost a quarter.
        inner = self._api._libsumo
        self._get_position, self._get_speed = inner.vehicle_getLanePosition, inner.vehicle_getSpeed
        self._set_speed, self._simulation_step = inner.vehicle_setSpeed, inner.simulation_step
        self._get_collisions = inner.simulation_getCollisions
        self._shim = open_shim(self._flat, self._told, self.x, self.v) if shim else None
        self.lent.clear()

    def load_again(self) -> None:
        """Begin a new simulation, all vehicles parked."""
        self._api.load(self._arguments())
        self._populate(self._api)
        self._told[:] = 0.0
        if self._shim is not None:
            self._shim.find_vehicles()

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray, lane: Int8Array) -> None:
        """Positions and speeds are read back and compared."""
        self._put(self._api.vehicle, cells, x, v, lane)
        self._told[cells] = v[cells]
        names = [name for k in cells.tolist() for name in self._names[k]]
        self._require_equal("m", self._get_position, x[cells], names)
        self._require_equal("m/s", self._get_speed, v[cells], names)

    def step(self, speed: FloatArray, lane: Int8Array) -> BoolArray:
        changing = self._change_lanes(self._api.vehicle, lane)
        advance(self.x, self.v, speed)
        if self._shim is None:
            self._tell(speed)
            self._simulation_step(0.0)
            self._read_released()
            self._require_equal("m", self._get_position, self.x)
            self._n_steps += 1
            if self._n_steps % SPEED_CHECK_STEPS == 0:
                self._require_equal("m/s", self._get_speed, self.v)
        elif not self._shim.step(speed):
            self._read_released()
            # Libsumo's getters are asked again only where the shim has read other values than are wanted now.
            if not np.array_equal(self._shim.position, self.x.ravel()):
                self._require_equal("m", self._get_position, self.x)
            if not np.array_equal(self._shim.speed, self.v.ravel()):
                self._require_equal("m/s", self._get_speed, self.v)
        for name, new_lane in changing:
            self._plan_every(self._api.vehicle, NEVER_PLAN_S, name)
            if (lane_index := self._api.vehicle.getLaneIndex(name)) != new_lane:
                raise _disobeyed(f"{name}, lane", lane_index, new_lane)
        self.lane[:] = lane
        return self._contacts(self._get_collisions)

    def _read_released(self) -> None:
        """Take over from SUMO the state of vehicles that were not commanded: here all are."""

    def _tell(self, speed: FloatArray) -> None:
        """Command the speeds that differ from the last ones commanded."""
        changed = self._told != speed
        names = compress(self._flat, changed.tobytes())
        deque(map(self._set_speed, names, speed[changed].tolist()), maxlen=0)
        self._told[:] = speed

    def _require_equal(
        self, unit: str, getter: Callable[[str], float], expected: FloatArray, names: Sequence[str] | None = None
    ) -> None:
        """Every value that SUMO reports of vehicles (default: all) must be the commanded one, in every bit."""
        names = names or self._flat
        read = list(map(getter, names))
        if struct.pack(f"{len(read)}d", *read) != expected.tobytes():  # a third faster than to compare numbers
            for name, value, target in zip(names, read, expected.ravel().tolist(), strict=True):
                if value != target:  # all but a zero's sign
                    raise _disobeyed(f"{name}, {unit}", value, target)

    def close(self) -> None:
        """End the simulation; a world that is closed already leaves alone what others have opened since."""
        if self._running:
            self._running = SumoWorld._open = False
            atexit.unregister(self.close)
            self._api.close()


def _disobeyed(where: str, found: float, expected: float) -> WorldDisagreementError:
    mend = f"The bits are promised for libsumo {SUMO_VERSION}; check `pip show libsumo`. Otherwise please report it."
    wanted = f"{float(expected).hex()}, as commanded"
    return WorldDisagreementError(f"SUMO, {where}", float(found).hex(), wanted, mend)


def start_libsumo(arguments: Sequence[str]) -> Any:
    """Start a simulation in this process; returns libsumo, which takes half a second to import."""
    try:
        import libsumo  # noqa: PLC0415 - see above
    except ImportError as error:
        raise not_importable(str(error)) from error
    libsumo = vars(libsumo).get("__wrapped__", libsumo)
    libsumo.start(["sumo", *arguments])
    # Only a vehicle imports libsumo from now on: what it takes from there is noted, to explain a disagreement.
    attributes = {key: value for key, value in vars(libsumo).items() if key[:2] == "__"}
    attributes["__getattr__"] = lambda name: SumoWorld.lent.setdefault(name, getattr(libsumo, name))
    sys.modules["libsumo"] = module = ModuleType("libsumo")
    vars(module).update(attributes, __all__=dir(libsumo), __wrapped__=libsumo)
    return libsumo
