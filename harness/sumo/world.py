"""K cells in one libsumo simulation, moved exactly and checked at every step.

SUMO is told the speed of every vehicle in every step. Its own planning is switched off by an action step of 1000 s,
except for the one step in which BV changes lanes. A finished cell is refilled by moving its three vehicles back:
nothing is removed or added. After each step every position is read back from SUMO and compared, bit for bit, with what
was commanded, and every speed too: with the shim after each step, without it after every tenth. A difference stops the
run.

A speed that SUMO has already been told is not told again: it keeps it until the next command.
"""

from __future__ import annotations

import atexit
import os
import sys
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from harness.arrays import BoolArray, FloatArray, Int8Array, IntArray
from harness.errors import CampaignError, WorldDisagreementError
from harness.outcomes import AV, BV, LV, VEHICLES
from harness.sumo.network import EXACT_OPTIONS, PARKED_M, committed_file, network_file, parked
from harness.sumo.shim import Shim, open_shim
from harness.sumo.system_libraries import not_importable
from harness.twin import advance

try:
    import libsumo
except ImportError as error:
    raise not_importable(str(error)) from error

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

LEFT, RIGHT = 1, 0
NEVER_PLAN_S, PLAN_NOW_S = 1000.0, 0.1
SPEED_CHECK_STEPS = 10


