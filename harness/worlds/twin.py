"""The same dynamics without SUMO: oracle of the differential tests, and engine where SUMO would be too slow."""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled
from harness.vehicles.kinematics import CONTACT_M, gap, next_position, overlaps
from harness.vocabulary import AV, BV, LV, BoolArray, FloatArray, Int8Array, IntArray
from harness.worlds import World


@compiled
def advance(x: FloatArray, v: FloatArray, speed: FloatArray) -> None:
    """Move all vehicles (K, 3) to the commanded speeds, in SUMO's arithmetic."""
    for k in range(x.shape[0]):
        for vehicle in range(3):
            x[k, vehicle] = next_position(x[k, vehicle], v[k, vehicle], speed[k, vehicle])
            v[k, vehicle] = speed[k, vehicle]


@compiled
def contacts(x: FloatArray, on_right: Int8Array, cut_in: Int8Array, out: BoolArray) -> None:
    """Which cells (K,) have vehicles of one lane in contact.

    ``on_right`` (K,) says whose BV has cut in, ``cut_in`` (K,) whose did in this step: it has moved on the left lane
    before it changes to the right one, and may touch vehicles on both.
    """
    for k in range(x.shape[0]):
        out[k] = False
        if on_right[k]:
            out[k] = overlaps(x[k, BV], x[k, AV])
        if cut_in[k] or not on_right[k]:
            out[k] = out[k] or gap(x[k, LV], x[k, BV]) < CONTACT_M


class TwinWorld(World):
    """World without SUMO."""

    def __init__(self, n_cells: int) -> None:
        super().__init__(n_cells)
        self._on_right: Int8Array = np.zeros(n_cells, np.int8)

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray) -> None:
        self.x[cells] = x[cells]
        self.v[cells] = v[cells]
        self._on_right[cells] = 0

    def step(self, speed: FloatArray, cut_in: Int8Array) -> BoolArray:
        self._on_right |= cut_in
        advance(self.x, self.v, speed)
        contacts(self.x, self._on_right, cut_in, self._contact)
        return self._contact
