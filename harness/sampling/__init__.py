"""How tests are drawn, by method: `source_of` is the class, `prepare` builds what its tests are drawn from.

Where the event of a test is drawn, and its weight made:

- naturalistic and forced (`paths`): from all events of the test's own path;
- `shells`: from the pool, by `harness.pool.shells.PrescribedEpisodes`, which also has the weight, log p_s; how many
  from which shell says `shells.Allocation`;
- methods of a family's own draw it in the loop (`Family.sources`), as NADE's mixtures do.

All have one shape (`protocol`); properties of each method, such as whether it needs surrogates, are listed in
`harness.vocabulary.SAMPLING`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pkgutil import resolve_name

from harness.campaign.campaign import Campaign
from harness.compiled import is_cached
from harness.families import family_named
from harness.loop.judge import judge
from harness.loop.loop import EpisodeLoop, RecordPolicy
from harness.progress import Progress
from harness.resolved import Resolved
from harness.sampling.paths import Forced, Naturalistic
from harness.sampling.protocol import Source
from harness.sampling.shells import Shells
from harness.vocabulary import Method

_SOURCES: Mapping[Method, type[Source]] = {"nde": Naturalistic, "forced": Forced, "shells": Shells}


def source_of(campaign: Campaign) -> type[Source]:
    """How the tests of a campaign are drawn."""
    method = campaign.testing.method
    if method in _SOURCES and not (method == "nde" and campaign.av.acts_before_event):
        return _SOURCES[method]
    own: type[Source] = resolve_name(family_named(campaign.scenario).sources[method])
    return own  # the family's own; also `nde` of a vehicle that acts before the event, which changes the events


def prepare(resolved: Resolved, progress: Progress | None = None) -> Source:
    """Build (or read) what a campaign's tests are drawn from, after kernels are compiled if they have to be."""
    progress, build = progress or Progress(), source_of(resolved.campaign)
    if not is_cached(build.kernel):
        progress.stage("compiling, once per version", None)
        compile_kernels(resolved)
    return build(resolved, progress)


def compile_kernels(resolved: Resolved) -> None:
    """Compile what tests will need, into the cache, where worker processes find it.

    Kernels are the same for all worlds: one naturalistic test in the twin compiles them.
    """
    from harness.worlds.twin import TwinWorld  # noqa: PLC0415 - only a cold start needs it

    campaign, build = resolved.campaign, source_of(resolved.campaign)
    naturalistic = campaign.model_copy(update={"testing": campaign.testing.model_copy(update={"method": "nde"})})
    nde = build if build.kernel is not judge else Naturalistic
    tests = nde(replace(resolved, campaign=naturalistic), Progress()).tests(0, 1)
    EpisodeLoop(TwinWorld(1, resolved.scenario.vehicles), resolved.scenario, RecordPolicy("none", 0.0)).run(0, tests)
    resolved.family.mean_distance_m(resolved.environment)
