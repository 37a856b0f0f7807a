"""Tests as naturalistic traffic would have them: at most one event, by its probability; each weighs 1."""

from __future__ import annotations

import numpy as np

from harness.loop.repeat import Traffic
from harness.random_stream import CUT_IN as EVENT
from harness.random_stream import uniforms
from harness.sampling.protocol import Source
from harness.vehicles.drivers import Followers, driver_records
from harness.vocabulary import FloatArray, IntArray

EVENT_DRAW = 1
"""Index within the event's stream."""
NOBODY = Followers(driver_records([]))


def chosen_by(u: FloatArray, probability: FloatArray) -> IntArray:
    """Events (n,) of paths whose events have the ``probability`` (n, E), by uniforms (n,); -1 beyond their sum."""
    cumulative = np.cumsum(probability, axis=1)
    return np.where(u < cumulative[:, -1], (cumulative <= u[:, None]).sum(1), -1)


class Naturalistic(Source):
    """Whether there is an event on a path, and which, follows from one uniform."""

    def tests(self, first_episode: int, n_episodes: int) -> Traffic:
        resolved, paths = self.resolved, self.paths(first_episode, n_episodes)
        family, environment, seed = resolved.family, resolved.environment, self.campaign.seed
        events = family.events(environment, seed, paths, NOBODY)
        u = uniforms(seed, first_episode, n_episodes, EVENT, EVENT_DRAW + 1)[:, EVENT_DRAW]
        chosen = family.choose(environment, seed, paths, chosen_by(u, events.probability), of_pool=False)
        return Traffic(family.script(environment, chosen), chosen.facts)
