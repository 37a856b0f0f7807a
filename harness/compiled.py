"""The one way in which the harness compiles: numba, cached, without fast-math.

Bit-exactness rests on three choices made here. No fast-math and no fused operations, so that SUMO's C++ arithmetic can
be matched. No short-vector math library, whose `exp` and `log` differ from the scalar ones depending on how a loop was
vectorised. And a cache of our own under a hash of *all* sources of compiled code. Numba's own cache (also that of
``NUMBA_CACHE_DIR``) looks only at the file that a function stands in, and would keep a caller compiled with an old
callee. It runs what it finds, damaged or not. Where it cannot write it takes another place, whatever lies there, or
refuses the function. Ours knows a function by its module, so that the same sources are compiled once, wherever they are
installed.

It relies on what numba does not document: a kernel's ``_cache`` and what passes through it, a ``CompileResult`` that is
taken apart and put together, ``serialize.dumps``. It was tried with numba 0.62.0, 0.65.1 and 0.68.1.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

from harness import cache
from harness.errors import HarnessError

_Function = TypeVar("_Function", bound=Callable[..., object])
_PACKAGE = Path(__file__).parent


WORLD_SOURCES = (
    "compiled.py",
    "elementary.py",
    "random_stream.py",
    "vocabulary.py",
    "vehicles/*.py",
    "controllers/protocol.py",
    "families/**/*.py",
    "loop/*.py",
    "worlds/twin.py",
)
"""Files that decide what happens in a test, but for `NO_SOURCES`; pools and tables are made again when one changes."""
NO_SOURCES = "words.py", "fitting", "fitting.py"
"""Files and folders of families that do not change any test."""
KERNEL_SOURCES = (*WORLD_SOURCES, "estimators/likelihood.py")
"""All files that compiled code may come from, or take constants from (a test holds this against the imports)."""


def source_files(patterns: tuple[str, ...]) -> list[Path]:
    """Files of some patterns, but for `NO_SOURCES`."""
    files = {path for pattern in patterns for path in _PACKAGE.glob(pattern)}
    return sorted(path for path in files if not set(NO_SOURCES).intersection(path.relative_to(_PACKAGE).parts))


def source_hash(patterns: tuple[str, ...] = KERNEL_SOURCES) -> str:
    """Hash of sources (16 hex digits)."""
    digest = hashlib.sha256()
    for path in source_files(patterns):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


os.environ.setdefault("NUMBA_DISABLE_INTEL_SVML", "1")

try:
    import numba  # (its settings are read at import)
except Exception as error:
    mend = "Correct .numba_config.yaml, if this folder has one, or install the harness again."
    raise HarnessError("numba", f"{type(error).__name__}: {error}", "numba, which compiles kernels", mend) from error
import numpy as np  # noqa: E402
from llvmlite import ir  # noqa: E402
from numba import extending, types  # noqa: E402
from numba.core import caching, compiler, serialize  # noqa: E402

_settings: Any = numba.config
if _settings.USING_SVML:
    found = "Intel's short-vector math library, which changes results"
    mend = "Import harness before numba, and leave NUMBA_DISABLE_INTEL_SVML alone."
    raise HarnessError("numba", found, "the mathematics of the C library", mend)
if _settings.DISABLE_JIT:
    mend = "Unset NUMBA_DISABLE_JIT (or disable_jit in .numba_config.yaml)."
    raise HarnessError("NUMBA_DISABLE_JIT", "that nothing is to be compiled", "kernels as machine code", mend)

KERNELS = f"kernels-{source_hash()}-{sys.implementation.cache_tag}-numba-{version('numba')}"
"""What the cache keeps kernels under."""


_COMPILES_S = 60.0
"""Longer than any kernel takes [assumed]: then what another process has begun is compiled here, too."""


class _KernelCache(caching.NullCache):
    """Numba's cache of a kernel: finds and keeps its compiled code."""

    def __init__(self, function: Callable[..., object]) -> None:
        self._name = f"{KERNELS}/{function.__module__}.{function.__qualname__}-"
        file = Path(function.__code__.co_filename)
        # What comes from outside of the package is not among the sources that the folder is named after.
        self._outside = b"" if file.is_relative_to(_PACKAGE) else file.read_bytes()
        self._compiling = ExitStack()

    def _name_for(self, signature: Any, codegen: Any) -> str:
        kinds = [(str(kind), repr(kind.key)) for kind in signature]
        content = repr((kinds, codegen.magic_tuple())).encode() + self._outside
        return self._name + hashlib.sha256(content).hexdigest()[:24]

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Code compiled for these types and this processor; None if there is none: others then wait for ours."""
        target_context.refresh()
        self._compiling.close()  # left open by a compilation that failed
        name = self._name_for(sig, target_context.codegen())
        if (stored := cache.read(name)) is None:
            self._compiling.enter_context(cache.made_once(name, lambda _: None, most_s=_COMPILES_S))
            if (stored := cache.read(name)) is None:
                return None
            self._compiling.close()
        return compiler.CompileResult._rebuild(target_context, *pickle.loads(stored))  # type: ignore[no-untyped-call] # noqa: S301 - sound, and our own

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code, unless it holds addresses."""
        with self._compiling:
            if not data.library.has_dynamic_globals:
                name = self._name_for(sig, data.codegen)
                cache.keep(name, serialize.dumps(data._reduce()))  # type: ignore[no-untyped-call]

    @property
    def is_filled(self) -> bool:
        """Whether anything has been compiled."""
        return cache.has(f"{self._name}*")


