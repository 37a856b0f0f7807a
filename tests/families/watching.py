"""Controllers that drive as the intelligent driver model and keep what they were shown."""

from __future__ import annotations

from examples import idm_traci_style
from examples.idm import IDM

SEEN = []
"""What was told of a test, and then step by step."""


class Watching(IDM):
    def start(self, episode):
        SEEN.append((episode, []))

    def step(self, seen):
        SEEN[-1][1].append(seen)
        return super().step(seen)


class WatchingTraci(idm_traci_style.IDM):
    """Of each vehicle that is there: position, speed, acceleration, lane, and how far it is from the lane's middle."""

    asked = ("getLanePosition", "getSpeed", "getAcceleration", "getLaneIndex", "getLateralLanePosition")

    def on_start(self, random):
        SEEN.append((random, []))

    def on_step(self, traci, veh_id, time):
        there = traci.vehicle
        known = {name: [getattr(there, ask)(name) for ask in self.asked] for name in there.getIDList()}
        SEEN[-1][1].append((known, there.getLeader(veh_id), there.getAllowedSpeed(veh_id)))
        super().on_step(traci, veh_id, time)
