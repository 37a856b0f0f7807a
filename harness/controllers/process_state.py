"""What a controller must leave as it finds it in the process that it shares with the harness.

Kernels round as the processor is told to, and everything else calls Python's modules and numpy: a vehicle that changes
either changes numbers of the harness, or breaks it elsewhere.
"""

from __future__ import annotations

import ctypes
import platform
import sys
from functools import partial
from typing import Any

WATCHED = ("builtins", "math", "json", "os", "pickle", "struct", "time", "numpy")
CHANGED_MODES = "changed the processor's rounding mode or floating-point flags (fesetround, -ffast-math); restore them"

_ROOM = 64
_CONTROL = {"x86_64": ((0, 0xFFFFFFFF), (7, 0xFFC0)), "aarch64": ((0, 0xFFFFFFFF),)}
"""Words of the C library's ``fenv_t`` on Linux, and their bits, that say how to compute: not what has been met.

On x86-64 the control word of the x87 and MXCSR: rounding, flush to zero, denormals are zero, masked exceptions.
"""


class FloatingPointModes:
    """Those of this thread when it is made; looking at them again takes half a microsecond."""

    def __init__(self) -> None:
        words = _CONTROL.get(platform.machine(), ()) if sys.platform == "linux" else ()
        libc = ctypes.CDLL("libm.so.6" if platform.libc_ver()[0] == "glibc" else None)
        self._kept, now = ctypes.create_string_buffer(_ROOM), ctypes.create_string_buffer(_ROOM)
        self._words, kept = (memoryview(buffer).cast("B").cast("I") for buffer in (now, self._kept))
        if words:
            self._write, self._look = libc.fesetenv, partial(libc.fegetenv, ctypes.byref(now))
            libc.fegetenv(self._kept)
        self._expected = [(word, mask, kept[word] & mask) for word, mask in words]

    def restored(self) -> bool:
        """Whether they had been changed; they are as before."""
        if not self._expected:
            return False
        self._look()
        for word, mask, kept in self._expected:
            if self._words[word] & mask != kept:
                self._write(self._kept)
                return True
        return False


class OtherModules:
    """What the modules that the harness itself rests on hold when it is made."""

    def __init__(self) -> None:
        self._kept = {name: _functions_and_numbers(vars(sys.modules[name])) for name in WATCHED}

    def restored(self) -> list[str]:
        """Names, as ``math.sqrt``, that had been replaced or deleted; they are as before."""
        changed = []
        for name, kept in self._kept.items():
            there = vars(sys.modules[name])
            changed += [f"{name}.{key}" for key, value in kept.items() if there.get(key, self) is not value]
            there.update(kept)
        return changed


def _functions_and_numbers(held: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in held.items() if key[:2] != "__" and (callable(value) or type(value) is float)}