_SETTINGS: dict[str, Any] = {"fastmath": False, "error_model": "numpy"}
_extending: Any = extending


def _njit(function: _Function, **settings: Any) -> _Function:
    kernel: Any = cast("Any", numba.njit)(**_SETTINGS, **settings)(function)
    kernel._cache = _KernelCache(function)
    return cast("_Function", kernel)


def compiled(function: _Function) -> _Function:
    """Compile a kernel to machine code (cached on disk), keeping its Python type for the type checker.

    Kernels allocate nothing: scratch arrays come from the caller.
    """
    return _njit(function)


def compiled_inline(function: _Function) -> _Function:
    """Let kernels inline a small function; elsewhere it stays a function of Python."""
    result: _Function = _extending.register_jitable(forceinline=True, **_SETTINGS)(function)
    return result


def compiled_threads(function: _Function) -> _Function:
    """Compile a kernel that may allocate and lets go of the interpreter lock, so that threads run side by side."""
    return _njit(function, nogil=True)


def is_cached(kernel: Callable[..., object]) -> bool:
    """Whether this or another process has compiled a kernel, for whatever arguments."""
    return cast("_KernelCache", cast("Any", kernel)._cache).is_filled


# -- named tuples as one pointer --
#
# A kernel that is called with named tuples of fifty arrays spends more time on unpacking Python's objects than on 96
# cells. Here they are unpacked once: the tuple is laid out in memory that Python keeps, word by word. In kernels the
# fields of an `unboxed` tuple are read like those of the tuple itself. A tuple within it is a pointer again, so that
# functions within kernels hand on one number each, and are compiled once whoever calls them.

_Bundle = TypeVar("_Bundle", bound=tuple[Any, ...])
_numba: Any = numba


def unboxed(bundle: _Bundle) -> _Bundle:
    """The same named tuple for kernels; Python code goes on with the original, whose arrays it shares.

    The type is a promise to the type checker: what is returned has the fields in compiled code alone.
    """
    result: _Bundle = cast("Any", _Unboxed(bundle))
    return result


class _Unboxed:
    """Keeps a bundle and its words; numba asks for ``_numba_type_``, and its unboxing below for ``address``."""

    __slots__ = ("_bundle", "_memory", "_numba_type_", "_records", "address")

    def __init__(self, bundle: tuple[Any, ...]) -> None:
        self._bundle, self._records = bundle, list[np.ndarray]()
        self._memory = np.array(list(_words(bundle, self._records)), np.int64)
        if (kind := _kind(bundle)) not in _TYPES:
            _TYPES[kind] = _UnboxedType(_numba.typeof(bundle))
        self._numba_type_ = _TYPES[kind]
        self.address: int = self._memory.ctypes.data