class SumoWorld:
    """World in SUMO; see `harness.world.World`.

    Parameters
    ----------
    n_cells : int
        Episodes side by side.
    vanilla : bool
        Let SUMO plan in every step (action step 0.1 s), as a reference for tests.
    gui : bool
        Show it: the same calls go to a sumo-gui (extra ``harness[sumo]``) over a socket.
    shim : bool
        Use the compiled shim where it is installed; the bits are the same without.
    options : sequence of str
        Further SUMO options, for instance ``--fcd-output``.

    Raises
    ------
    CampaignError
        A simulation already runs in this process: libsumo holds only one.
    """

    _open: ClassVar[bool] = False
    _shim: Shim | None = None

    def __init__(
        self, n_cells: int, *, vanilla: bool = False, gui: bool = False, shim: bool = True, options: Sequence[str] = ()
    ) -> None:
        if SumoWorld._open:
            raise CampaignError(
                "libsumo",
                found="a simulation that already runs in this process",
                expected="one at a time",
                mend="Close the other world first, or use another process.",
            )
        self.x: FloatArray = parked(n_cells)
        self.v: FloatArray = np.zeros((n_cells, 3))
        self._api: Any = _gui_api() if gui else libsumo
        self._vanilla = vanilla
        self._told: FloatArray = np.zeros((n_cells, 3))
        self._n_steps = 0
        self._running = False
        self._names = [[f"{vehicle}{k}" for vehicle in VEHICLES] for k in range(n_cells)]
        self._flat = [name for cell in self._names for name in cell]
        self._cell_of = {name: k for k, cell in enumerate(self._names) for name in cell}
        self._contact: BoolArray = np.zeros(n_cells, np.bool_)
        self._options = tuple(options)
        self._start()
        hot = _hot_functions(self._api)
        self._set_speed, self._get_position, self._get_speed, self._get_collisions, self._simulation_step = hot
        self._shim = open_shim(self._flat) if shim and not gui else None

    @property
    def n_cells(self) -> int:
        """K."""
        return int(self.x.shape[0])

    def _start(self) -> None:
        if self._api is libsumo:
            self._api.start(["sumo", *self._arguments()])
        else:
            _start_gui(self._api, self._arguments())
        self._running = SumoWorld._open = True
        atexit.register(self.close)
        self._populate()

    def _arguments(self) -> list[str]:
        """SUMO's command line, without the name of the program."""
        types = ",".join(map(str, self._type_files()))
        return ["-n", str(network_file(self.n_cells)), "-a", types, *EXACT_OPTIONS, *self._options]

    def _type_files(self) -> list[Path]:
        """Files with the vehicle types."""
        return [committed_file("vehicles.add.xml")]

    def _type_of(self, vehicle: int) -> str:  # noqa: ARG002 - worlds whose AV is of another type look at it
        """Name of the vehicle type of LV, BV or AV."""
        return "vanilla" if self._vanilla else "exact"

    def _populate(self) -> None:
        """Put the vehicles of all cells on the road, parked."""
        for k, names in enumerate(self._names):
            self._api.route.add(f"cell{k}", [f"cell{k}"])
            for vehicle, name in enumerate(names):
                lane, position = str(RIGHT if vehicle == AV else LEFT), str(PARKED_M[vehicle])
                self._api.vehicle.add(
                    name, f"cell{k}", typeID=self._type_of(vehicle), departLane=lane, departPos=position
                )
                self._api.vehicle.setSpeedMode(name, 0)
                self._api.vehicle.setLaneChangeMode(name, 0)
                self._move(k, vehicle, PARKED_M[vehicle], 0.0)
        # A vehicle that is still pending after the first step ignores moveTo: all stand on the road before it.
        self._api.simulationStep()
        if self._shim is not None:
            self._shim.find_vehicles()

    def _move(self, k: int, vehicle: int, x: float, v: float) -> None:
        name = self._names[k][vehicle]
        lane = RIGHT if vehicle == AV else LEFT
        self._api.vehicle.moveTo(name, f"cell{k}_{lane}", x)
        self._api.vehicle.setPreviousSpeed(name, v)
        self._api.vehicle.setSpeed(name, v)

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray) -> None:
        """See `harness.world.World`; positions and speeds are read back and compared."""
        for k in cells.tolist():
            for vehicle in (LV, BV, AV):
                self._move(k, vehicle, float(x[k, vehicle]), float(v[k, vehicle]))
        self.x[cells], self.v[cells], self._told[cells] = x[cells], v[cells], v[cells]
        flat = (3 * cells[:, None] + np.arange(3)).ravel().tolist()
        self._require_equal("m", self._get_position, self.x, flat)
        self._require_equal("m/s", self._get_speed, self.v, flat)

    def step(self, speed: FloatArray, cut_in: Int8Array) -> BoolArray:
        """See `harness.world.World`."""
        changing = cut_in.nonzero()[0].tolist()
        for k in changing:
            self._begin_cut_in(self._names[k][BV])
        advance(self.x, self.v, speed)
        if self._shim is not None:
            if not self._shim.step(speed, self._told, self.x, self.v):
                self._read_released()
                self._require_as_read(self._shim)
        else:
            self._tell(speed)
            self._simulation_step(0.0)
            self._read_released()
            self._require_equal("m", self._get_position, self.x)
            self._n_steps += 1
            if self._n_steps % SPEED_CHECK_STEPS == 0:
                self._require_equal("m/s", self._get_speed, self.v)
        for k in changing:
            self._end_cut_in(k)
        return self._contacts()

    def _require_as_read(self, shim: Shim) -> None:
        """Ask again, and by libsumo's getters, where the shim has read other values than are wanted now."""
        if not np.array_equal(shim.position, self.x.ravel()):
            self._require_equal("m", self._get_position, self.x)
        if not np.array_equal(shim.speed, self.v.ravel()):
            self._require_equal("m/s", self._get_speed, self.v)

    def _read_released(self) -> None:
        """Take over from SUMO the state of vehicles that were not commanded: here all are."""

    def _tell(self, speed: FloatArray) -> None:
        """Command the speeds that differ from the last ones commanded."""
        told, wanted = self._told.ravel(), speed.ravel()
        changed = np.flatnonzero(told != wanted)
        names = map(self._flat.__getitem__, changed.tolist())
        deque(map(self._set_speed, names, wanted[changed].tolist()), maxlen=0)
        told[changed] = wanted[changed]

    def _begin_cut_in(self, name: str) -> None:
        if not self._vanilla:
            self._api.vehicle.setActionStepLength(name, PLAN_NOW_S, True)
        self._api.vehicle.changeLane(name, RIGHT, 0.0)

    def _end_cut_in(self, k: int) -> None:
        name = self._names[k][BV]
        if not self._vanilla:
            self._api.vehicle.setActionStepLength(name, NEVER_PLAN_S, True)
        lane = self._api.vehicle.getLaneIndex(name)
        if lane != RIGHT:
            raise _disobeyed(f"{name}, lane", lane, RIGHT)

    def _require_equal(
        self, unit: str, getter: Callable[[str], float], expected: FloatArray, flat: Sequence[int] | None = None
    ) -> None:
        """Every value that SUMO reports must be the commanded one, in every bit."""
        names = self._flat if flat is None else [self._flat[i] for i in flat]
        wanted = (expected.ravel() if flat is None else expected.ravel()[flat]).tolist()
        if (read := list(map(getter, names))) != wanted:
            at = next(i for i, value in enumerate(read) if value != wanted[i])
            raise _disobeyed(f"{names[at]}, {unit}", read[at], wanted[at])

    def _contacts(self) -> BoolArray:
        """Cells with a collision in this step.

        SUMO's shorter list of colliding vehicles names a pair only when its collision is new. A pair that collided at
        the end of one episode and again in the first step of the next would be missed.
        """
        self._contact[:] = False
        for collision in self._get_collisions():
            self._contact[self._cell_of[collision.collider]] = True
        return self._contact

    def close(self) -> None:
        """End the simulation; a world that is closed already leaves alone what others have opened since."""
        if self._running:
            self._running = SumoWorld._open = False
            if self._shim is not None:
                self._shim.close()
            atexit.unregister(self.close)
            self._api.close()


