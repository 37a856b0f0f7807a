"""The same dynamics without SUMO: oracle of the differential tests, and engine where SUMO would be too slow."""

from __future__ import annotations

from harness.compiled import compiled
from harness.vehicles.kinematics import next_position, overlaps
from harness.vocabulary import BoolArray, FloatArray, Int8Array, IntArray
from harness.worlds import World


@compiled
def advance(x: FloatArray, v: FloatArray, speed: FloatArray) -> None:
    """Move all vehicles (K, V) to the commanded speeds, in SUMO's arithmetic."""
    for k in range(x.shape[0]):
        for vehicle in range(x.shape[1]):
            x[k, vehicle] = next_position(x[k, vehicle], v[k, vehicle], speed[k, vehicle])
            v[k, vehicle] = speed[k, vehicle]


@compiled
def contacts(x: FloatArray, before: Int8Array, lane: Int8Array, out: BoolArray) -> None:
    """Write to ``out`` (K,) in which cells vehicles of one lane are in contact.

    A vehicle that changes lanes in a step moves on the lane that it had ``before`` (K, V) and then changes to its
    ``lane`` (K, V): it may touch vehicles on both.
    """
    for k in range(x.shape[0]):
        out[k] = False
        for one in range(x.shape[1]):
            for other in range(one):
                meet = lane[k, one] == lane[k, other] or before[k, one] == before[k, other]
                out[k] = out[k] or (meet and overlaps(x[k, one], x[k, other]))


class TwinWorld(World):
    """World without SUMO."""

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray, lane: Int8Array) -> None:
        self.x[cells], self.v[cells], self.lane[cells] = x[cells], v[cells], lane[cells]

    def step(self, speed: FloatArray, lane: Int8Array) -> BoolArray:
        advance(self.x, self.v, speed)
        contacts(self.x, self.lane, lane, self._contact)
        self.lane[:] = lane
        return self._contact
