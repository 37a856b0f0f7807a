"""Ways of sampling tests, all of one shape (`harness.sampling.protocol`): `forced` and `shells` have a file each.

What is to be known of every method, such as whether it needs surrogates, stands in `harness.vocabulary.SAMPLING`.
"""

from __future__ import annotations

from collections.abc import Mapping

from harness.campaign.campaign import Campaign
from harness.sampling.forced import Forced
from harness.sampling.protocol import Rounds, ShardRequest, Source
from harness.sampling.shells import Shells
from harness.vocabulary import Method

_SOURCES: Mapping[Method, type[Source]] = {"forced": Forced, "shells": Shells}
EPISODES_PER_S: Mapping[Method, Mapping[str, int]] = {
    "nde": {"sumo": 3500, "sumo with shim": 6000, "twin": 70000},
    "forced": {"sumo": 1500, "sumo with shim": 2500, "twin": 32000},
    "step_mixture": {"sumo": 1600, "sumo with shim": 2700, "twin": 25000},
    "episode_mixture": {"sumo": 2000, "sumo with shim": 3000, "twin": 18000},
    "shells": {"sumo": 1700, "sumo with shim": 2700, "twin": 30000},
}
"""On one core of a 2020s server by engine, recording included: orders of magnitude; `benchmarks/` tells yours."""


def source_of(campaign: Campaign) -> type[Source]:
    """How the tests of a campaign are drawn."""
    return _SOURCES.get(campaign.testing.method, Source)


__all__ = ["EPISODES_PER_S", "Rounds", "ShardRequest", "Source", "source_of"]
