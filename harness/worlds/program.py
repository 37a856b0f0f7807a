"""A real SUMO and the user's program, connected to it beside the harness: started, watched and ended together."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TypeVar

import traci.constants as tc
from traci.connection import Connection
from traci.exceptions import FatalTraCIError

from harness.campaign.vehicle import TraciProcess
from harness.errors import CampaignError, WorldDisagreementError
from harness.processes import end
from harness.worlds.cells import sumo_program
from harness.worlds.protocol import AVLostError

HARNESS_ORDER = 2
"""SUMO serves its clients in this order within a step, and the program is 1: the harness has the last word."""
_POLL_S = 0.02
_ESTABLISHED = "01"
_TCP_TABLE = Path("/proc/net/tcp")

_Answer = TypeVar("_Answer")


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
        command, variable = tc.CMD_SET_VEHICLE_VARIABLE, tc.VAR_SPEED
        parts = []
        for name, speed in zip(names, speeds, strict=True):
            encoded = name.encode()
            body = struct.pack("!BBi", command, variable, len(encoded)) + encoded
            body += struct.pack("!Bd", tc.TYPE_DOUBLE, speed)
            parts.append(struct.pack("!B", len(body) + 1) + body)
            self._queue.append(command)
        self._string += b"".join(parts)
        self._sendExact()


class ConnectedProgram:
    """SUMO as a server with two clients: the user's program (``av.traci``) and the harness with its ``connection``.

    A step may take ``step_time_s`` (``av.limits.step_time_s``).

    Raises `AVLostError`: the program ended, or did not connect in time. Raises `CampaignError`: SUMO or the program
    cannot be started at all.
    """

    def __init__(self, av: TraciProcess, n_cells: int, sumo_arguments: Sequence[str], step_time_s: float) -> None:
        self._av = av
        self._step_time_s = step_time_s
        self._port = _free_port()
        self._n_watched = 0
        server = [str(_server_program()), *sumo_arguments, "--remote-port", str(self._port), "--num-clients", "2"]
        quiet = subprocess.DEVNULL
        with ExitStack() as ending:
            self._server = subprocess.Popen(server, stdout=quiet, stderr=quiet, start_new_session=True)  # noqa: S603
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

        Raises `AVLostError`: no answer in time (default: that of a step), the program has ended, or is not connected.
        """
        limit = seconds or self._step_time_s
        began = time.monotonic()
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
        here = f":{self._port:04X}"
        rows = (line.split() for line in _TCP_TABLE.read_text(encoding="ascii").splitlines()[1:])
        clients = [row for row in rows if row[1].endswith(here) and row[3] == _ESTABLISHED]
        for _, own, theirs, *_ in clients:
            require_neighbour(own, theirs)
        return len(clients)

    def _n_sockets(self) -> int:
        """Sockets that SUMO has open; 0 where the system does not say.

        SUMO goes on without a word when a client takes its leave. The table of connections would say so too, but
        reading it takes longer than a step.
        """
        try:
            with os.scandir(f"/proc/{self._server.pid}/fd") as found:
                return sum(os.readlink(file).startswith("socket:") for file in found)  # noqa: PTH115 - once per step
        except OSError:
            return 0

    def close(self) -> None:
        """End both processes."""
        self._ending.close()


def _start_program(av: TraciProcess, port: int, n_cells: int) -> subprocess.Popen[bytes]:
    try:
        words = av.words(port, n_cells)
        # What it prints belongs on the terminal, but stdout is for the harness's results.
        return subprocess.Popen(words, stdout=sys.stderr.fileno(), start_new_session=True)  # noqa: S603 - the user's own
    except (OSError, ValueError) as error:  # a null character in a word is a ValueError
        raise CampaignError(
            "av.traci.command",
            f"{av.command} ({error})",
            "a program that can be started",
            "Try it in a shell, in the folder in which you start the harness.",
        ) from error


def require_neighbour(own: str, theirs: str) -> None:
    """Refuse a client of another machine; both ends as the table of connections writes them (proc(5), net/tcp)."""
    address = socket.inet_ntoa(int(theirs.partition(":")[0], 16).to_bytes(4, sys.byteorder))
    if not address.startswith("127.") and own.partition(":")[0] != theirs.partition(":")[0]:
        raise WorldDisagreementError(
            "SUMO's TraCI server",
            f"a client at {address}",
            "the program that av.traci.command starts, on this machine",
            "Close this machine's ports to others, or let the program run here.",
        )


def _exit_words(code: int) -> str:
    return f"killed by signal {-code}" if code < 0 else f"exit code {code}"


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _server_program() -> Path:
    program = sumo_program("sumo")
    if program is None:
        raise CampaignError("av.traci", "no SUMO server", "the extra 'sumo'", "pip install 'harness[sumo]'.")
    return program
