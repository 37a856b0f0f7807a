"""World in a real SUMO, whose AVs a program outside of the harness drives as an ordinary TraCI client.

Within a step SUMO serves the program first and the harness last. So whatever the program commands to an AV that must
hold its speed, or whose cell has just been refilled, is overruled in the same step. From the step after the cut-in on
the harness leaves the AV alone: its position and speed are read. LV and BV are compared in every bit, in every step.
"""

from __future__ import annotations

import atexit
from typing import Any

import numpy as np
import traci.constants as tc
from traci.exceptions import TraCIException

from harness.arrays import BoolArray, FloatArray, Int8Array, IntArray
from harness.campaign.models import TraciProcess
from harness.errors import WorldDisagreementError
from harness.outcomes import AV, BV, LV, VEHICLES
from harness.sumo.network import EXACT_OPTIONS, PARKED_M, committed_file, network_file, parked
from harness.sumo.program import ConnectedProgram
from harness.twin import advance
from harness.world import AVLostError

LEFT, RIGHT = 1, 0
NEVER_PLAN_S, PLAN_NOW_S = 1000.0, 0.1
_SUBSCRIBED = (tc.VAR_LANEPOSITION, tc.VAR_SPEED, tc.VAR_LANE_INDEX)


class TraciWorld:
    """World whose AVs are driven by a connected program; see `harness.world.World` and `harness.world.DrivingWorld`.

    Parameters
    ----------
    n_cells : int
    av : TraciProcess
    step_time_s : float
        Time that a step may take.
    acts_before_cut_in : bool
        Leave the AV to the program from the start of an episode.
    """

    def __init__(self, n_cells: int, av: TraciProcess, step_time_s: float, *, acts_before_cut_in: bool = False) -> None:
        self.acts_before_cut_in = acts_before_cut_in
        self.x: FloatArray = parked(n_cells)
        self.v: FloatArray = np.zeros((n_cells, 3))
        self._av = av
        self._step_time_s = step_time_s
        self._restarts_left = av.restarts
        self._names = [[f"{vehicle}{k}" for vehicle in VEHICLES] for k in range(n_cells)]
        self._flat = [name for cell in self._names for name in cell]
        self._cell_of = {name: k for k, cell in enumerate(self._names) for name in cell}
        self._released: BoolArray = np.zeros(n_cells, np.bool_)
        self._on_right: BoolArray = np.zeros(n_cells, np.bool_)
        self._program: ConnectedProgram | None = None
        self._given_up = ""
        atexit.register(self.close)

    @property
    def n_cells(self) -> int:
        """K."""
        return int(self.x.shape[0])

    def announce(self, cells: IntArray, episodes: IntArray) -> None:  # noqa: ARG002 - the program is not told
        """See `harness.world.DrivingWorld`; SUMO and the program are started with the first episodes.

        Raises
        ------
        AVLostError
            The program does not connect, or has been started as often as the campaign allows.
        """
        if self._given_up:
            raise AVLostError(self._given_up)
        if self._program is None:
            files = ["-n", str(network_file(self.n_cells)), "-a", str(committed_file("vehicles.add.xml"))]
            self._program = ConnectedProgram(self._av, self.n_cells, [*files, *EXACT_OPTIONS], self._step_time_s)
            self._program.answer(self._populate, self._av.connect_time_s)
            self._program.watch()
            idle = np.setdiff1d(np.arange(self.n_cells), cells)  # a program begun again knows nothing of the last one
            self.x[idle], self.v[idle] = parked(idle.size), 0.0

    def _populate(self) -> None:
        """Park the vehicles of all cells, step once so that they exist, and subscribe to them."""
        api = self._api
        for k, names in enumerate(self._names):
            api.route.add(f"cell{k}", [f"cell{k}"])
            for vehicle, name in enumerate(names):
                lane, position = str(RIGHT if vehicle == AV else LEFT), str(PARKED_M[vehicle])
                api.vehicle.add(name, f"cell{k}", typeID="exact", departLane=lane, departPos=position)
                self._move(k, vehicle, PARKED_M[vehicle], 0.0)
                api.vehicle.setLaneChangeMode(name, 0)
        api.simulationStep()
        for name in self._flat:
            api.vehicle.subscribe(name, _SUBSCRIBED)

    @property
    def _api(self) -> Any:
        return self._running().connection

    def _running(self) -> ConnectedProgram:
        if self._program is None:
            raise AVLostError(self._given_up or "the program is not running")
        return self._program

    def _move(self, k: int, vehicle: int, x: float, v: float) -> None:
        name, to = self._names[k][vehicle], self._api.vehicle
        to.setSpeedMode(name, 0)
        to.moveTo(name, f"cell{k}_{RIGHT if vehicle == AV else LEFT}", x)
        to.setPreviousSpeed(name, v)
        to.setSpeed(name, v)

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray) -> None:
        """See `harness.world.World`; the AVs of these cells are taken back under command."""
        program = self._running()
        for k in cells.tolist():
            for vehicle in (LV, BV, AV):
                program.answer(lambda k=k, i=vehicle: self._move(k, i, float(x[k, i]), float(v[k, i])))  # type: ignore[misc]
        self.x[cells], self.v[cells] = x[cells], v[cells]
        self._released[cells] = self.acts_before_cut_in
        self._on_right[cells] = False

    def step(self, speed: FloatArray, cut_in: Int8Array) -> BoolArray:
        """See `harness.world.World`; speeds of released AVs are ignored.

        Raises
        ------
        AVLostError
            The program did not take part in this step.
        WorldDisagreementError
            A vehicle that the harness commands is not where it should be.
        """
        program, api = self._running(), self._api
        changing = np.flatnonzero(cut_in).tolist()
        commanded = np.ones((self.n_cells, 3), np.bool_)
        commanded[self._released, AV] = False
        told = np.flatnonzero(commanded)
        try:
            program.answer(lambda: self._command(told, speed, changing))
            program.answer(api.simulationStep)
            program.require_connected()
            contact = program.answer(self._contacts)
        except TraCIException as error:
            raise _meddled("a vehicle of the harness", str(error), "a vehicle that is there") from error
        self._on_right[changing] = True
        self._read(speed, commanded)
        for k in changing:
            program.answer(lambda k=k: api.vehicle.setActionStepLength(self._names[k][BV], NEVER_PLAN_S, True))  # type: ignore[misc]
        self._released[changing] = True
        return contact

    def _command(self, told: IntArray, speed: FloatArray, changing: list[int]) -> None:
        vehicle = self._api.vehicle
        for k in changing:
            vehicle.setActionStepLength(self._names[k][BV], PLAN_NOW_S, True)
            vehicle.changeLane(self._names[k][BV], RIGHT, 0.0)
        self._api.set_speeds([self._flat[i] for i in told.tolist()], speed.ravel()[told].tolist())

    def _read(self, speed: FloatArray, commanded: BoolArray) -> None:
        """Compare what was commanded with where it is, and take over where the program's AVs are."""
        x, v = self.x.copy(), self.v.copy()
        advance(x, v, speed)
        found = self._api.vehicle.getAllSubscriptionResults()
        read = np.array([[found[name][variable] for variable in _SUBSCRIBED] for name in self._flat])
        position, speed_read, lane = read.reshape(self.n_cells, 3, 3).transpose(2, 0, 1)
        wanted_lane = np.full((self.n_cells, 3), LEFT)
        wanted_lane[:, AV] = RIGHT
        wanted_lane[self._on_right, BV] = RIGHT
        for quantity, here, wanted in (("position, m", position, x), ("speed, m/s", speed_read, v)):
            self._require(quantity, here, wanted, commanded)
        self._require("lane", lane, wanted_lane, np.ones_like(commanded))
        self.x[:], self.v[:] = position, speed_read

    def _require(self, quantity: str, found: FloatArray, wanted: Any, which: BoolArray) -> None:
        wrong = np.argwhere(which & (found != wanted))
        if wrong.size:
            k, vehicle = wrong[0].tolist()
            where = f"{self._names[k][vehicle]}, {quantity}"
            raise _meddled(where, repr(float(found[k, vehicle])), f"{float(wanted[k, vehicle])!r}, as commanded")

    def _contacts(self) -> BoolArray:
        contact = np.zeros(self.n_cells, np.bool_)
        for collision in self._api.simulation.getCollisions():
            contact[self._cell_of[collision.collider]] = True
        return contact

    def restart(self) -> None:
        """See `harness.world.DrivingWorld`; once the restarts are used up, all further episodes fail."""
        self._end_program()
        if self._restarts_left == 0:
            self._given_up = (
                f"the program was lost before and is not started again (av.traci.restarts: {self._av.restarts})"
            )
        self._restarts_left -= 1

    def _end_program(self) -> None:
        if self._program is not None:
            self._program.close()
            self._program = None
        self._released[:] = False

    def close(self) -> None:
        """End SUMO and the program."""
        self._end_program()
        atexit.unregister(self.close)


def _meddled(where: str, found: str, expected: str) -> WorldDisagreementError:
    return WorldDisagreementError(
        f"SUMO, {where}",
        found=found,
        expected=expected,
        mend="A TraCI client may only command AVs ('AV0', 'AV1', ...), on their lane, after the cut-in: moving LV or "
        "BV, or changing lanes, would make the likelihood ratios wrong. If yours does not, please report it.",
    )
