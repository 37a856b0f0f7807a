"""The optional compiled shim (`shim.cpp`): built when the package is installed, where there is a C++ compiler.

Without it, or with ``HARNESS_SHIM=0``, the same is done in Python, with the same bits.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from harness.arrays import FloatArray

_POINTER = ctypes.c_void_p
_OBEYED, _FAILED = 0, 1


def shim_library() -> Path | None:
    """The compiled shim, or None where there is none or it is switched off."""
    if os.environ.get("HARNESS_SHIM") == "0":
        return None
    return next(iter(sorted(Path(__file__).parent.glob("_shim*.so"))), None)


def open_shim(names: Sequence[str]) -> Shim | None:
    """Shim for the given vehicles, or None: not built, switched off, or another libsumo than it knows."""
    path = shim_library()
    if path is None:
        return None
    import libsumo  # noqa: PLC0415 - takes 0.2 s, and only worlds need it

    inner = getattr(libsumo, "_libsumo", None)
    if inner is None:
        return None
    try:
        library = ctypes.CDLL(str(path))
        library.shim_open.restype = _POINTER
        library.shim_find_vehicles.argtypes = [_POINTER]
        library.shim_step.argtypes = [_POINTER] * 7
        library.shim_error.restype = ctypes.c_char_p
        library.shim_error.argtypes = library.shim_close.argtypes = [_POINTER]
    except (OSError, AttributeError):
        return None  # built for another machine, or by an earlier version
    encoded = (ctypes.c_char_p * len(names))(*(name.encode() for name in names))
    handle = library.shim_open(inner.__file__.encode(), encoded, ctypes.c_long(len(names)))
    if not handle:
        return None
    shim = Shim(library, handle, len(names))
    shim.find_vehicles()
    return shim


class Shim:
    """Vehicles of one simulation, told, read and compared in one call.

    Attributes
    ----------
    position, speed : ndarray, shape (n,)
        Positions (m) and speeds (m/s) that SUMO reported after the last step.
    """

    def __init__(self, library: ctypes.CDLL, handle: int, n: int) -> None:
        self._library = library
        self._handle: int | None = handle
        self._step = library.shim_step
        self.position: FloatArray = np.zeros(n)
        self.speed: FloatArray = np.zeros(n)
        self._given: tuple[FloatArray, ...] = ()
        self._addresses: tuple[int, ...] = ()

    def find_vehicles(self) -> None:
        """Look the vehicles up again: those of an earlier simulation in this process are gone.

        Raises
        ------
        RuntimeError
            There is no such vehicle.
        """
        if self._library.shim_find_vehicles(self._handle):
            raise RuntimeError(self._library.shim_error(self._handle).decode())

    def step(self, speed: FloatArray, told: FloatArray, x: FloatArray, v: FloatArray) -> bool:
        """Tell changed speeds (noting them in ``told``), simulate one step, read all positions and speeds.

        Returns
        -------
        bool
            Whether every position and speed is the wanted one, ``x`` and ``v``, in every bit.

        Raises
        ------
        RuntimeError
            SUMO raised an error, or a vehicle has left the road.
        """
        given = (speed, told, x, v)
        if [*map(id, given)] != [*map(id, self._given)]:  # to ask for six addresses takes longer than the call
            self._given = given
            self._addresses = tuple(array.ctypes.data for array in (*given, self.position, self.speed))
        answer: int = self._step(self._handle, *self._addresses)
        if answer == _FAILED:
            raise RuntimeError(self._library.shim_error(self._handle).decode())
        return answer == _OBEYED

    def close(self) -> None:
        """Forget the vehicles."""
        if self._handle is not None:
            self._library.shim_close(self._handle)
            self._handle = None