_TYPES: dict[Any, _UnboxedType] = {}
"""Numba's types by `_kind`: it takes milliseconds to find the type of a record of many fields."""


def _kind(value: Any) -> Any:
    """Key of numba's type of a value."""
    if isinstance(value, tuple):
        return type(value), *map(_kind, value)
    if isinstance(value, np.ndarray):
        return value.dtype, value.ndim, value.flags.num
    return value.dtype if isinstance(value, np.void) else type(value)


def _words(value: Any, records: list[np.ndarray]) -> Iterator[int]:
    """A value in words of 8 bytes; an array is owner, parent, size, item size, address, shape and strides.

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
    elif isinstance(value, int | np.integer | np.bool_):
        yield int(value)
    else:
        raise TypeError(f"a {type(value).__name__} in a named tuple for kernels")


def _n_words(kind: Any) -> int:
    if isinstance(kind, types.BaseTuple):
        return sum(_n_words(each) for each in cast("Any", kind).types)
    return 5 + 2 * kind.ndim if isinstance(kind, types.Array) else 1


class _UnboxedType(types.BaseNamedTuple):
    """Numba's type of an `_Unboxed` whose bundle is of type ``content``: a named tuple, read by `_read_field`."""

    def __init__(self, content: Any) -> None:
        self.content, self.fields = content, content.fields
        super().__init__(f"unboxed {content.instance_class.__name__}")

    def __getitem__(self, place: int) -> Any:  # type: ignore[override]
        field = self.content.types[place]
        return _UnboxedType(field) if isinstance(field, types.BaseTuple) else field

    def __len__(self) -> int:
        return len(self.fields)

    @property
    def key(self) -> Any:
        """What two equal types have in common."""
        return self.content


def _unbox(_kind: _UnboxedType, obj: Any, c: Any) -> Any:
    address = c.pyapi.object_getattr_string(obj, "address")
    pointer = c.pyapi.long_as_voidptr(address)
    c.pyapi.decref(address)
    return _extending.NativeValue(pointer, is_error=c.pyapi.c_api_error())


def _read_field(context: Any, builder: Any, kind: _UnboxedType, value: Any, name: str) -> Any:
    place = kind.fields.index(name)
    field, before = kind[place], sum(_n_words(each) for each in kind.content.types[:place])
    pointer = builder.gep(value, [ir.IntType(64)(8 * before)], inbounds=True)
    if isinstance(field, _UnboxedType):
        return pointer
    return _load(builder, pointer, context.get_value_type(field), owned=isinstance(field, types.Array))


def _load(builder: Any, pointer: Any, kind: Any, *, owned: bool = False) -> Any:
    """Load a value leaf by leaf, each marked as constant: nobody writes there while a kernel runs.

    An ``owned`` value, an array, gets no owner and parent, which the compiler then knows: it counts no references.
    """
    if not isinstance(kind, ir.Aggregate):
        leaf = builder.load(builder.bitcast(pointer, kind.as_pointer()))
        leaf.set_metadata("invariant.load", builder.module.add_metadata([]))
        return leaf
    words, value = builder.bitcast(pointer, kind.as_pointer()), ir.Constant(kind, ir.Undefined)
    for i, part in enumerate(kind.elements):
        element = builder.gep(words, [ir.IntType(32)(0), ir.IntType(32)(i)], inbounds=True)
        value = builder.insert_value(value, part(None) if owned and i < 2 else _load(builder, element, part), i)
    return value


_extending.register_model(_UnboxedType)(_extending.models.OpaqueModel)
_extending.unbox(_UnboxedType)(_unbox)
_extending.lower_getattr_generic(_UnboxedType)(_read_field)
