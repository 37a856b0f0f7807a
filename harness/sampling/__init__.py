"""How tests are drawn, by method: `source_of` names the class, `prepare` builds what its tests are drawn from.

Where the cut-in of a test is drawn, and its weight made:

- `nde`, `forced` and the mixtures: step by step in the loop, by `decide` of `harness.families.cut_in.nade` (forced: its
  step, before the test), the weight by its `likelihood_ratio`; of vehicles that act before the cut-in by `forced`;
- `shells`: from the pool, by `harness.pool.shells.PrescribedEpisodes`, which also has the weight, log p_s; how many
  from which shell says `allocation`.

All have one shape (`protocol`); what is to be known of every method, such as whether it needs surrogates, stands in
`harness.vocabulary.SAMPLING`.
"""

from __future__ import annotations

import gc
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

from harness.campaign.campaign import Campaign
from harness.compiled import is_cached, unboxed
from harness.families.cut_in.laws import Environment, InitialStates
from harness.families.cut_in.nade.functions import build_importance
from harness.families.cut_in.path import empty_trajectory, mean_test_distance
from harness.loop.judge import judge
from harness.loop.loop import Drawing, EpisodeLoop, RecordPolicy
from harness.progress import Progress
from harness.resolved import Resolved
from harness.sampling.forced import Forced
from harness.sampling.protocol import Source
from harness.sampling.shells import Shells
from harness.vocabulary import Method

_SOURCES: Mapping[Method, type[Source]] = {"forced": Forced, "shells": Shells}
DISTANCE_SEED = 20_000
DISTANCE_PATHS = 20_000
"""Paths over which the mean distance of a test is taken; its standard error is below 0.5 %."""


def source_of(campaign: Campaign) -> type[Source]:
    """How the tests of a campaign are drawn."""
    return _SOURCES.get(campaign.testing.method, Source)


def prepare(resolved: Resolved, progress: Progress | None = None) -> Source:
    """Build (or read) what a campaign's tests are drawn from, while kernels are compiled if they have to be."""
    progress, build = progress or Progress(), source_of(resolved.campaign)
    if is_cached(judge):
        return build(resolved, progress)
    progress.stage("compiling, once per version", None)
    with ThreadPoolExecutor(1) as thread:
        building = thread.submit(build, resolved, progress)
        try:
            gc.disable()  # a compiler makes many small objects, and next to no garbage
            try:
                compile_kernels(resolved)
            finally:
                gc.enable()
            return building.result()
        except BaseException:
            progress.cancelled = True  # or leaving would wait until all is built
            raise


def compile_kernels(resolved: Resolved) -> None:
    """Compile what episodes will need, while threads build tables: neither waits for the other.

    Kernels are the same for all methods and worlds, so one naturalistic episode in the twin compiles them into the
    cache, where worker processes find them.
    """
    from harness.worlds.twin import TwinWorld  # noqa: PLC0415 - only a cold start needs it

    campaign, environment = resolved.campaign, resolved.environment
    naturalistic = campaign.model_copy(update={"testing": campaign.testing.model_copy(update={"method": "nde"})})
    importance = build_importance(naturalistic, None)
    policy = Drawing(campaign.seed, environment, importance, resolved.av)
    states = InitialStates(environment.numbers).draw(0, 0, 1)
    EpisodeLoop(TwinWorld(1), policy, RecordPolicy(0, "none", 0.0)).run(0, states)
    distance_per_test_m(environment)


def distance_per_test_m(environment: Environment) -> float:
    """Mean distance (m) that the AV drives in a naturalistic test.

    Overtakings without cut-in: the others are too few (some 3e-5 at level 1) to matter.
    """
    states = InitialStates(environment.numbers).draw(DISTANCE_SEED, 0, DISTANCE_PATHS)
    scratch = empty_trajectory(environment)
    return float(mean_test_distance(DISTANCE_SEED, states, unboxed(environment), unboxed(scratch)))