class _Hot(NamedTuple):
    """What is called in every step, without libsumo's Python wrappers where possible: they cost a quarter."""

    set_speed: Callable[[str, float], None]
    get_position: Callable[[str], float]
    get_speed: Callable[[str], float]
    get_collisions: Callable[[], Sequence[Any]]
    simulation_step: Callable[[float], object]


def _hot_functions(api: Any) -> _Hot:
    inner = getattr(api, "_libsumo", None)
    if inner is None:
        vehicle, simulation = api.vehicle, api.simulation
        return _Hot(
            vehicle.setSpeed, vehicle.getLanePosition, vehicle.getSpeed, simulation.getCollisions, api.simulationStep
        )
    return _Hot(
        inner.vehicle_setSpeed,
        inner.vehicle_getLanePosition,
        inner.vehicle_getSpeed,
        inner.simulation_getCollisions,
        inner.simulation_step,
    )


def _gui_api() -> Any:
    import traci  # noqa: PLC0415 - comes with libsumo, wanted only here

    return traci


def _gui_binary() -> str:
    """Path of sumo-gui.

    Raises
    ------
    CampaignError
        The extra that brings it is not installed.
    """
    try:
        import sumo  # noqa: PLC0415 - an extra
    except ImportError:
        raise CampaignError(
            "--gui", found="no sumo-gui", expected="the extra 'sumo'", mend="Install it: pip install 'harness[sumo]'."
        ) from None
    return str(Path(sumo.SUMO_HOME) / "bin" / "sumo-gui")


def _start_gui(traci: Any, arguments: Sequence[str]) -> None:
    """Start sumo-gui and connect to it.

    Raises
    ------
    CampaignError
        It is not installed, or has no screen to open its window on.
    """
    command = [_gui_binary(), "--start", "--delay", "100", *arguments]
    display = os.environ.get("DISPLAY")
    if sys.platform.startswith("linux") and not display:
        raise _no_window("no screen (the environment variable DISPLAY is not set)")
    try:
        traci.start(command)
    except (traci.TraCIException, traci.FatalTraCIError) as error:
        raise _no_window(f"a sumo-gui that cannot be reached ({error}; DISPLAY is {display})") from error


def _no_window(found: str) -> CampaignError:
    return CampaignError(
        "--gui",
        found=found,
        expected="a desktop that sumo-gui can open its window on",
        mend="Start it from a desktop session (or with ssh -X), or write the motion to a file: --out FILE.csv.",
    )


def _disobeyed(where: str, found: float, expected: float) -> WorldDisagreementError:
    return WorldDisagreementError(
        f"SUMO, {where}",
        found=float(found).hex(),
        expected=f"{float(expected).hex()}, as commanded",
        mend="The bits are promised for libsumo 1.28.0; check `pip show libsumo`. Otherwise please report it.",
    )
