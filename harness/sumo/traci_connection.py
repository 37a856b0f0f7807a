"""A TraCI connection that sends many speeds in one message."""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence

import traci.constants as tc
from traci.connection import Connection


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
