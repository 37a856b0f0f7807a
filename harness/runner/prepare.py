"""From a campaign to what its episodes need: what is refused at the door, what tests are drawn from, and the world."""

from __future__ import annotations

import gc
from concurrent.futures import ThreadPoolExecutor

from harness.campaign.campaign import Campaign, Command
from harness.compiled import is_cached, unboxed
from harness.controllers.find import require_controller
from harness.episode.judge import judge
from harness.episode.loop import Drawing, EpisodeLoop, RecordPolicy
from harness.episode.path import empty_trajectory, mean_test_distance
from harness.importance.functions import build_importance
from harness.pool.replay import Retracing
from harness.progress import Progress
from harness.records.schemas import shard_tables
from harness.resolved import Resolved, resolve
from harness.sampling import Source, source_of
from harness.traffic.laws import Environment, InitialStates
from harness.worlds.sumo_driven import av_type
from harness.worlds.system_libraries import require_libraries

DISTANCE_SEED = 20_000
DISTANCE_PATHS = 20_000
"""Paths over which the mean distance of a test is taken; its standard error is below 0.5 %."""


def require_ready(campaign: Campaign, command: Command = "run") -> Resolved:
    """Resolve a campaign for a command; refuse what can be known to be wrong before anything is simulated or written.

    Raises `CampaignError`: the AV's controller cannot be found or made, SUMO knows no such attribute of it, strangers
    could drive it, the environment's parameters are wrong, or the surrogate library is wrong or lacks the boundary.
    Raises `HarnessError`: SUMO's system libraries are missing.
    """
    require_world(campaign)
    controller_sha256 = require_controller(campaign)
    if campaign.av.sumo is not None:
        av_type(campaign.av.sumo)
    if campaign.av.traci is not None:
        from harness.worlds.program import require_private  # noqa: PLC0415 - imports traci

        require_private(campaign.av.traci)
    resolved = resolve(campaign, command, controller_sha256=controller_sha256)
    source_of(campaign).require(resolved)
    return resolved


def require_world(campaign: Campaign) -> None:
    """Refuse a machine on which SUMO's system libraries are missing, before anything is built for them."""
    if campaign.world.engine == "sumo":
        require_libraries()


def prepare(resolved: Resolved, progress: Progress | None = None) -> Source:
    """Build (or read) what a campaign's tests are drawn from, while kernels are compiled if they have to be."""
    progress, is_warm = progress or Progress(), is_cached(judge)
    if not is_warm:
        progress.stage("compiling, once per version", None)
    with ThreadPoolExecutor(1) as thread:
        building = thread.submit(source_of(resolved.campaign), resolved, progress)
        if not is_warm:
            gc.disable()  # a compiler makes many small objects, and next to no garbage
            try:
                compile_kernels(resolved)
            finally:
                gc.enable()
        return building.result()


def compile_kernels(resolved: Resolved) -> None:
    """Compile what episodes will need, while threads build tables: neither waits for the other.

    Kernels are the same for all methods and worlds, so one naturalistic episode in the twin, retraced as if SUMO had
    driven it, compiles them into the cache, where worker processes find them.
    """
    from harness.worlds.twin import TwinWorld  # noqa: PLC0415 - only a cold start needs it

    campaign, environment = resolved.campaign, resolved.environment
    naturalistic = campaign.model_copy(update={"testing": campaign.testing.model_copy(update={"method": "nde"})})
    importance = build_importance(naturalistic, None)
    policy = Drawing(campaign.seed, environment, importance, resolved.av, boundary=resolved.surrogates[:1])
    states = InitialStates(environment.numbers).draw(0, 0, 1)
    shard = EpisodeLoop(TwinWorld(1), policy, RecordPolicy(0, "none", 0.0)).run(0, states)
    Retracing(resolved).check(shard_tables(shard, campaign.seed, keep_traces=False).episodes)
    distance_per_test_m(environment)


def distance_per_test_m(environment: Environment) -> float:
    """Mean distance (m) that the AV drives in a naturalistic test.

    Overtakings without cut-in: the others are too few (some 3e-5 at level 1) to matter.
    """
    states = InitialStates(environment.numbers).draw(DISTANCE_SEED, 0, DISTANCE_PATHS)
    scratch = empty_trajectory(environment)
    return float(mean_test_distance(DISTANCE_SEED, states, unboxed(environment), unboxed(scratch)))
