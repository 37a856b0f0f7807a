"""The one way in which the harness compiles: numba, cached, without fast-math.

Bit-exactness rests on three choices made here. No fast-math and no fused operations, so that SUMO's C++ arithmetic can
be matched. No short-vector math library, whose `exp` and `log` differ from the scalar ones depending on how a loop was
vectorised. And a cache folder named after a hash of *all* sources of compiled code: numba's own cache looks only at the
file that a function stands in and would keep a caller compiled with yesterday's callee. In it a file is known by its
place in the package, not on the disk, so that the same sources are compiled once, wherever they are installed; by two
versions of numba in two folders, since each throws away what the other has kept.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

import platformdirs

_Function = TypeVar("_Function", bound=Callable[..., object])
_PACKAGE = Path(__file__).parent


WORLD_SOURCES = (
    "compiled.py",
    "maneuvers.py",
    "random_stream.py",
    "unboxed.py",
    "vocabulary.py",
    "traffic/*.py",
    "vehicles/*.py",
    "controllers/protocol.py",
    "importance/*.py",
    "episode/*.py",
    "pool/walk.py",
    "worlds/twin.py",
)
"""All files that decide what happens in a test; pools and tables are made again when one changes."""
KERNEL_SOURCES = (*WORLD_SOURCES, "pool/replay.py", "estimators/likelihood.py")
"""All files that compiled code may come from, or take constants from (a test holds this against the imports)."""


def source_hash(patterns: tuple[str, ...] = KERNEL_SOURCES) -> str:
    """Hash of sources (16 hex digits)."""
    digest = hashlib.sha256()
    for path in sorted(path for pattern in patterns for path in _PACKAGE.glob(pattern)):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_root() -> Path:
    """Folder for everything that can be made again: compiled kernels and criticality tables.

    ``HARNESS_CACHE_DIR`` moves it, for instance to a folder that CI keeps.
    """
    return Path(os.environ.get("HARNESS_CACHE_DIR") or platformdirs.user_cache_dir("harness"))


os.environ.setdefault("NUMBA_DISABLE_INTEL_SVML", "1")
os.environ["NUMBA_CACHE_DIR"] = str(cache_root() / f"kernels-{source_hash()}-numba-{version('numba')}")

import numba  # noqa: E402  (its settings are read at import)
from numba import extending  # noqa: E402
from numba.core import caching, codegen, compiler  # noqa: E402


class KernelCacheLocator(caching.UserProvidedCacheLocator):
    """Where numba keeps the package's kernels: by folder of the package."""

    @classmethod
    def from_function(cls, py_func: Callable[..., object], py_file: str) -> Any:
        """None for a function from outside of the package, which is another locator's."""
        if Path(py_file).is_relative_to(_PACKAGE):
            return super().from_function(py_func, py_file)  # type: ignore[no-untyped-call]
        return None

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """Name of the folder within the cache."""
        return "-".join(("harness", *Path(py_file).relative_to(_PACKAGE).parent.parts))


_settings: Any = numba.config
if _settings.USING_SVML:
    raise ImportError(
        "numba was imported before harness, and uses Intel's short-vector math library, which changes results: "
        "import harness first, or set NUMBA_DISABLE_INTEL_SVML=1"
    )
_settings.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]  # where numba was imported before, it has not read it
# Not by numba's environment variable: programs that a controller starts inherit that, and may not have this package.
_OTHERS = "UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,IPythonCacheLocator,ZipCacheLocator"
_settings.CACHE_LOCATOR_CLASSES = (
    f"{__name__}.{KernelCacheLocator.__name__},{_settings.CACHE_LOCATOR_CLASSES or _OTHERS}"
)


class _NoMachineCode:
    """In the place of a code generator that is asked to tell machine code where it stands."""

    @staticmethod
    def set_env(name: str, environment: Any) -> None:
        """Nothing to be told."""


class _PartLibrary(codegen.JITCodeLibrary):
    """Code of a part, to be linked into kernels, and made fast and turned into machine code only there."""

    codegen: Any = _NoMachineCode

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:  # noqa: ARG002
        """Nowhere, but numba asks for it when the part is complete."""
        self._ensure_finalized()  # type: ignore[no-untyped-call]
        return 0


class PartCompiler(compiler.Compiler):
    """Numba's compiler, for parts of kernels."""

    def define_pipelines(self) -> Any:
        """Numba's own, which add to this library."""
        state: Any = self.state
        state.library = _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)  # type: ignore[no-untyped-call]
        return super().define_pipelines()  # type: ignore[no-untyped-call]


_SETTINGS: dict[str, Any] = {"cache": True, "fastmath": False, "error_model": "numpy", "no_cfunc_wrapper": True}
_njit: Any = functools.partial(numba.njit, **_SETTINGS)
_register: Any = extending.register_jitable
"""Untyped, because ``_nrt`` is not among the options that numba's own types know."""


def compiled(function: _Function) -> _Function:
    """Compile a kernel to machine code (cached on disk), keeping its Python type for the type checker.

    Kernels allocate nothing: scratch arrays come from the caller. So reference counts can be left out; counting those
    of the arrays that travel in named tuples took two thirds of the time.
    """
    result: _Function = _njit(function, _nrt=False)
    return result


def compiled_inline(function: _Function) -> _Function:
    """Let kernels inline a small function; elsewhere it is what it is, a function of Python.

    A process compiles it once for all kernels, half of the way: what LLVM does takes most of the time, and is left to
    the kernels that it becomes part of.
    """
    settings = {**_SETTINGS, "cache": False, "no_cpython_wrapper": True, "pipeline_class": PartCompiler}
    result: _Function = _register(forceinline=True, _nrt=False, **settings)(function)
    return result


def compiled_threads(function: _Function) -> _Function:
    """Compile a kernel that may allocate and lets go of the interpreter lock, so that threads run side by side."""
    result: _Function = _njit(function, nogil=True)
    return result


def is_cached(kernel: Callable[..., object]) -> bool:
    """Whether this or another process has compiled a kernel, for whatever arguments."""
    stats = cast("Any", kernel).stats
    return any(Path(stats.cache_path).glob(f"*.{kernel.__name__}-*.nbi"))
