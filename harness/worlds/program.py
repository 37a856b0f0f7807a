"""World in a real SUMO, whose AVs a program outside of the harness drives as an ordinary TraCI client.

SUMO and the program are started, watched and ended together. Within a step SUMO serves the program first and the
harness last. So whatever the program commands to an AV that must hold its speed, or whose cell has just been refilled,
is overruled in the same step. From the step after the event on the harness leaves the AV alone: its position and speed
are read. LV and BV are compared in every bit, in every step.

SUMO 1.28 binds its server to INADDR_ANY, has no option for another address, and takes the first clients that come for
the user's program: hence `require_private` and `require_neighbour`.
"""

from __future__ import annotations

import atexit
import ipaddress
import os
import re
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import traci.constants as tc
from sumolib.miscutils import getFreeSocketPort
from traci.connection import Connection
from traci.exceptions import FatalTraCIError, TraCIException

from harness.campaign.vehicle import Limits, TraciProcess
from harness.errors import CampaignError, WorldDisagreementError
from harness.processes import end
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import VEHICLES, BoolArray, FloatArray, Int8Array, IntArray
from harness.worlds import AVLostError
from harness.worlds.sumo import NEVER_PLAN_S, OBEY, SumoCells, sumo_program
from harness.worlds.twin import advance

HARNESS_ORDER = 2
"""SUMO serves its clients in this order within a step, and the program is 1: the harness has the last word."""
_POLL_S, _ROUNDING_MPS2 = 0.02, 1e-6
_ESTABLISHED = "01"
_TCP_TABLE = Path("/proc/net/tcp")

_Answer = TypeVar("_Answer")
_SUBSCRIBED = (tc.VAR_LANEPOSITION, tc.VAR_SPEED, tc.VAR_LANE_INDEX)
_ROUTES = Path("/proc/net/fib_trie")
_LOCAL = re.compile(r"^ *\|-- ([\d.]+)\n +/32 host LOCAL$", re.MULTILINE)


def own_addresses() -> set[str]:
    """IPv4 addresses of this machine's interfaces; without a ``/proc``, those that its name stands for."""
    with suppress(OSError):
        return set(_LOCAL.findall(_ROUTES.read_text(encoding="ascii")))
    with suppress(OSError):
        return set(socket.gethostbyname_ex(socket.gethostname())[2])
    return set()


def require_private(program: TraciProcess) -> None:
    """Refuse to open a TraCI server where the internet can reach it, unless the campaign says that this is right."""
    public = sorted(address for address in own_addresses() if ipaddress.ip_address(address).is_global)
    if public and not program.allow_public:
        found = f"a machine with the public address {public[0]}, on which SUMO's TraCI server would listen, too"
        expected = "a machine with private addresses only: SUMO cannot be told to listen on this machine alone"
        mend = "Run in a container or behind a firewall that closes all ports, then set av.traci.allow_public: true."
        raise CampaignError("av.traci", found, expected, mend)


