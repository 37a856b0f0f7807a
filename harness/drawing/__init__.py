"""Ways of drawing tests, one file each and all of one shape (`harness.drawing.protocol`)."""

from __future__ import annotations

from collections.abc import Mapping

from harness.campaign.campaign import Campaign
from harness.drawing.episode_mixture import EpisodeMixture
from harness.drawing.forced import Forced
from harness.drawing.nde import Naturalistic
from harness.drawing.protocol import Rounds, ShardRequest, Source
from harness.drawing.shells import Shells
from harness.drawing.step_mixture import StepMixture
from harness.vocabulary import Method

SOURCES: Mapping[Method, type[Source]] = {
    "nde": Naturalistic,
    "forced": Forced,
    "step_mixture": StepMixture,
    "episode_mixture": EpisodeMixture,
    "shells": Shells,
}


def source_of(campaign: Campaign) -> type[Source]:
    """How the tests of a campaign are drawn."""
    return SOURCES[campaign.testing.method]


__all__ = ["SOURCES", "Rounds", "ShardRequest", "Source", "source_of"]
