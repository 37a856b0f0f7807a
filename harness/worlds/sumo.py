"""K cells in one libsumo simulation: told every speed, and every position compared with it after each step.

SUMO is told the speed of every vehicle in every step; a speed that it has been told already it keeps until the next
command. A finished cell is refilled by moving its three vehicles back: nothing is removed or added. After each step
every position is read back from SUMO and compared, bit for bit, with what was commanded, and every speed too: with the
shim after each step, without it after every tenth. A difference stops the run.
"""

from __future__ import annotations

import atexit
import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from harness.errors import CampaignError, WorldDisagreementError
from harness.vocabulary import AV, BV, LV, BoolArray, FloatArray, Int8Array, IntArray
from harness.worlds.cells import NEVER_PLAN_S, PLAN_NOW_S, RIGHT, SumoCells, sumo_program
from harness.worlds.shim import Shim, open_shim
from harness.worlds.system_libraries import not_importable
from harness.worlds.twin import advance

try:
    import libsumo
except ImportError as error:
    raise not_importable(str(error)) from error

SPEED_CHECK_STEPS = 10


class SumoWorld(SumoCells):
    """World in SUMO; see `harness.worlds.protocol.World`.

    Parameters
    ----------
    n_cells : int
        Episodes side by side.
    vanilla : bool
        Let SUMO plan in every step (action step 0.1 s), as a reference for tests.
    gui : bool
        Show it, in a sumo-gui.
    shim : bool
        Use the compiled shim where it is installed; the bits are the same without.
    options : sequence of str
        Further SUMO options, for instance ``--fcd-output``.

    Raises `CampaignError`: a simulation already runs in this process: libsumo holds only one.
    """

    _open: ClassVar[bool] = False
    _shim: Shim | None = None

    def __init__(
        self, n_cells: int, *, vanilla: bool = False, gui: bool = False, shim: bool = True, options: Sequence[str] = ()
    ) -> None:
        if SumoWorld._open:
            raise CampaignError(
                "libsumo",
                "a simulation that already runs in this process",
                "one at a time",
                "Close the other world first, or use another process.",
            )
        super().__init__(n_cells)
        self._vanilla = vanilla
        self._told: FloatArray = np.zeros((n_cells, 3))
        self._n_steps = 0
        self._running = False
        self._options = tuple(options)
        if not gui:
            libsumo.start(["sumo", *self._arguments()])
        self._api: Any = start_gui(self._arguments()) if gui else libsumo
        self._running = SumoWorld._open = True
        atexit.register(self.close)
        self._populate(self._api)
        # What is called in every step is called without libsumo's Python wrappers, which cost a quarter.
        self._set_speed = self._function("vehicle", "setSpeed")
        self._get_position = self._function("vehicle", "getLanePosition")
        self._get_speed = self._function("vehicle", "getSpeed")
        self._get_collisions = self._function("simulation", "getCollisions")
        self._simulation_step = self._function("simulation", "step")
        self._shim = open_shim(self._flat, self._told, self.x, self.v) if shim and not gui else None

    def _function(self, domain: str, name: str) -> Callable[..., Any]:
        inner = getattr(self._api, "_libsumo", None)
        function: Callable[..., Any] = getattr(inner, f"{domain}_{name}", None) or getattr(
            getattr(self._api, domain), name
        )
        return function

    def _arguments(self) -> list[str]:
        return [*super()._arguments(), *self._options]

    def _type_of(self, vehicle: int) -> str:
        return "vanilla" if self._vanilla else super()._type_of(vehicle)

    def load_again(self) -> None:
        """Begin a new simulation, all vehicles parked."""
        self._api.load(self._arguments())
        self._populate(self._api)
        self._told[:] = 0.0
        if self._shim is not None:
            self._shim.find_vehicles()

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray) -> None:
        """See `harness.worlds.protocol.World`; positions and speeds are read back and compared."""
        positions, speeds = x[cells], v[cells]
        for k, at, driving in zip(cells.tolist(), positions.tolist(), speeds.tolist(), strict=True):
            for vehicle in (LV, BV, AV):
                self._move(self._api.vehicle, k, vehicle, at[vehicle], driving[vehicle])
        self.x[cells], self.v[cells], self._told[cells] = positions, speeds, speeds
        names = [name for k in cells.tolist() for name in self._names[k]]
        self._require_equal("m", self._get_position, positions, names)
        self._require_equal("m/s", self._get_speed, speeds, names)

    def step(self, speed: FloatArray, cut_in: Int8Array) -> BoolArray:
        """See `harness.worlds.protocol.World`."""
        changing = cut_in.nonzero()[0].tolist()
        for k in changing:
            self._begin_cut_in(self._names[k][BV])
        advance(self.x, self.v, speed)
        if self._shim is not None:
            if not self._shim.step(speed):
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
            self._end_cut_in(self._names[k][BV])
        return self._contacts(self._get_collisions)

    def _require_as_read(self, shim: Shim) -> None:
        """Ask again, and by libsumo's getters, where the shim has read other values than are wanted now."""
        if not np.array_equal(shim.arrays.position, self.x.ravel()):
            self._require_equal("m", self._get_position, self.x)
        if not np.array_equal(shim.arrays.speed, self.v.ravel()):
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

    def _end_cut_in(self, name: str) -> None:
        if not self._vanilla:
            self._api.vehicle.setActionStepLength(name, NEVER_PLAN_S, True)
        lane = self._api.vehicle.getLaneIndex(name)
        if lane != RIGHT:
            raise _disobeyed(f"{name}, lane", lane, RIGHT)

    def _require_equal(
        self, unit: str, getter: Callable[[str], float], expected: FloatArray, names: Sequence[str] | None = None
    ) -> None:
        """Every value that SUMO reports of vehicles (default: all) must be the commanded one, in every bit."""
        names, wanted = names or self._flat, expected.ravel().tolist()
        if (read := list(map(getter, names))) != wanted:
            at = next(i for i, value in enumerate(read) if value != wanted[i])
            raise _disobeyed(f"{names[at]}, {unit}", read[at], wanted[at])

    def close(self) -> None:
        """End the simulation; a world that is closed already leaves alone what others have opened since."""
        if self._running:
            self._running = SumoWorld._open = False
            if self._shim is not None:
                self._shim.close()
            atexit.unregister(self.close)
            self._api.close()


