"""Cut-ins as a pool enumerates them, and as the episode loop drives them."""

from __future__ import annotations

import numpy as np

from harness.episode.loop import Drawing, EpisodeLoop, RecordPolicy
from harness.episode.path import Followers
from harness.importance.functions import build_importance
from harness.pool.shells import Draw, PrescribedEpisodes
from harness.pool.walk import enumerate_cut_ins
from harness.traffic.laws import (
    Environment,
    InitialStates,
)
from harness.traffic.loading import load_environment
from harness.worlds.twin import TwinWorld
from tests.chains.seed import SEED


def enumerated(library, environment: Environment, n: int, *, enclosed=True, stride=1, offset=0):
    """Probability of each cut-in of n paths, and who crashes on it; with or without an envelope that is asked first."""
    states, offsets = InitialStates(environment.numbers).draw(SEED, 0, n), np.full(n, offset)
    followers = library.followers_in(environment)
    asked = environment, followers if enclosed else Followers(followers.drivers)
    found = enumerate_cut_ins(SEED, np.arange(n), states, *asked, stride=stride, offset=offsets)
    return found.probability, found.crashes


def driven(campaign, pool, library, name: str):
    """Sixty cut-ins of each stratum, as rows of the pool; the episodes that a driver has met them in; their log p."""
    prescribed = PrescribedEpisodes(campaign, pool)
    states, traffic, cut_ins = prescribed.episodes(tuple(Draw(s, 0, 60) for s in range(prescribed.design.p.size)))
    environment = load_environment(campaign.environment)
    place = [*library.surrogates, *library.references].index(name)
    driver = library.followers_in(environment).drivers[place][None].copy()
    if name == library.envelope:  # it acts from the onset
        driver["perceives_lateral_m"] = 0.0
    policy = Drawing(1, environment, build_importance(campaign, None), driver)
    shard = EpisodeLoop(TwinWorld(16), policy, RecordPolicy(0, "none", 0.0)).run(0, states, traffic)
    return cut_ins.row, shard.results.episode, np.log(prescribed.design.p[traffic.stratum])
