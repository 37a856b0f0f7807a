"""The triangular factor of a tall matrix whose rows come in blocks (TSQR).

A least-squares problem with columns [1, H, Y] is decided by the R of its QR factorisation. R can be carried along
while rows stream by: factor the old R with the new rows below it. Unlike a Gram matrix this never squares the
condition number, and the centring of H and Y by their means falls out of R for free: with the ones first, R without
its first row and column is the factor of the centred columns.
"""

from __future__ import annotations

import ctypes

import numpy as np
from numba.extending import get_cython_function_address

from harness.vocabulary import FloatArray

_PANEL = 32
_DTPQRT = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 12)(
    get_cython_function_address("scipy.linalg.cython_lapack", "dtpqrt")
)
"""LAPACK's own routine: scipy's Python wrapper of it keeps the interpreter lock, so that no two threads could fold."""


def empty_factor(n_columns: int) -> FloatArray:
    """Factor of a matrix without rows, shape (k, k)."""
    return np.zeros((n_columns, n_columns), order="F")


def fold_rows(factor: FloatArray, rows: FloatArray) -> None:
    """Make `factor` that of the matrix behind it with more rows below.

    Parameters
    ----------
    factor : (k, k) float64
        Upper triangular, in Fortran order; receives the new factor. The signs of its rows are arbitrary.
    rows : (m, k) float64
        In Fortran order; destroyed.

    Raises
    ------
    ValueError
        If an array is not in Fortran order, or their widths differ.
    """
    m, k = rows.shape
    if not (factor.flags.f_contiguous and rows.flags.f_contiguous and factor.shape == (k, k)):
        raise ValueError(f"expected Fortran-ordered (k, k) and (m, k), got {factor.shape} and {rows.shape}")
    if m == 0:
        return
    panel = min(_PANEL, k)
    reflectors, work = np.empty((panel, k), order="F"), np.empty(panel * k)
    sizes, info = [ctypes.c_int(value) for value in (m, k, 0, panel)], ctypes.c_int()
    rows_, columns, rows_already_triangular, panel_ = map(ctypes.addressof, sizes)
    a, b, t, scratch = (array.ctypes.data for array in (factor, rows, reflectors, work))
    of_result = ctypes.addressof(info)
    _DTPQRT(rows_, columns, rows_already_triangular, panel_, a, columns, b, rows_, t, panel_, scratch, of_result)
    if info.value != 0:
        raise ArithmeticError(f"LAPACK dtpqrt refused argument {-info.value}")
