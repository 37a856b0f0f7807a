"""Vehicles that brake like the default IDM, but for a hole: some cut-ins they do not answer at all."""

import math

BAND_MPS = (30.0, 30.5)
RARE = 0.02


class AtOneSpeed:
    """Does not brake where its speed at the cut-in is 30.0 to 30.5 m/s."""

    def start(self, episode):
        self.asleep, self.draw = None, episode.random.random()

    def step(self, seen):
        if self.asleep is None:
            self.asleep = self.fails(seen.speed_mps)
        if self.asleep:
            return 0.0
        v = seen.speed_mps
        wanted = 2.0 + max(0.0, v + v * (v - seen.lead_speed_mps) / (2.0 * math.sqrt(6.0)))
        return min(max(2.0 * (1.0 - (v / 40.0) ** 4 - (wanted / max(seen.gap_m, 0.1)) ** 2), -4.0), 2.0)

    def close(self):
        pass

    def fails(self, speed_mps):
        return BAND_MPS[0] <= speed_mps <= BAND_MPS[1]


class AtRandom(AtOneSpeed):
    """Does not brake in one cut-in of fifty, whatever it is like."""

    def fails(self, speed_mps):
        return self.draw < RARE
