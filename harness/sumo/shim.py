"""The optional compiled shim (`shim.cpp`): built when the package is installed, where there is a C++ compiler.

Without it, or with ``HARNESS_SHIM=0``, the same is done in Python, with the same bits.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path

import libsumo
import numpy as np

from harness.arrays import FloatArray

_POINTER = ctypes.c_void_p


def shim_library() -> Path | None:
    """The compiled shim, or None where there is none or it is switched off."""
    if os.environ.get("HARNESS_SHIM") == "0":
        return None
    return next(iter(sorted(Path(__file__).parent.glob("_shim*.so"))), None)


def open_shim(names: Sequence[str]) -> Shim | None:
    """Shim for the given vehicles, or None: not built, switched off, or another libsumo than it knows."""
    path = shim_library()
    inner = getattr(libsumo, "_libsumo", None)
    if path is None or inner is None:
        return None
    try:
        library = ctypes.CDLL(str(path))
    except OSError:
        return None  # built for another machine
    library.shim_open.restype = _POINTER
    library.shim_step.argtypes = [_POINTER, _POINTER, _POINTER, _POINTER]
    library.shim_error.restype = ctypes.c_char_p
    library.shim_error.argtypes = library.shim_close.argtypes = [_POINTER]
    encoded = (ctypes.c_char_p * len(names))(*(name.encode() for name in names))
    handle = library.shim_open(inner.__file__.encode(), encoded, ctypes.c_long(len(names)))
    return Shim(library, handle, len(names)) if handle else None


class Shim:
    """Vehicles of one simulation, told and read in one call.

    Attributes
    ----------
    position : ndarray, shape (n,)
        Positions (m) that SUMO reported after the last step.
    """

    def __init__(self, library: ctypes.CDLL, handle: int, n: int) -> None:
        self._library = library
        self._handle: int | None = handle
        self._step = library.shim_step
        self.position: FloatArray = np.zeros(n)
        self._position = self.position.ctypes.data

    def step(self, speed: FloatArray, told: FloatArray) -> None:
        """Tell changed speeds (noting them in ``told``), simulate one step, read all positions.

        Raises
        ------
        RuntimeError
            SUMO raised an error.
        """
        if self._step(self._handle, speed.ctypes.data, told.ctypes.data, self._position):
            raise RuntimeError(self._library.shim_error(self._handle).decode())

    def close(self) -> None:
        """Forget the vehicles."""
        if self._handle is not None:
            self._library.shim_close(self._handle)
            self._handle = None