class BatchConnection(Connection):  # type: ignore[misc] # traci has no types
    """`traci.connection.Connection`, with one round trip for all commanded speeds instead of one for each.

    The step itself travels alone: with two clients SUMO would send the answers to what precedes it to the wrong one.
    """

    def __init__(self, port: int) -> None:
        self._socket: socket.socket | None
        super().__init__("127.0.0.1", port, None, None, traceGetters=False)

    def limit(self, seconds: float) -> None:
        """Give up on an answer after this time; the connection is then closed."""
        if self._socket is not None:
            self._socket.settimeout(seconds)

    def drop(self) -> None:
        """Close without waiting for an answer."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def set_speeds(self, names: Sequence[str], speeds: Sequence[float]) -> None:
        """Command vehicles (n,) to speeds (m/s)."""
        if not names:
            return
        for name, speed in zip(map(str.encode, names), speeds, strict=True):
            fields = tc.CMD_SET_VEHICLE_VARIABLE, tc.VAR_SPEED, len(name), name, tc.TYPE_DOUBLE, speed
            self._string += struct.pack(f"!BBBi{len(name)}sBd", 16 + len(name), *fields)
            self._queue.append(tc.CMD_SET_VEHICLE_VARIABLE)
        self._sendExact()


class ConnectedProgram:
    """SUMO as a server with two clients: the user's program (``av.traci``) and the harness with its ``connection``.

    A step may take ``step_time_s`` (``av.limits.step_time_s``). An `AVLostError` says that the program ended, or did
    not connect in time, a `CampaignError` that SUMO or the program cannot be started at all.
    """

    def __init__(self, av: TraciProcess, n_cells: int, sumo_arguments: Sequence[str], step_time_s: float) -> None:
        self._av, self._step_time_s = av, step_time_s
        self._port, self._n_watched = getFreeSocketPort(), 0
        server = [str(sumo_program("sumo", "av.traci")), *sumo_arguments]
        server += ["--remote-port", str(self._port), "--num-clients", "2"]
        quiet = subprocess.DEVNULL
        with ExitStack() as ending:
            self._server = subprocess.Popen(server, stdout=quiet, stderr=quiet, process_group=0)  # noqa: S603
            ending.callback(end, self._server)
            self.connection = self._connect()
            ending.callback(self.connection.drop)
            self._program = _start_program(av, self._port, n_cells)
            ending.callback(end, self._program)
            self._await_program()
            self._ending = ending.pop_all()

    def _connect(self) -> BatchConnection:
        until = time.monotonic() + self._av.connect_time_s
        while True:
            try:
                return BatchConnection(self._port)
            except OSError as error:
                if self._server.poll() is not None or time.monotonic() > until:
                    raise AVLostError(f"SUMO's TraCI server did not start ({error})") from error
            time.sleep(_POLL_S)

    def _await_program(self) -> None:
        """Wait until the program has connected, then agree on the order."""
        until = time.monotonic() + self._av.connect_time_s
        while self._n_connected() == 1:
            self._require_running("before it connected")
            if time.monotonic() > until:
                raise AVLostError(f"the program did not connect within {self._av.connect_time_s:g} s")
            time.sleep(_POLL_S)
        self.answer(lambda: self.connection.setOrder(HARNESS_ORDER), self._av.connect_time_s)

    def answer(self, ask: Callable[[], _Answer], seconds: float | None = None) -> _Answer:
        """What SUMO answers to the harness, which may mean to wait for the program.

        An `AVLostError` says: no answer in time (default: that of a step), or the program has ended or taken its leave.
        """
        limit, began = seconds or self._step_time_s, time.monotonic()
        try:
            self.connection.limit(limit)
            return ask()
        except (FatalTraCIError, OSError) as error:
            if time.monotonic() - began >= limit:
                raise AVLostError(f"the program did not finish its step within {limit:g} s") from error
            raise AVLostError(self._how_it_ended()) from error

    def watch(self) -> None:
        """From now on, with all files loaded, SUMO has one socket less when the program is gone."""
        self._n_watched = self._n_sockets()

    def require_connected(self) -> None:
        """Raise `AVLostError` if the program was not there, after a step, to act in it."""
        if self._n_sockets() < self._n_watched:
            raise AVLostError(self._how_it_ended())
        self._require_running("in the middle of the run")

    def _require_running(self, when: str) -> None:
        if (code := self._program.poll()) is not None:
            raise AVLostError(f"the program ended {when}, {_exit_words(code)}")

    def _how_it_ended(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            return f"the program ended, {_exit_words(self._program.wait(1.0))}"
        return "the program closed its connection, but goes on running"

    def _n_connected(self) -> int:
        """Clients that SUMO has now; where the system has no table of connections, the program counts while it runs."""
        if not _TCP_TABLE.exists():
            return 2
        port = f":{self._port:04X}"
        rows = (line.split() for line in _TCP_TABLE.read_text(encoding="ascii").splitlines()[1:])
        clients = [row for row in rows if row[1].endswith(port) and row[3] == _ESTABLISHED]
        for _, server_end, client_end, *_ in clients:
            require_neighbour(server_end, client_end)
        return len(clients)

    def _n_sockets(self) -> int:
        """Sockets that SUMO has open, one less when a client has left without a word; 0 where nobody says."""
        try:
            with os.scandir(f"/proc/{self._server.pid}/fd") as descriptors:
                return sum(os.readlink(each).startswith("socket:") for each in descriptors)  # noqa: PTH115 - every step
        except OSError:
            return 0

    def close(self) -> None:
        """End both processes."""
        self._ending.close()


def _start_program(av: TraciProcess, port: int, n_cells: int) -> subprocess.Popen[bytes]:
    try:
        words = av.words(port, n_cells)
        # What it prints belongs on the terminal, but stdout is for the harness's results.
        return subprocess.Popen(words, stdout=sys.stderr.fileno(), process_group=0)  # noqa: S603 - the user's own
    except (OSError, ValueError) as error:  # a null character in a word is a ValueError
        mend = "Try it in a shell, in the folder in which you start the harness."
        raise CampaignError(
            "av.traci.command", f"{av.command} ({error})", "a program that can be started", mend
        ) from error


def require_neighbour(server_end: str, client_end: str) -> None:
    """Refuse a client of another machine; ``server_end`` and ``client_end`` are addresses as in /proc/net/tcp."""
    address = socket.inet_ntoa(int(client_end.partition(":")[0], 16).to_bytes(4, sys.byteorder))
    if not address.startswith("127.") and server_end.partition(":")[0] != client_end.partition(":")[0]:
        expected = "the program that av.traci.command starts, on this machine"
        mend = "Close this machine's ports to others, or let the program run here."
        raise WorldDisagreementError("SUMO's TraCI server", f"a client at {address}", expected, mend)


def _exit_words(code: int) -> str:
    return f"killed by signal {-code}" if code < 0 else f"exit code {code}"


class TraciWorld(SumoCells):
    """World whose AVs are driven by a connected program, after the event or from the start of an episode."""

    drives_av = True

    def __init__(
        self,
        n_cells: int,
        av: TraciProcess,
        limits: Limits,
        vehicles: Sequence[str] = VEHICLES,
        *,
        acts_before_event: bool = False,
    ) -> None:
        super().__init__(n_cells, vehicles)
        self.acts_before_event = acts_before_event
        self._av, self._limits, self._restarts_left = av, limits, av.restarts
        self._released: BoolArray = np.zeros(n_cells, np.bool_)
        self._program: ConnectedProgram | None = None
        self._given_up = ""
        atexit.register(self.close)

    def announce(self, cells: IntArray, episodes: IntArray) -> None:  # noqa: ARG002 - the program is not told
        """Start SUMO and the program with the first episodes.

        An `AVLostError` says that the program does not connect, or has been started as often as the campaign allows.
        """
        if self._given_up:
            raise AVLostError(self._given_up)
        if self._program is None:
            self._program = ConnectedProgram(self._av, self.n_cells, self._arguments(), self._limits.step_time_s)
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

    def _move(self, vehicle_api: Any, k: int, vehicle: int, x: float, v: float, lane: int) -> None:
        vehicle_api.setSpeedMode(self._names[k][vehicle], OBEY)  # whatever the program has made of it
        super()._move(vehicle_api, k, vehicle, x, v, lane)

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray, lane: Int8Array) -> None:
        """Take the AVs of these cells back under command."""
        program = self._running()
        program.answer(lambda: self._put(program.connection.vehicle, cells, x, v, lane))
        self._released[cells] = self.acts_before_event

    def step(self, speed: FloatArray, lane: Int8Array) -> BoolArray:
        """Speeds of released AVs are ignored.

        Raises `AVLostError`: the program took no part; `WorldDisagreementError`: it moved what the harness commands,
        or an AV as no vehicle can.
        """
        program = self._running()
        api = program.connection
        meets = (lane != self.lane).any(1)
        commanded = np.ones_like(self.x, np.bool_)
        commanded[self._released, -1] = False
        try:
            changing = program.answer(lambda: self._command(api, commanded, speed, lane))
            program.answer(api.simulationStep)
            program.require_connected()
            contact = program.answer(lambda: self._contacts(api.simulation.getCollisions))
        except TraCIException as error:
            raise _meddled("a vehicle of the harness", str(error), "a vehicle that is there") from error
        self.lane[:] = lane
        self._read(api.vehicle.getAllSubscriptionResults(), speed, commanded)
        for name, _ in changing:
            program.answer(partial(self._plan_every, api.vehicle, NEVER_PLAN_S, name))
        self._released |= meets
        return contact

    def _command(
        self, api: BatchConnection, commanded: BoolArray, speed: FloatArray, lane: Int8Array
    ) -> list[tuple[str, int]]:
        changing = self._change_lanes(api.vehicle, lane)
        places = np.flatnonzero(commanded)
        api.set_speeds([self._flat[i] for i in places.tolist()], speed.ravel()[places].tolist())
        return changing

    def _read(self, results: dict[str, Any], speed: FloatArray, commanded: BoolArray) -> None:
        """Compare what was commanded with where it is, and take over where the program's AVs are."""
        x, v = self.x.copy(), self.v.copy()
        advance(x, v, speed)
        if missing := [name for name in self._flat if name not in results]:
            raise _meddled(missing[0], "a vehicle that has left the road", "a vehicle that is there")
        values = np.array([[results[name][variable] for variable in _SUBSCRIBED] for name in self._flat])
        position, speed_read, lane = values.reshape(*self.x.shape, len(_SUBSCRIBED)).transpose(2, 0, 1)
        for quantity, actual, target in (("position, m", position, x), ("speed, m/s", speed_read, v)):
            self._require(quantity, actual, target, commanded)
        self._require("lane", lane, self.lane, np.ones_like(commanded))
        change = np.where(commanded, 0.0, (speed_read - self.v) / STEP_S)[:, -1]
        least, most = self._limits.min_acceleration_mps2, self._limits.max_acceleration_mps2
        for k in np.flatnonzero((change < least - _ROUNDING_MPS2) | (change > most + _ROUNDING_MPS2)):
            mend = "Command speeds that the vehicle can reach in 0.1 s."
            expected = f"{least:g} to {most:g} m/s² (av.limits)"
            raise WorldDisagreementError(f"SUMO, {self._names[k][-1]}", f"{change[k]:.1f} m/s²", expected, mend)
        self.x[:], self.v[:] = position, speed_read

    def _require(self, quantity: str, actual: FloatArray, target: Any, which: BoolArray) -> None:
        wrong = np.argwhere(which & (actual != target))
        if wrong.size:
            k, vehicle = wrong[0].tolist()
            where = f"{self._names[k][vehicle]}, {quantity}"
            raise _meddled(where, repr(float(actual[k, vehicle])), f"{float(target[k, vehicle])!r}, as commanded")

    def restart(self) -> None:
        """Begin again; once the restarts are used up, all further episodes fail."""
        self._end_program()
        if self._restarts_left == 0:
            restarts = f"av.traci.restarts: {self._av.restarts}"
            self._given_up = f"the program was lost before and is not started again ({restarts})"
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
    mend = (
        "A TraCI client may only command AVs ('AV0', 'AV1', ...), on their lane, after the event: moving LV or "
        "BV, or changing lanes, would make the likelihood ratios wrong. If yours does not, please report it."
    )
    return WorldDisagreementError(f"SUMO, {where}", found, expected, mend)
