"""World in a real SUMO, whose AVs a program outside of the harness drives as an ordinary TraCI client.

Within a step SUMO serves the program first and the harness last. So whatever the program commands to an AV that must
hold its speed, or whose cell has just been refilled, is overruled in the same step. From the step after the cut-in on
the harness leaves the AV alone: its position and speed are read. LV and BV are compared in every bit, in every step.
"""

from __future__ import annotations

import atexit
from functools import partial
from typing import Any

import numpy as np
import traci.constants as tc
from traci.exceptions import TraCIException

from harness.campaign.vehicle import TraciProcess
from harness.errors import WorldDisagreementError
from harness.vocabulary import AV, BV, LV, BoolArray, FloatArray, Int8Array, IntArray
from harness.worlds.cells import LEFT, NEVER_PLAN_S, OBEY, PLAN_NOW_S, RIGHT, SumoCells
from harness.worlds.program import BatchConnection, ConnectedProgram
from harness.worlds.protocol import AVLostError
from harness.worlds.twin import advance

_SUBSCRIBED = (tc.VAR_LANEPOSITION, tc.VAR_SPEED, tc.VAR_LANE_INDEX)


class TraciWorld(SumoCells):
    """World whose AVs are driven by a connected program; see `World` and `DrivingWorld` in `harness.worlds.protocol`.

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
        super().__init__(n_cells)
        self.acts_before_cut_in = acts_before_cut_in
        self._av = av
        self._step_time_s = step_time_s
        self._restarts_left = av.restarts
        self._released: BoolArray = np.zeros(n_cells, np.bool_)
        self._on_right: BoolArray = np.zeros(n_cells, np.bool_)
        self._program: ConnectedProgram | None = None
        self._given_up = ""
        atexit.register(self.close)

    def announce(self, cells: IntArray, episodes: IntArray) -> None:  # noqa: ARG002 - the program is not told
        """See `harness.worlds.protocol.DrivingWorld`; SUMO and the program are started with the first episodes.

        Raises `AVLostError`: the program does not connect, or has been started as often as the campaign allows.
        """
        if self._given_up:
            raise AVLostError(self._given_up)
        if self._program is None:
            self._program = ConnectedProgram(self._av, self.n_cells, self._arguments(), self._step_time_s)
            self._program.answer(self._begin, self._av.connect_time_s)
            self._program.watch()
            self._park(np.setdiff1d(np.arange(self.n_cells), cells))  # a program begun again knows nothing of the last

    def _begin(self) -> None:
        """Park the vehicles of all cells, and subscribe to them."""
        api = self._running().connection
        self._populate(api)
        for name in self._flat:
            api.vehicle.subscribe(name, _SUBSCRIBED)

    def _running(self) -> ConnectedProgram:
        if self._program is None:
            raise AVLostError(self._given_up or "the program is not running")
        return self._program

    def _move(self, to: Any, k: int, vehicle: int, x: float, v: float) -> None:
        to.setSpeedMode(self._names[k][vehicle], OBEY)  # whatever the program has made of it
        super()._move(to, k, vehicle, x, v)

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray) -> None:
        """See `harness.worlds.protocol.World`; the AVs of these cells are taken back under command."""
        program = self._running()
        to = program.connection.vehicle
        for k in cells.tolist():
            for vehicle in (LV, BV, AV):
                program.answer(partial(self._move, to, k, vehicle, float(x[k, vehicle]), float(v[k, vehicle])))
        self.x[cells], self.v[cells] = x[cells], v[cells]
        self._released[cells] = self.acts_before_cut_in
        self._on_right[cells] = False

    def step(self, speed: FloatArray, cut_in: Int8Array) -> BoolArray:
        """See `harness.worlds.protocol.World`; speeds of released AVs are ignored.

        Raises `AVLostError`: the program did not take part in this step. Raises `WorldDisagreementError`: a vehicle
        that the harness commands is not where it should be.
        """
        program = self._running()
        api = program.connection
        changing = np.flatnonzero(cut_in).tolist()
        commanded = np.ones((self.n_cells, 3), np.bool_)
        commanded[self._released, AV] = False
        try:
            program.answer(lambda: self._command(api, commanded, speed, changing))
            program.answer(api.simulationStep)
            program.require_connected()
            contact = program.answer(lambda: self._contacts(api.simulation.getCollisions))
        except TraCIException as error:
            raise _meddled("a vehicle of the harness", str(error), "a vehicle that is there") from error
        self._on_right[changing] = True
        self._read(api.vehicle.getAllSubscriptionResults(), speed, commanded)
        for k in changing:
            program.answer(partial(api.vehicle.setActionStepLength, self._names[k][BV], NEVER_PLAN_S, True))
        self._released[changing] = True
        return contact

    def _command(self, api: BatchConnection, commanded: BoolArray, speed: FloatArray, changing: list[int]) -> None:
        for k in changing:
            api.vehicle.setActionStepLength(self._names[k][BV], PLAN_NOW_S, True)
            api.vehicle.changeLane(self._names[k][BV], RIGHT, 0.0)
        told = np.flatnonzero(commanded)
        api.set_speeds([self._flat[i] for i in told.tolist()], speed.ravel()[told].tolist())

    def _read(self, found: dict[str, Any], speed: FloatArray, commanded: BoolArray) -> None:
        """Compare what was commanded with where it is, and take over where the program's AVs are."""
        x, v = self.x.copy(), self.v.copy()
        advance(x, v, speed)
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

    def restart(self) -> None:
        """See `harness.worlds.protocol.DrivingWorld`; once the restarts are used up, all further episodes fail."""
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
        found,
        expected,
        "A TraCI client may only command AVs ('AV0', 'AV1', ...), on their lane, after the cut-in: moving LV or "
        "BV, or changing lanes, would make the likelihood ratios wrong. If yours does not, please report it.",
    )
