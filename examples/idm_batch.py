"""The intelligent driver model over arrays: `av: {controller: "examples.idm_batch:IDM"}`."""

import math
from typing import Any

import numpy as np


class IDM:
    """All AVs of a worker at once."""

    braking_mps2 = 4.0
    """Hardest braking."""

    def start_batch(self, cells: Any, episodes: Any, random: Any) -> None:
        """Nothing to forget."""

    def step_batch(self, seen: Any) -> Any:
        """Accelerations (m/s²); where nobody is ahead they keep their set speed."""
        gap, speed = np.maximum(seen.gap_m, 0.1), seen.speed_mps
        closing = (speed * (speed - seen.lead_speed_mps)) / (2.0 * math.sqrt(2.0 * 3.0))
        desired = 2.0 + np.fmax(0.0, speed * 1.0 + closing)  # fmax: no speed (NaN) where nobody is ahead
        ratio = speed / 40.0
        squared, close = ratio * ratio, desired / gap
        following = np.maximum(2.0 * (1.0 - squared * squared - close * close), -self.braking_mps2)
        cruising = np.maximum(0.5 * (seen.set_speed_mps - speed), -2.0)
        return np.minimum(np.where(np.isinf(seen.gap_m), cruising, following), 2.0)

    def close(self) -> None:
        """Nothing to release."""
