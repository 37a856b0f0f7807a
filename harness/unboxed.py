"""Named tuples that kernels are given as one pointer, because they have been taken apart before.

A kernel that is called with named tuples of fifty arrays spends more time on reading Python's objects than on 96
cells. Here that is done once: the tuple is laid out, as compiled code would see it, in memory that Python keeps. In
kernels the fields of an `unboxed` tuple are read like those of the tuple itself; a tuple within it is a pointer again,
so that parts of kernels hand on one number each, and are compiled once whoever calls them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.registry import cpu_target
from numba.core.typing.templates import AttributeTemplate

import harness.compiled  # noqa: F401  (numba's settings)

_Bundle = TypeVar("_Bundle", bound=tuple[Any, ...])
_numba: Any = numba
_extending: Any = extending
_cgutils: Any = cgutils
"""Untyped, because numba has types for some of it only."""


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
