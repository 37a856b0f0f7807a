"""Controllers that act before the cut-in, or could; each brakes, or is the IDM, after it."""

from __future__ import annotations

import math

import numpy as np

from examples.acting import Holds as HoldsBatch  # noqa: F401
from examples.idm import IDM, idm_acceleration
from harness.controllers.traci_style import TraciStyleController
from tests.golden.vehicles import Speeds as Noisy


class HoldsThenIdm(IDM):
    """Keeps its speed until the cut-in, as a vehicle that is only asked from then on would."""

    def start(self, episode):
        self.random, self.index = episode.random, episode.episode

    def step(self, seen):
        return self.before(seen) if math.isinf(seen.gap_m) else super().step(seen)

    def before(self, seen):
        return 0.0


class Speeds(Noisy):
    """Without the noise, if none is asked for, and braking no harder than it is told."""

    def __init__(self, noise_mps2: float = 0.0, min_acceleration_mps2: float = -4.0) -> None:
        super().__init__(noise_mps2)
        self.hardest = min_acceleration_mps2

    def step(self, seen):
        return max(super().step(seen), self.hardest)


class SpeedsTraci(TraciStyleController):
    """A script that speeds up until someone is ahead, and then is the IDM."""

    def on_step(self, traci, veh_id, time):
        leader, speed = traci.vehicle.getLeader(veh_id), traci.vehicle.getSpeed(veh_id)
        a = 0.5
        if leader is not None:
            a = idm_acceleration(speed, traci.vehicle.getSpeed(leader[0]), leader[1])
        traci.vehicle.setAcceleration(veh_id, a, traci.simulation.getDeltaT())


class YieldsMostly(HoldsThenIdm):
    """Gives way to BV while that is still beside it, but for one index in forty that it is told."""

    def before(self, seen):
        gap = seen.bv.position_m - 5.0 - seen.position_m
        if self.index % 40 == 3 or gap <= 0.0:
            return 0.0
        return idm_acceleration(seen.speed_mps, seen.bv.speed_mps, gap, self.min_acceleration_mps2)


class FreshNoise(Noisy):
    """Noise of its own instead of the stream's."""

    def start(self, episode):
        super().start(episode)
        self.random = np.random.default_rng()


class Breaks(HoldsThenIdm):
    """Raises two seconds into every fiftieth index that it is told."""

    def before(self, seen):
        if self.index % 50 == 7 and seen.time_s > 2.0:
            raise RuntimeError("sensor lost")
        return 0.3
