"""The intelligent driver model, per vehicle: `av: {controller: "examples.idm:IDM"}`."""

import math

from harness.controllers import EpisodeStart, Observation


def idm_acceleration(speed: float, lead_speed: float, gap: float, min_acceleration_mps2: float = -4.0) -> float:
    """Acceleration (m/s²), with the operations of the built-in model in their order: the same bits."""
    desired = 2.0 + max(0.0, speed * 1.0 + (speed * (speed - lead_speed)) / (2.0 * math.sqrt(2.0 * 3.0)))
    ratio = speed / 40.0
    squared, close = ratio * ratio, desired / max(gap, 0.1)
    return min(max(2.0 * (1.0 - squared * squared - close * close), min_acceleration_mps2), 2.0)


def cruise(speed: float, set_speed: float) -> float:
    """Acceleration (m/s²) towards the set speed, where nobody is ahead."""
    return min(max(0.5 * (set_speed - speed), -2.0), 2.0)


class IDM:
    """One AV."""

    def __init__(self, min_acceleration_mps2: float = -4.0) -> None:
        self.min_acceleration_mps2 = min_acceleration_mps2

    def start(self, episode: EpisodeStart) -> None:
        """Nothing to forget."""

    def step(self, seen: Observation) -> float:
        """Acceleration (m/s²) behind the vehicle ahead; without one it keeps its set speed."""
        if math.isinf(seen.gap_m):
            return cruise(seen.speed_mps, seen.set_speed_mps)
        return idm_acceleration(seen.speed_mps, seen.lead_speed_mps, seen.gap_m, self.min_acceleration_mps2)

    def close(self) -> None:
        """Nothing to release."""
