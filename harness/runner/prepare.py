"""From a campaign to what its episodes need: environment, tables, importance functions, AV, world."""

from __future__ import annotations

import gc
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from harness.campaign.campaign import Campaign
from harness.campaign.combinations import Command
from harness.compiled import is_cached
from harness.controllers.find import build_host, require_controller
from harness.controllers.hosts import Death
from harness.episode.judge import judge
from harness.episode.loop import MOMENT_LIMITS, NOBODY, Drawing, EpisodeLoop, RecordPolicy
from harness.episode.path import empty_trajectory, mean_test_distance
from harness.errors import RunFolderError
from harness.importance.build import build_importance, needs_tables
from harness.importance.tables import Tables, build_tables, table_path
from harness.pool.enumeration import ShadowRuns
from harness.pool.shells import PrescribedEpisodes, checked_boundary
from harness.pool.storage import campaign_pool, campaign_pool_key, pool_path
from harness.pool.vehicle_pool import ShadowPaths, campaign_shadow_paths, shadow_paths_file, vehicle_pool
from harness.progress import Progress
from harness.records.folder import SHELLS, read_as
from harness.records.schemas import shard_tables
from harness.resolved import Resolved, resolve
from harness.runner.retrace import Retracing
from harness.traffic.initial_state import InitialStates
from harness.traffic.laws import Environment
from harness.unboxed import unboxed
from harness.vocabulary import PRESCRIBED, RecordArray
from harness.worlds.av_type import av_type
from harness.worlds.protocol import World
from harness.worlds.public_address import require_private
from harness.worlds.system_libraries import require_libraries

DISTANCE_SEED = 20_000
DISTANCE_PATHS = 20_000
"""Paths over which the mean distance of a test is taken; its standard error is below 0.5 %."""


@dataclass(frozen=True)
class Prepared:
    """A campaign ready to run.

    A vehicle that acts before the cut-in is to walk the ``shadow_paths`` first; its tests are prescribed after that.
    """

    resolved: Resolved
    policy: Drawing
    initial_states: InitialStates
    tables: Tables | None
    prescribed: PrescribedEpisodes | None = None
    shadow_paths: ShadowPaths | None = None

    @property
    def campaign(self) -> Campaign:
        """The campaign itself."""
        return self.resolved.campaign

    def after(self, runs: ShadowRuns) -> Prepared:
        """The same, after the shadow runs, with the tests that follow from them.

        Raises
        ------
        HarnessError
            Nothing on these paths can be tested.
        """
        if self.shadow_paths is None:
            raise ValueError("this campaign has no shadow runs")
        pool = vehicle_pool(self.resolved, self.shadow_paths, runs)
        prescribed = PrescribedEpisodes(self.campaign, pool)
        policy = self.policy._replace(
            boundary=checked_boundary(self.resolved.library, prescribed.design, self.resolved.environment)
        )
        return replace(self, prescribed=prescribed, policy=policy)

    def states(self, first_episode: int, n_episodes: int) -> RecordArray:
        """Initial states of consecutive episodes, shape (n_episodes,)."""
        return self.initial_states.draw(self.campaign.seed, first_episode, n_episodes)

    def loop(
        self,
        world: World,
        *,
        traces: str | None = None,
        black_box: Path | None = None,
        fatal_episodes: Mapping[int, Death] | None = None,
    ) -> EpisodeLoop:
        """Episode loop in a world, recording what the campaign asks for, or other ``traces``.

        The file ``black_box`` tells in which episode's controller a process died; ``fatal_episodes`` are known to
        kill it; they may become more between two runs.
        """
        campaign, records = self.campaign, self.campaign.records
        keep = RecordPolicy(MOMENT_LIMITS[records.moments], traces or records.traces, records.trace_share)
        av = build_host(
            campaign.av, n_cells=world.n_cells, seed=campaign.seed, black_box=black_box, fatal_episodes=fatal_episodes
        )
        return EpisodeLoop(world, self.policy, keep, av)


def require_ready(campaign: Campaign, command: Command = "run") -> Resolved:
    """Resolve a campaign for a command; refuse what can be known to be wrong before anything is simulated or written.

    Raises
    ------
    CampaignError
        The AV's controller cannot be found or made, SUMO knows no such attribute of it, strangers could drive it, the
        environment's parameters are wrong, or the surrogate library is wrong or lacks the boundary.
    HarnessError
        SUMO's system libraries are missing.
    """
    require_world(campaign)
    controller_sha256 = require_controller(campaign)
    if campaign.av.sumo is not None:
        av_type(campaign.av.sumo)
    if campaign.av.traci is not None:
        require_private(campaign.av.traci)
    resolved = resolve(campaign, command, controller_sha256=controller_sha256)
    if campaign.testing.method == "shells":
        resolved.library.statement_settings(campaign.testing.shells)
    return resolved


