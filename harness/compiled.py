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
import struct
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

import platformdirs

_Function = TypeVar("_Function", bound=Callable[..., object])
_PACKAGE = Path(__file__).parent


WORLD_SOURCES = (
    "compiled.py",
    "random_stream.py",
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
KERNEL_SOURCES = (*WORLD_SOURCES, "pool/replay.py", "pool/learned.py", "estimators/likelihood.py")
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
import numpy as np  # noqa: E402
from llvmlite import ir  # noqa: E402
from numba import extending  # noqa: E402
from numba.core import caching, cgutils, codegen, compiler, types  # noqa: E402
from numba.core.registry import cpu_target  # noqa: E402
from numba.core.typing.templates import AttributeTemplate  # noqa: E402


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


# -- named tuples that kernels are given as one pointer, because they have been taken apart before --
#
# A kernel that is called with named tuples of fifty arrays spends more time on reading Python's objects than on 96
# cells. Here that is done once: the tuple is laid out, as compiled code would see it, in memory that Python keeps. In
# kernels the fields of an `unboxed` tuple are read like those of the tuple itself; a tuple within it is a pointer
# again, so that parts of kernels hand on one number each, and are compiled once whoever calls them.

_Bundle = TypeVar("_Bundle", bound=tuple[Any, ...])
_numba: Any = numba
_extending: Any = extending
_cgutils: Any = cgutils


def unboxed(bundle: _Bundle) -> _Bundle:
    """The same named tuple for kernels; Python code goes on with the original, whose arrays it shares.

    The type is a promise to the type checker: what is returned has the fields in compiled code alone.
    """
    result: _Bundle = cast("Any", _Unboxed(bundle))
    return result


class _Unboxed:
    """Keeps a bundle and its native form; numba asks for ``_numba_type_``, and its unboxing below for ``address``."""

    __slots__ = ("_bundle", "_memory", "_numba_type_", "_records", "address")

    def __init__(self, bundle: tuple[Any, ...]) -> None:
        content, context = _numba.typeof(bundle), cpu_target.target_context
        self._bundle, self._records = bundle, list[np.ndarray]()
        self._memory = np.array(list(_words(bundle, self._records)), np.int64)
        self._numba_type_ = _UnboxedType(content)
        self.address: int = self._memory.ctypes.data
        if self._memory.nbytes != context.get_abi_sizeof(context.get_value_type(content)):
            raise TypeError(f"{type(bundle).__name__} has fields that are not laid out as 8 bytes each")


def _words(value: Any, records: list[np.ndarray]) -> Iterator[int]:
    """A value as numba lays it out: an array is owner, parent, size, item size, address, shape and strides.

    A record by itself does not say where it is: a copy joins ``records``, for the caller to keep.
    """
    if isinstance(value, tuple):
        for field in value:
            yield from _words(field, records)
    elif isinstance(value, np.ndarray):
        yield from (0, 0, value.size, value.itemsize, value.ctypes.data, *value.shape, *value.strides)
    elif isinstance(value, np.void):
        records.append(np.array(value))
        yield records[-1].ctypes.data
    elif isinstance(value, float):
        yield from struct.unpack("q", struct.pack("d", value))
    else:
        yield int(value)


class _UnboxedType(types.Type):
    """Numba's type of an `_Unboxed` whose bundle is of type ``content``."""

    def __init__(self, content: Any) -> None:
        self.content = content
        super().__init__(f"unboxed {content.instance_class.__name__}")

    @property
    def key(self) -> Any:
        """What two equal types have in common."""
        return self.content


class _PointerModel(extending.models.PrimitiveModel):
    def __init__(self, manager: Any, kind: _UnboxedType) -> None:
        super().__init__(manager, kind, cgutils.voidptr_t)  # type: ignore[no-untyped-call]


def _unbox(_kind: _UnboxedType, obj: Any, c: Any) -> Any:
    address = c.pyapi.object_getattr_string(obj, "address")
    pointer = c.pyapi.long_as_voidptr(address)
    c.pyapi.decref(address)
    return _extending.NativeValue(pointer, is_error=c.pyapi.c_api_error())


class _Fields(AttributeTemplate):
    key = _UnboxedType

    def generic_resolve(self, kind: _UnboxedType, name: str) -> Any:  # type: ignore[override]
        content = kind.content
        if name not in content.fields:
            return None
        field = content.types[content.fields.index(name)]
        return _UnboxedType(field) if isinstance(field, types.BaseNamedTuple) else field


def _read_field(context: Any, builder: Any, kind: _UnboxedType, value: Any, name: str) -> Any:
    content = kind.content
    place = content.fields.index(name)
    pointer = builder.bitcast(value, context.get_value_type(content).as_pointer())
    field = _cgutils.gep_inbounds(builder, pointer, 0, place)
    if isinstance(content.types[place], types.BaseNamedTuple):
        return builder.bitcast(field, cgutils.voidptr_t)
    return _load(builder, field)


def _load(builder: Any, pointer: Any) -> Any:
    """Load a value leaf by leaf: while a kernel runs nobody writes there, which the compiler is told of each leaf."""
    kind = pointer.type.pointee
    if not isinstance(kind, ir.Aggregate):
        leaf = builder.load(pointer)
        leaf.set_metadata("invariant.load", builder.module.add_metadata([]))
        return leaf
    value = ir.Constant(kind, ir.Undefined)
    for i in range(len(kind)):
        value = builder.insert_value(value, _load(builder, _cgutils.gep_inbounds(builder, pointer, 0, i)), i)
    return value


_extending.register_model(_UnboxedType)(_PointerModel)
_extending.unbox(_UnboxedType)(_unbox)
_extending.infer_getattr(_Fields)
_extending.lower_getattr_generic(_UnboxedType)(_read_field)
