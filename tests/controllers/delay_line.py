"""What a vehicle that acts late has measured: it may start empty or full, and goes into an FMU as it is."""

import math
from collections import deque

DELAY_STEPS = 5


class Line:
    """Half a second of what was measured; where it is not full, now counts."""

    def __init__(self, idm, filled=False):
        self._idm, self._measured = idm, deque([(0.0, 0.0, math.inf)] * (DELAY_STEPS + 1) * filled, DELAY_STEPS + 1)

    def acceleration(self, speed, lead_speed, gap):
        self._measured.append((speed, lead_speed, gap))
        speed, lead_speed, gap = self._measured[0 if len(self._measured) > DELAY_STEPS else -1]
        return 0.0 if math.isinf(gap) else self._idm(speed, lead_speed, gap)
