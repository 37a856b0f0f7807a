"""Grids of the criticality tables and multilinear interpolation on them.

Axes: BV's speed (uniform), R2 (quadratic spacing: fine where braking distances end, coarse far away) and R2dot
(uniform). States outside are clamped to the border.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.arrays import Float32Array, FloatArray
from harness.compiled import compiled_inline


class Axis(NamedTuple):
    """Grid points lie at ``low + step i``, for R2 at ``step i²``."""

    low: float
    step: float
    size: int


AFTER_V = Axis(5.0, 5.0, 9)
AFTER_R2 = Axis(0.0, 90.0 / 149.0**2, 150)
AFTER_RATE = Axis(-24.0, 0.25, 121)
BEFORE_V = Axis(20.0, 5.0, 5)
BEFORE_R2 = Axis(0.0, 110.0 / 99.0**2, 100)
BEFORE_RATE = Axis(-18.0, 1.0, 21)


def uniform_points(axis: Axis) -> FloatArray:
    """Grid points of a uniform axis, shape (size,)."""
    points: FloatArray = axis.low + axis.step * np.arange(axis.size, dtype=np.float64)
    return points


def quadratic_points(axis: Axis) -> FloatArray:
    """Grid points of the R2 axis (m), shape (size,)."""
    points: FloatArray = axis.step * np.arange(axis.size, dtype=np.float64) ** 2.0
    return points


@compiled_inline
def locate_uniform(x: float, low: float, step: float, size: int) -> tuple[int, float]:
    """Cell index and the weight of its upper end."""
    position = min(max((x - low) / step, 0.0), size - 1.0)
    i = min(int(position), size - 2)
    return i, position - i


@compiled_inline
def locate_quadratic(x: float, step: float, size: int) -> tuple[int, float]:
    """Cell index and the weight of its upper end on the R2 axis (linear in R2)."""
    i = min(int(math.sqrt(max(x, 0.0) / step)), size - 2)
    low = step * (i * i)
    weight = (x - low) / (step * (2.0 * i + 1.0))
    return i, min(max(weight, 0.0), 1.0)


@compiled_inline
def locate_after(v: float, r2: float, r2dot: float) -> tuple[int, float, int, float, int, float]:
    """Where a state after the cut-in lies in the tables: three cell indices, each with the weight of its upper end."""
    i, a = locate_uniform(v, AFTER_V.low, AFTER_V.step, AFTER_V.size)
    j, b = locate_quadratic(r2, AFTER_R2.step, AFTER_R2.size)
    k, c = locate_uniform(r2dot, AFTER_RATE.low, AFTER_RATE.step, AFTER_RATE.size)
    return i, a, j, b, k, c


@compiled_inline
def locate_before(v: float, r2: float, r2dot: float) -> tuple[int, float, int, float, int, float]:
    """Where a state before the cut-in lies in the tables."""
    i, a = locate_uniform(v, BEFORE_V.low, BEFORE_V.step, BEFORE_V.size)
    j, b = locate_quadratic(r2, BEFORE_R2.step, BEFORE_R2.size)
    k, c = locate_uniform(r2dot, BEFORE_RATE.low, BEFORE_RATE.step, BEFORE_RATE.size)
    return i, a, j, b, k, c


@compiled_inline
def interpolate(table: Float32Array, where: tuple[int, float, int, float, int, float]) -> float:
    """Trilinear interpolation of ``table`` (v, R2, R2dot)."""
    i, a, j, b, k, c = where
    low = (1.0 - b) * ((1.0 - c) * table[i, j, k] + c * table[i, j, k + 1]) + b * (
        (1.0 - c) * table[i, j + 1, k] + c * table[i, j + 1, k + 1]
    )
    high = (1.0 - b) * ((1.0 - c) * table[i + 1, j, k] + c * table[i + 1, j, k + 1]) + b * (
        (1.0 - c) * table[i + 1, j + 1, k] + c * table[i + 1, j + 1, k + 1]
    )
    return float((1.0 - a) * low + a * high)


@compiled_inline
def interpolate_maneuvers(
    table: Float32Array, where: tuple[int, float, int, float, int, float], out: FloatArray
) -> None:
    """Trilinear interpolation of ``table`` (v, R2, R2dot, 31) for all maneuvers at once, to ``out`` (31,).

    The same operations as in `interpolate`, in a loop that the compiler can vectorise.
    """
    i, a, j, b, k, c = where
    low0, low1, low2, low3 = table[i, j, k], table[i, j, k + 1], table[i, j + 1, k], table[i, j + 1, k + 1]
    i += 1
    high0, high1, high2, high3 = table[i, j, k], table[i, j, k + 1], table[i, j + 1, k], table[i, j + 1, k + 1]
    for m in range(out.size):
        low = (1.0 - b) * ((1.0 - c) * low0[m] + c * low1[m]) + b * ((1.0 - c) * low2[m] + c * low3[m])
        high = (1.0 - b) * ((1.0 - c) * high0[m] + c * high1[m]) + b * ((1.0 - c) * high2[m] + c * high3[m])
        out[m] = (1.0 - a) * low + a * high
