"""The one way in which the harness compiles: numba, cached, without fast-math.

Bit-exactness rests on three choices made here. No fast-math and no fused operations, so that SUMO's C++ arithmetic can
be matched. No short-vector math library, whose `exp` and `log` differ from the scalar ones depending on how a loop was
vectorised. And a cache folder named after a hash of *all* sources of compiled code: numba's own cache looks only at the
file that a function stands in and would keep a caller compiled with yesterday's callee.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import platformdirs

_Function = TypeVar("_Function", bound=Callable[..., object])


WORLD_SOURCES = (
    "arrays.py",
    "compiled.py",
    "maneuvers.py",
    "methods.py",
    "outcomes.py",
    "random_stream.py",
    "state.py",
    "unboxed.py",
    "environment/*.py",
    "vehicles/*.py",
    "controllers/protocol.py",
    "criticality/*.py",
    "importance/*.py",
    "episode/*.py",
    "pool/enumeration.py",
    "twin.py",
)
"""All files that decide what happens in a test; pools and tables are made again when one changes."""
KERNEL_SOURCES = (*WORLD_SOURCES, "pool/replay.py", "estimators/limit_search.py")
"""All files that compiled code may come from, or take constants from (a test holds this against the imports)."""


def source_hash(patterns: tuple[str, ...] = KERNEL_SOURCES) -> str:
    """Hash of sources (16 hex digits)."""
    digest = hashlib.sha256()
    root = Path(__file__).parent
    for path in sorted(path for pattern in patterns for path in root.glob(pattern)):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_root() -> Path:
    """Folder for everything that can be made again: compiled kernels and criticality tables.

    ``HARNESS_CACHE_DIR`` moves it, for instance to a folder that CI keeps.
    """
    return Path(os.environ.get("HARNESS_CACHE_DIR") or platformdirs.user_cache_dir("harness"))


os.environ.setdefault("NUMBA_DISABLE_INTEL_SVML", "1")
os.environ["NUMBA_CACHE_DIR"] = str(cache_root() / f"kernels-{source_hash()}")

import numba  # noqa: E402  (its settings are read at import)

_njit: Any = functools.partial(numba.njit, fastmath=False, error_model="numpy")
"""Untyped, because ``_nrt`` is not among the options that numba's own types know."""


def compiled(function: _Function) -> _Function:
    """Compile a kernel to machine code (cached on disk), keeping its Python type for the type checker.

    Kernels allocate nothing: scratch arrays come from the caller. So reference counts can be left out; counting those
    of the arrays that travel in named tuples took two thirds of the time.
    """
    result: _Function = _njit(function, cache=True, _nrt=False)
    return result


def compiled_inline(function: _Function) -> _Function:
    """Compile a small function that is meant to be inlined into kernels by LLVM; not cached on its own."""
    result: _Function = _njit(function, forceinline=True, _nrt=False)
    return result


def compiled_threads(function: _Function) -> _Function:
    """Compile a kernel that may allocate and lets go of the interpreter lock, so that threads run side by side."""
    result: _Function = _njit(function, cache=True, nogil=True)
    return result
