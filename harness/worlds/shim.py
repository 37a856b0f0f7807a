"""The optional compiled shim (`shim.cpp`): built when the package is installed, where there is a C++ compiler.

Without it, or with ``HARNESS_SHIM=0``, the same is done in Python, with the same bits.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from harness.vocabulary import FloatArray

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
    import libsumo  # noqa: PLC0415 - takes 0.2 s, and only worlds need it

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
    """Vehicles of one simulation, told, read and compared in one call.

    ``told`` are the speeds (m/s) that they were last told, ``x`` and ``v`` where they should be after the coming step,
    ``position`` (m) and ``speed`` where SUMO says they are: arrays of as many elements as there are vehicles, which
    stay where they are.
    """

    def __init__(self, library: ctypes.CDLL, handle: int, told: FloatArray, x: FloatArray, v: FloatArray) -> None:
        self.told, self.x, self.v, self.position, self.speed = told, x, v, np.zeros(x.size), np.zeros(x.size)
        self._library = library
        self._handle: int | None = handle
        self._wanted = np.zeros_like(told)
        arrays = self._wanted, told, x, v, self.position, self.speed
        self._addresses = [array.ctypes.data for array in arrays]  # to ask for them takes longer than the call
        self.find_vehicles()

    def find_vehicles(self) -> None:
        """Look the vehicles up again: those of an earlier simulation in this process are gone.

        Raises `RuntimeError`: there is no such vehicle.
        """
        if self._library.shim_find_vehicles(self._handle):
            raise self._error()

    def step(self, wanted: FloatArray) -> bool:
        """Tell the speeds that differ from ``told`` (noting them there), simulate one step, read all vehicles.

        Returns whether every position and speed is that of ``x`` and ``v``, in every bit. Raises `RuntimeError`: SUMO
        raised an error, or a vehicle has left the road.
        """
        self._wanted[:] = wanted
        answer: int = self._library.shim_step(self._handle, *self._addresses)
        if answer == _FAILED:
            raise self._error()
        return answer == _OBEYED

    def _error(self) -> RuntimeError:
        return RuntimeError(self._library.shim_error(self._handle).decode())

    def close(self) -> None:
        """Forget the vehicles."""
        if self._handle is not None:
            self._library.shim_close(self._handle)
            self._handle = None
