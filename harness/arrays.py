"""Names for the array types that cross module borders."""

from __future__ import annotations

from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
Float32Array: TypeAlias = NDArray[np.float32]
IntArray: TypeAlias = NDArray[np.int64]
UInt64Array: TypeAlias = NDArray[np.uint64]
Int8Array: TypeAlias = NDArray[np.int8]
BoolArray: TypeAlias = NDArray[np.bool_]
RecordArray: TypeAlias = NDArray[Any]
"""A structured array; its fields are described where its dtype is."""
Record: TypeAlias = Any
"""One element of a structured array, as kernels see it: fields are attributes."""


_Scalar = TypeVar("_Scalar", bound=np.generic)


def read_only(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """The array itself, from now on closed to writing; views that are made of it later are closed, too."""
    array.setflags(write=False)
    return array
