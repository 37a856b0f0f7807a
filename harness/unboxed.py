"""Named tuples that kernels are given as one pointer, because numba has taken them apart before.

A kernel that is called with named tuples of fifty arrays spends more time on reading Python's objects than on 96 cells.
Here that is done once: a compiled function stores the tuple, as compiled code sees it, into memory that Python keeps.
In kernels the fields of an `unboxed` tuple are read like those of the tuple itself.
"""

from __future__ import annotations

from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.registry import cpu_target
from numba.core.typing.templates import AttributeTemplate

from harness.compiled import compiled

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

    __slots__ = ("_bundle", "_memory", "_numba_type_", "address")

    def __init__(self, bundle: tuple[Any, ...]) -> None:
        content = _numba.typeof(bundle)
        context = cpu_target.target_context
        self._bundle = bundle
        self._memory = np.zeros(context.get_abi_sizeof(context.get_value_type(content)), np.uint8)
        self._numba_type_ = _UnboxedType(content)
        self.address: int = self._memory.ctypes.data
        _write(bundle, self.address)


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
        return content.types[content.fields.index(name)] if name in content.fields else None


def _read_field(context: Any, builder: Any, kind: _UnboxedType, value: Any, name: str) -> Any:
    pointer = builder.bitcast(value, context.get_value_type(kind.content).as_pointer())
    return _load(builder, _cgutils.gep_inbounds(builder, pointer, 0, kind.content.fields.index(name)))


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


def _store_typed(_context: Any, bundle: Any, _address: Any) -> Any:
    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        value, address = arguments
        builder.store(value, builder.inttoptr(address, value.type.as_pointer()))
        return context.get_dummy_value()

    return types.void(bundle, types.intp), generate


_extending.register_model(_UnboxedType)(_PointerModel)
_extending.unbox(_UnboxedType)(_unbox)
_extending.infer_getattr(_Fields)
_extending.lower_getattr_generic(_UnboxedType)(_read_field)
_store: Any = _extending.intrinsic(_store_typed)


@compiled
def _write(bundle: tuple[Any, ...], address: int) -> None:
    _store(bundle, address)