def _disobeyed(where: str, found: float, expected: float) -> WorldDisagreementError:
    return WorldDisagreementError(
        f"SUMO, {where}",
        float(found).hex(),
        f"{float(expected).hex()}, as commanded",
        "The bits are promised for libsumo 1.28.0; check `pip show libsumo`. Otherwise please report it.",
    )


def start_gui(arguments: Sequence[str]) -> Any:
    """Start sumo-gui and connect to it; returns traci, which has libsumo's functions.

    Raises `CampaignError`: it is not installed, or has no screen to open its window on.
    """
    import traci  # noqa: PLC0415 - comes with libsumo, wanted only here

    program = sumo_program("sumo-gui")
    if program is None:
        raise CampaignError("--gui", "no sumo-gui", "the extra 'sumo'", "Install it: pip install 'harness[sumo]'.")
    display = os.environ.get("DISPLAY")
    if sys.platform.startswith("linux") and not display:
        raise _no_window("no screen (the environment variable DISPLAY is not set)")
    try:
        traci.start([str(program), "--start", "--delay", "100", *arguments])
    except (traci.TraCIException, traci.FatalTraCIError) as error:
        raise _no_window(f"a sumo-gui that cannot be reached ({error}; DISPLAY is {display})") from error
    return traci


def _no_window(found: str) -> CampaignError:
    return CampaignError(
        "--gui",
        found,
        "a desktop that sumo-gui can open its window on",
        "Start it from a desktop session (or with ssh -X), or write the motion to a file: --out FILE.csv.",
    )
