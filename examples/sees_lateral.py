"""The intelligent driver model of `examples.idm`, for cut-ins that take time: BV is ahead as soon as it comes over.

``perceives_m`` is how far it has to have come over; a driver with 2 m waits for the overlap, and keeps its speed until
then. Both drive alike once BV is on their lane.
"""

from __future__ import annotations

from examples.idm import cruise, idm_acceleration
from harness.controllers import EpisodeStart, Observation
from harness.vehicles.kinematics import VEHICLE_LENGTH_M


class Yields:
    """One vehicle."""

    def __init__(self, perceives_m: float = 0.375, min_acceleration_mps2: float = -4.0) -> None:
        self._perceives_m = perceives_m
        self._min = min_acceleration_mps2

    def start(self, episode: EpisodeStart) -> None:
        """Nothing to remember."""

    def step(self, seen: Observation) -> float:
        """Follow BV from where it is seen to come over."""
        comes = seen.bv_lateral_speed_mps > 0.0 and seen.bv_lateral_m >= self._perceives_m - 1e-9
        if not (comes or seen.bv_overlaps):
            return cruise(seen.speed_mps, seen.set_speed_mps)
        gap_m = seen.bv.position_m - VEHICLE_LENGTH_M - seen.position_m
        return idm_acceleration(seen.speed_mps, seen.bv.speed_mps, gap_m, self._min)

    def close(self) -> None:
        """Nothing to release."""
