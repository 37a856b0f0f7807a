"""A super-population of a vehicle that acts before the cut-in: paths that it has walked, with its tests on them.

Paths are chosen as for a campaign's shadow runs, only many more of them, and every `STRIDE`-th of their cut-ins asked.
Surrogates and references take over from the vehicle as in its pool, and the vehicle itself drives each of these cut-ins
as a test of the campaign would: told the index of its shadow run, and held to the hash of what it did there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import replace
from functools import cache

import numpy as np

from harness.campaign.campaign import Campaign
from harness.compiled import source_hash
from harness.controllers.find import build_host, require_controller
from harness.drawing.baseline import recorded, without_cut_in
from harness.episode.cells import PrescribedTraffic
from harness.episode.judge import motion_hashes
from harness.episode.loop import Drawing, EpisodeLoop, RecordPolicy
from harness.errors import HarnessError
from harness.importance.build import build_importance
from harness.pool.cut_ins import onset_steps
from harness.pool.enumeration import STRIDE, ShadowRuns, enumerate_cut_ins, write_script
from harness.pool.vehicle_pool import CANDIDATES, ShadowPaths, walk_candidates
from harness.progress import Progress
from harness.resolved import Resolved, resolve
from harness.vocabulary import CRASH, PRESCRIBED, BoolArray, IntArray
from harness.worlds.twin import TwinWorld
from studies.super_population import SuperPopulation, cached, joined, population_key
from studies.work import sources_of

CELLS = 1024
CHUNK_PATHS = 1024
"""Paths that one task walks: some 15 MB of motion."""


_SOURCES = ("pool/vehicle_pool.py", "controllers/hosts.py")
"""Files beside those of the world that decide what a vehicle meets, and is told."""
Choose = Callable[[int, int], ShadowPaths]
"""Chooses paths from a seed, so many of them; all vehicles of an experiment walk the same."""


def chooser(campaign: Campaign, progress: Progress, candidates: int = CANDIDATES) -> Choose:
    """Chooses paths in the traffic of a campaign, out of so many, or of as many as are asked for."""
    resolved = resolve(campaign)

    @cache
    def choose(seed: int, n_paths: int) -> ShadowPaths:
        settings = campaign.pool.model_copy(update={"seed": seed})
        where, most = (resolved.environment, resolved.library), max(n_paths, candidates)
        return walk_candidates(*where, settings, "walked", progress, most).draw(n_paths)

    return choose


def walk_paths(
    campaign: Campaign, choose: Choose, seed: int, n_paths: int, executor: Executor, progress: Progress
) -> SuperPopulation:
    """Let the campaign's vehicle walk so many paths, or read what it did from the cache.

    Raises
    ------
    HarnessError
        The vehicle failed, or did something else in a test than in its shadow run.
    """
    code = require_controller(campaign), source_hash(_SOURCES), sources_of("walked_population.py")
    resolved = resolve(campaign)
    drivers = resolved.library.followers_in(resolved.environment).drivers.tolist()
    asked = drivers, campaign.av.identity(), *code, campaign.seed, seed, n_paths

    def walked() -> SuperPopulation:
        paths = choose(seed, n_paths)
        progress.stage(f"walked paths of seed {seed}", n_paths)
        parts = []
        for part in executor.map(_walk, *zip(*_tasks(campaign, paths), strict=True)):
            parts.append(part)
            progress.advance(part.n_paths)
        return joined(parts)

    return cached(population_key(resolved.environment, "walked", STRIDE, *asked), walked)


def _tasks(campaign: Campaign, paths: ShadowPaths) -> Iterator[tuple[str, int, ShadowPaths]]:
    """Ranges of the paths, each with the number of its first one."""
    content = campaign.model_dump_json()
    for first in range(0, len(paths), CHUNK_PATHS):
        rows = slice(first, first + CHUNK_PATHS)
        chunk = replace(paths, index=paths.index[rows], state=paths.state[rows], weight=paths.weight[rows])
        yield content, first, chunk


def _walk(campaign_json: str, first: int, paths: ShadowPaths) -> SuperPopulation:
    """Walk a range of paths, and drive their cut-ins."""
    resolved = resolve(Campaign.model_validate_json(campaign_json))
    environment, library = resolved.environment, resolved.library
    loop = _loop(resolved)
    runs = recorded(without_cut_in(loop, paths.seed, first, paths.index, paths.state, environment), environment)
    _require_none_failed(resolved, int(runs.failed.sum()), len(paths), "shadow runs")
    offset = np.random.default_rng([paths.seed, first]).integers(0, STRIDE, len(paths))
    where = paths.seed, paths.index, paths.state, environment, library.followers_in(environment)
    probability, bits, _ = enumerate_cut_ins(*where, runs, STRIDE, offset)
    mass = probability * paths.weight[:, None]
    row, step = np.nonzero(mass > 0.0)
    crashes = _crashes(resolved, loop, first, paths, runs, row, step)
    of_cut_ins = bits[row, step] | (crashes.astype(np.int64) << library.n_drivers)  # the vehicle comes after these
    somebody = of_cut_ins != 0
    row, step = row[somebody], step[somebody]
    return SuperPopulation(mass.sum(1), first + row, mass[row, step], of_cut_ins[somebody])


def _loop(resolved: Resolved) -> EpisodeLoop:
    """The vehicle in the twin, on prescribed traffic, with all of its motion kept."""
    campaign, environment = resolved.campaign, resolved.environment
    prescribed = build_importance(campaign, None)._replace(method=PRESCRIBED)
    policy = Drawing(campaign.seed, environment, prescribed, resolved.av)
    host = build_host(campaign.av, n_cells=CELLS, seed=campaign.seed)
    return EpisodeLoop(TwinWorld(CELLS), policy, RecordPolicy(0, "none", 0.0), host)


def _crashes(
    resolved: Resolved,
    loop: EpisodeLoop,
    first: int,
    paths: ShadowPaths,
    runs: ShadowRuns,
    row: IntArray,
    step: IntArray,
) -> BoolArray:
    """Drive the vehicle on cut-ins of paths in given rows and steps (n,): whether it crashed on each."""
    lv, bv, _, _, lead = write_script(paths.seed, paths.index[row], step, paths.state[row], resolved.environment)
    motion = motion_hashes(runs.x_m, runs.v_mps)[row, onset_steps(step, lead)]
    nowhere, weightless = np.full(row.size, -1), np.zeros(row.size)
    traffic = PrescribedTraffic(lv, bv, step, nowhere, weightless, first + row, motion, lead)
    outcome = loop.run(0, paths.state[row], traffic)
    _require_none_failed(resolved, len(outcome.failures), row.size, "tests")
    return np.asarray(outcome.results.episode["outcome"] == CRASH)


def _require_none_failed(resolved: Resolved, n_failed: int, n: int, what: str) -> None:
    if n_failed:
        where = f"avs: {resolved.campaign.av.controller or resolved.campaign.av.fmu}"
        expected = "none: what a vehicle would have done is not known, and so neither is its crash rate"
        mend = "Mend the vehicle (`harness av-check` looks at it in seconds), or leave it out of the experiment."
        raise HarnessError(where, f"{n_failed:,} of {n:,} {what} failed", expected, mend)
