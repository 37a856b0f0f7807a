"""Cumulative distribution of Student's t as a table that kernels can read.

Cubic Hermite interpolation of scipy's exact values and densities on a grid of 1/32 (absolute error below 1e-8,
tested). Sampling and probabilities both go through the same table, so a recorded probability *is* the probability that
was sampled from.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from harness.arrays import FloatArray
from harness.compiled import compiled_inline

_LIMIT = 64.0
_PER_UNIT = 32.0


def t_table(df: float) -> FloatArray:
    """Table of the distribution function on [-64, 64].

    Returns
    -------
    ndarray of float64, shape (4097, 2)
        Values, and derivatives times the grid step.
    """
    z = np.arange(-_LIMIT * _PER_UNIT, _LIMIT * _PER_UNIT + 1) / _PER_UNIT
    peak = special.poch(0.5 * df, 0.5) / np.sqrt(df * np.pi)
    density = peak * np.exp(-0.5 * (df + 1.0) * np.log1p(z * z / df))
    return np.column_stack([special.stdtr(df, z), density / _PER_UNIT])


@compiled_inline
def t_cdf(z: float, table: FloatArray) -> float:
    """P(T ≤ z); 0 and 1 outside of the table."""
    position = (z + _LIMIT) * _PER_UNIT
    if not position > 0.0:
        return 0.0
    if position >= table.shape[0] - 1:
        return 1.0
    i = int(position)
    s = position - i
    y0, y1 = table[i, 0], table[i + 1, 0]
    d0, d1 = table[i, 1], table[i + 1, 1]
    rise = y1 - y0
    return float(y0 + s * (d0 + s * ((3.0 * rise - 2.0 * d0 - d1) + s * (d0 + d1 - 2.0 * rise))))
