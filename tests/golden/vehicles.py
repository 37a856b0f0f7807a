"""Controllers of golden campaigns that shall behave for ever as they do here."""

import math

from examples.idm import IDM, idm_acceleration


class Fails(IDM):
    """The IDM, which returns no number in every thirtieth episode."""

    def start(self, episode):
        self.index = episode.episode

    def step(self, seen):
        return math.nan if self.index % 30 == 7 else super().step(seen)


class Speeds(IDM):
    """Before the cut-in it makes for 1.2 times its first speed, with noise from the stream that it is given."""

    def __init__(self, noise_mps2=0.1):
        super().__init__()
        self.noise_mps2 = noise_mps2

    def start(self, episode):
        self.random, self.wanted = episode.random, None

    def step(self, seen):
        if math.isinf(seen.gap_m):
            self.wanted = self.wanted or 1.2 * seen.speed_mps
            return (0.8 if seen.speed_mps < self.wanted else 0.0) + self.noise_mps2 * self.random.uniform(-1.0, 1.0)
        return idm_acceleration(seen.speed_mps, seen.lead_speed_mps, seen.gap_m)
