"""Ways of sampling tests: one class each and all of one shape (`harness.sampling.protocol`).

Those that need nothing of their own are below; `forced` and `shells` have a file each.
"""

from __future__ import annotations

from collections.abc import Mapping

from harness.campaign.campaign import Campaign
from harness.estimators.block import MOMENT_COLUMNS
from harness.sampling.forced import Forced
from harness.sampling.protocol import Rounds, ShardRequest, Source
from harness.sampling.shells import Shells
from harness.vocabulary import Method


class Naturalistic(Source):
    """Traffic as it is: tests without weights, of which few have a cut-in."""

    episodes_per_s = {"sumo": 3500, "sumo with shim": 6000, "twin": 70000}
    cut_ins_are_rare = True


class StepMixture(Source):
    """Published NADE: at critical moments maneuvers come from the mixture of the surrogates' importance functions."""

    episodes_per_s = {"sumo": 1600, "sumo with shim": 2700, "twin": 25000}
    moment_columns = MOMENT_COLUMNS


class EpisodeMixture(Source):
    """One importance function per episode: a surrogate's, or the forced cut-in, which bounds the weight."""

    episodes_per_s = {"sumo": 2000, "sumo with shim": 3000, "twin": 18000}


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
