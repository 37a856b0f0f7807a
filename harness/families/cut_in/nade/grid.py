"""Grids of the criticality tables and multilinear interpolation on them.

Axes: BV's speed (uniform), R2 (quadratic spacing: fine where braking distances end, coarse far away) and R2dot
(uniform). States outside are clamped to the border.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.compiled import compiled_inline
from harness.vocabulary import Float32Array, FloatArray


class Axis(NamedTuple):
    """Grid points lie at ``low + step i``, for R2 at ``step i²``."""

    low: float
    step: float
    size: int


class Grid(NamedTuple):
    """Axes of a table: v_BV (m/s), R2 (m), R2dot (m/s)."""

    speed: Axis
    r2: Axis
    r2dot: Axis

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a table."""
        return self.speed.size, self.r2.size, self.r2dot.size


class GridPoints(NamedTuple):
    """Where a table has entries, by axis: v_BV (m/s), R2 (m), R2dot (m/s)."""

    speed: FloatArray
    r2: FloatArray
    r2dot: FloatArray


AFTER = Grid(Axis(5.0, 5.0, 9), Axis(0.0, 90.0 / 149.0**2, 150), Axis(-24.0, 0.25, 121))
BEFORE = Grid(Axis(20.0, 5.0, 5), Axis(0.0, 110.0 / 99.0**2, 100), Axis(-18.0, 1.0, 21))
"""After the cut-in, and before it."""


def points_of(grid: Grid) -> GridPoints:
    """Points of the axes."""
    speed, r2dot = (axis.low + axis.step * np.arange(axis.size, dtype=np.float64) for axis in (grid.speed, grid.r2dot))
    return GridPoints(speed, grid.r2.step * np.arange(grid.r2.size, dtype=np.float64) ** 2.0, r2dot)


@compiled_inline
def state_at(points: GridPoints, i: int, j: int, k: int) -> tuple[float, float, float]:
    """State of a table's entry."""
    return points.speed[i], points.r2[j], points.r2dot[k]


@compiled_inline
def locate_uniform(x: float, axis: Axis) -> tuple[int, float]:
    """Cell index and the weight of its upper end."""
    position = min(max((x - axis.low) / axis.step, 0.0), axis.size - 1.0)
    i = min(int(position), axis.size - 2)
    return i, position - i


@compiled_inline
def locate_quadratic(x: float, axis: Axis) -> tuple[int, float]:
    """Cell index and the weight of its upper end on the R2 axis (linear in R2)."""
    i = min(int(math.sqrt(max(x, 0.0) / axis.step)), axis.size - 2)
    low = axis.step * (i * i)
    weight = (x - low) / (axis.step * (2.0 * i + 1.0))
    return i, min(max(weight, 0.0), 1.0)


@compiled_inline
def locate(grid: Grid, v: float, r2: float, r2dot: float) -> tuple[int, float, int, float, int, float]:
    """Where a state lies in the tables of a grid: three cell indices, each with the weight of its upper end."""
    i, a = locate_uniform(v, grid.speed)
    j, b = locate_quadratic(r2, grid.r2)
    k, c = locate_uniform(r2dot, grid.r2dot)
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
