"""What a controller must leave as it finds it in the process that it shares with the harness.

Kernels round as the processor is told to, and everything else calls Python's modules and numpy: a vehicle that changes
either changes numbers of the harness, or breaks it elsewhere.
"""

from __future__ import annotations

import ctypes
import math
import os
import platform
import struct
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

WATCHED = (
    *("builtins", "functools", "hashlib", "io", "math", "json", "os", "pickle", "signal", "struct", "sys", "time"),
    *("zlib", "pathlib", "numpy", "numpy.random", "pyarrow", "pyarrow.compute", "pyarrow.parquet", "selectors"),
    *("multiprocessing.connection", "multiprocessing.reduction", "multiprocessing.util", "threading"),
)
OURS = "harness", "numba", "llvmlite", "numpy"
"""Packages of which no module may be replaced."""
CHANGED_MODES = "changed the processor's rounding mode or floating-point flags (fesetround, -ffast-math); restore them"

_CONTROL, _MXCSR, _MODES = 0, 7, 0xFFC0
"""Words of ``fenv_t`` in the C library of Linux that say how to compute, not what has been met.

On x86-64 the control word of the x87 and the upper bits of MXCSR, on aarch64 FPCR and nothing: rounding, flush to zero,
denormals are zero, masked exceptions.
"""
_SIGEVENT, _IN_THREAD, _SPARED_S = "qiiQ40x", 2, 0.5
"""``struct sigevent`` (value, signal, SIGEV_THREAD, function); a call that begins so soon after one keeps its timer."""


class FloatingPointModes:
    """The modes of this thread when it is made; looking at them again takes half a microsecond."""

    def __init__(self) -> None:
        self._kept, current = (ctypes.create_string_buffer(64) for _ in range(2))
        saved, self._words = (memoryview(buffer).cast("B").cast("I") for buffer in (self._kept, current))
        self._look: Callable[..., object] = lambda: None
        self._write: Callable[..., object] = lambda _: None
        if platform.machine() in ("x86_64", "aarch64"):
            libm = ctypes.CDLL("libm.so.6")
            libm.fegetenv(self._kept)
            libm.fegetenv(current)
            self._look, self._write = partial(libm.fegetenv, ctypes.byref(current)), libm.fesetenv
        self._control, self._modes = saved[_CONTROL], saved[_MXCSR] & _MODES

    def restored(self) -> bool:
        """Put the modes back; whether they had been changed."""
        self._look()
        if self._words[_CONTROL] == self._control and self._words[_MXCSR] & _MODES == self._modes:
            return False
        self._write(self._kept)
        return True


class LastResort:
    """Ends the process when a call is late, with the exit code of its kind, even if it holds Python's lock for good."""

    def __init__(self, *exit_codes: int) -> None:
        librt, self._timers = ctypes.CDLL("librt.so.1"), [ctypes.c_void_p() for _ in exit_codes]
        self._set, self._begun = librt.timer_settime, dict[int, float]()
        for code, timer in zip(exit_codes, self._timers, strict=True):
            event = struct.pack(_SIGEVENT, code, 0, _IN_THREAD, ctypes.cast(librt._exit, ctypes.c_void_p).value)
            if librt.timer_create(time.CLOCK_MONOTONIC, event, ctypes.byref(timer)):
                raise MemoryError("for a thread")  # or a limit of the system

    def begin(self, kind: int, seconds: float, now: float) -> None:
        """A call of a kind begins ``now`` (s, monotonic) and may take so many ``seconds``."""
        if now - self._begun.get(kind, -math.inf) > _SPARED_S:  # a system call for each of ours would be too many
            self.end()
            self._set(self._timers[kind], 0, struct.pack("4q", 0, 0, math.ceil(seconds + _SPARED_S), 0), None)
            self._begun[kind] = now

    def end(self) -> None:
        """No call is under way."""
        while self._begun:
            self._set(self._timers[self._begun.popitem()[0]], 0, bytes(32), None)


class OtherModules:
    """What the harness rests on when it is made: modules, and what they and classes hold."""

    def __init__(self) -> None:
        self._loaded = dict(sys.modules)
        watched = [name for name in self._loaded if name in WATCHED or name.partition(".")[0] == OURS[0]]
        places: dict[str, Any] = {name: self._loaded[name] for name in watched}
        types = [cls for module in places.values() for cls in vars(module).values() if isinstance(cls, type)]
        packages = OURS[0], "pathlib", "multiprocessing", "selectors"
        ours = [cls for one in types for cls in one.__mro__ if cls.__module__.partition(".")[0] in packages]
        places |= {f"{cls.__module__}.{cls.__qualname__}": cls for cls in ours}
        self._kept = {name: (place, _called_or_read(vars(place)), set(vars(place))) for name, place in places.items()}

    def restored(self) -> list[str]:
        """Put all back; names, as ``math`` or ``math.sqrt``, that had been replaced or deleted."""
        gone = {name: module for name, module in self._loaded.items() if sys.modules.get(name) is not module}
        changed = [name for name in gone if name in WATCHED or name.partition(".")[0] in OURS]
        sys.modules |= {name: module for name, module in gone.items() if name in changed or name not in sys.modules}
        for name, (place, content, before) in self._kept.items():
            replaced = [key for key, value in content.items() if vars(place).get(key, self) is not value]
            hides = [key for key in vars(place).keys() - before if _inherits(place, key)]
            for key in replaced:
                setattr(place, key, content[key])
            for key in hides:
                delattr(place, key)
            changed += [f"{name}.{key}" for key in replaced + hides]
        if sys.excepthook is None:  # a library's own is nobody's concern; without any no thread starts
            sys.excepthook = sys.__excepthook__
            changed.append("sys.excepthook")
        return changed


def closed_to_files() -> str:
    """Why 16 files [assumed: more than the harness needs at a time] cannot be opened; empty where they can."""
    try:
        with ExitStack() as files:
            for _ in range(16):
                files.enter_context(Path(os.devnull).open("rb"))
    except OSError as error:
        return str(error.strerror)
    return ""


def _called_or_read(names: dict[str, Any]) -> dict[str, Any]:
    kinds = float, type(sys), classmethod, staticmethod, property
    ours = {k: v for k, v in names.items() if k[:2] != "__" or isinstance(v, FunctionType)}
    return {k: v for k, v in ours.items() if not k.endswith("hook") and (callable(v) or type(v) in kinds)}


def _inherits(place: Any, name: str) -> bool:
    return isinstance(place, type) and any(name in vars(base) for base in place.__mro__[1:])