def require_world(campaign: Campaign) -> None:
    """Refuse a machine on which SUMO's system libraries are missing, before anything is built for them."""
    if campaign.world.engine == "sumo":
        require_libraries()


def prepare(resolved: Resolved, progress: Progress | None = None) -> Prepared:
    """Build (or read) a campaign's challenge tables, its pool of cut-ins, or the paths of its shadow runs."""
    campaign, environment = resolved.campaign, resolved.environment
    with ThreadPoolExecutor(1) as thread:
        building = thread.submit(_built, resolved, progress or Progress())
        if not is_cached(judge):
            gc.disable()  # a compiler makes many small objects, and next to no garbage
            try:
                compile_kernels(resolved)
            finally:
                gc.enable()
        tables, prescribed, shadow_paths = building.result()
    importance = build_importance(campaign, tables)
    if campaign.has_shadow_runs:  # what happens then is prescribed, cut-in included
        importance = importance._replace(method=PRESCRIBED)
    boundary = NOBODY if prescribed is None else checked_boundary(resolved.library, prescribed.design, environment)
    policy = Drawing(campaign.seed, environment, importance, resolved.av, boundary)
    return Prepared(resolved, policy, InitialStates(environment.numbers), tables, prescribed, shadow_paths)


def _built(
    resolved: Resolved, progress: Progress
) -> tuple[Tables | None, PrescribedEpisodes | None, ShadowPaths | None]:
    """What a campaign's method draws from, which takes time to build."""
    campaign, drivers = resolved.campaign, resolved.surrogates
    if needs_tables(campaign):
        progress.stage("criticality tables", len(drivers))
        tables = build_tables(resolved.environment, drivers, campaign.testing.challenge, progress.advance)
        return tables, None, None
    if campaign.testing.method != "shells":
        return None, None, None
    if campaign.has_shadow_runs:
        return None, None, campaign_shadow_paths(resolved, progress)
    return None, PrescribedEpisodes(campaign, campaign_pool(resolved, progress)), None


def cached_files(resolved: Resolved) -> list[Path]:
    """What `prepare` leaves in the cache, or has found there: with these another machine builds nothing."""
    campaign = resolved.campaign
    if needs_tables(campaign):
        return [table_path(resolved.environment, resolved.surrogates, campaign.testing.challenge)]
    if campaign.testing.method != "shells":
        return []
    return [shadow_paths_file(resolved) if campaign.has_shadow_runs else pool_path(campaign_pool_key(resolved))]


def require_same_pool(folder: Path, prepared: Prepared) -> None:
    """Refuse (`RunFolderError`) to go on with a run whose cut-ins came from another pool.

    Its library, or the harness itself, has changed since.
    """
    path = folder / SHELLS
    if prepared.prescribed is None or not path.exists():
        return
    found = read_as(dict[str, object], path, mend="Run the campaign into a new folder.").get("pool")
    if found != prepared.prescribed.design.pool:
        raise RunFolderError(
            str(path),
            found=f"cut-ins of pool {found}",
            expected=f"those of pool {prepared.prescribed.design.pool}, which this campaign now has",
            mend="Restore the surrogate library, or the version of the harness (manifest.json), or use a new folder.",
        )


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


def build_world(campaign: Campaign, n_cells: int | None = None) -> World:
    """The world that a campaign names, with its number of cells or another."""
    if campaign.world.engine == "twin":
        from harness.worlds.twin import TwinWorld  # noqa: PLC0415 - a run needs one of the two worlds

        return TwinWorld(n_cells or campaign.world.cells)
    from harness.worlds.build import build_sumo_world  # noqa: PLC0415 - libsumo takes half a second to import

    return build_sumo_world(campaign, n_cells)


def distance_per_test_m(environment: Environment) -> float:
    """Mean distance (m) that the AV drives in a naturalistic test.

    Overtakings without cut-in: the others are too few (some 3e-5 at level 1) to matter.
    """
    states = InitialStates(environment.numbers).draw(DISTANCE_SEED, 0, DISTANCE_PATHS)
    room = empty_trajectory(environment)
    return float(mean_test_distance(DISTANCE_SEED, states, unboxed(environment), unboxed(room)))
