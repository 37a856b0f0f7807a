"""Pools of campaigns, from the cache or built: a pilot run says where paths are aimed, and how many there are."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from harness import cache
from harness.compiled import WORLD_SOURCES, source_hash
from harness.families.protocol import Paths
from harness.pool.aim import PILOT_PATHS, EnumeratedPaths, Enumerator
from harness.pool.shells import (
    FORMAT,
    KeptEvents,
    Pool,
    cells_of,
    conservative_first,
    pool_content,
    pool_from,
    shells_of,
)
from harness.progress import Progress
from harness.random_stream import DIAGNOSTIC, uniforms
from harness.resolved import Resolved
from harness.vocabulary import BoolArray, FloatArray, Int8Array, IntArray

ROUND_PATHS = 1024
MOST_PATHS = 1 << 20
AGGRESSIVE_SHARE = 0.2
"""How much the surrogates beyond the boundary, and those far off, count in aiming: less has to be known of them."""
AGGRESSIVE_ERROR = 4.0
"""Their relative error may be this many times the target."""
FAR_OFF = 10.0
"""A surrogate whose rate varies this much more from path to path than the boundary's (relvar) crashes in traffic of its
own, which few paths meet: paths aimed there would be lost for all others."""
POOL_SEED = 0x706F6F6C
"""Keeps a pool's random numbers apart from those of a campaign with the same seed."""
KEEP_DRAW = 1
"""Draw within the diagnostic stream by which a shell's sample of events is chosen."""
_MADE_BY = ("aim.py", "build.py", "shells.py")
"""Code that decides what is in a pool, beside the kernels."""


def campaign_pool_key(resolved: Resolved, order: Sequence[str] = ()) -> str:
    """Hash of all that a pool depends on: environment, lane changing, library, settings, code, and ``order``."""
    library = resolved.library
    content = [
        FORMAT,
        source_hash(WORLD_SOURCES),
        *(hashlib.sha256((Path(__file__).parent / name).read_bytes()).hexdigest() for name in _MADE_BY),
        [resolved.family.name, resolved.family.digest(resolved.environment)],
        {name: model.model_dump() for name, model in library.surrogates.items()},
        [(name, model.model_dump()) for name, model in library.references.items()],
        [library.boundary, library.envelope],
        resolved.campaign.pool.model_dump(exclude={"library", "shadow_paths"}),
        resolved.campaign.crash.counts_above_mps,
        *order,
    ]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:24]


def pool_name(key: str) -> str:
    """Name of a pool's file in the cache."""
    return f"pools/{key}"


def campaign_pool(resolved: Resolved, progress: Progress | None = None, order: Sequence[str] = ()) -> Pool:
    """The pool of a campaign's environment and library, from the cache or built and cached.

    Surrogates are in the ``order`` of these names, by default the most conservative first.
    """
    key = campaign_pool_key(resolved, order)
    if (cached := cached_pool(resolved, order)) is not None:
        return cached
    progress = progress or Progress()
    waiting = "waiting for a pool that another run builds"
    with cache.made_once(pool_name(key), lambda builder: progress.stage(f"{waiting} ({builder})", None)):
        if (cached := cached_pool(resolved, order)) is not None:
            return cached
        pool = build_pool(resolved, key, progress, order)
        cache.keep(pool_name(key), pool_content(pool))
    return pool


def cached_pool(resolved: Resolved, order: Sequence[str] = ()) -> Pool | None:
    """The pool of a campaign; None if none has been built on this machine, or its file is damaged."""
    content = cache.read(pool_name(campaign_pool_key(resolved, order)))
    return None if content is None else pool_from(content, resolved.library)


def build_pool(resolved: Resolved, key: str, progress: Progress | None = None, order: Sequence[str] = ()) -> Pool:
    """Build a pool in the twin, which will carry the content hash ``key``; for ``order`` see `campaign_pool`."""
    progress, names = progress or Progress(), list(resolved.library.surrogates)
    aim = take_aim(resolved, progress)
    n = planned_number(aim, resolved.campaign.pool.relative_error or resolved.family.pool_error)
    progress.stage(f"pool of {resolved.family.words.events}", n)
    paths = aim.enumerator.run(PILOT_PATHS, n, progress)
    progress.stage("pool: events that are kept", None)
    places = np.array([names.index(name) for name in order], np.int64) if order else None
    return pool_of(resolved, paths, key, places)


@dataclass(frozen=True, eq=False)
class Aim:
    """Paths aimed at crashes; the ``pilot`` run's rates (n, D + 1), and which of its columns are to be known well."""

    enumerator: Enumerator
    pilot: FloatArray
    conservative: BoolArray

    @property
    def share(self) -> FloatArray:
        """How much each column counts in aiming, shape (D + 1,)."""
        return np.where(self.conservative, 1.0, AGGRESSIVE_SHARE)


def seed_of_paths(resolved: Resolved) -> int:
    """Of a pool's random numbers: sums take errors of different scenarios as independent."""
    return resolved.campaign.own_seed(resolved.campaign.pool.seed) ^ POOL_SEED


def take_aim(resolved: Resolved, progress: Progress) -> Aim:
    """Aim paths at where surrogates crash, by a pilot run of naturalistic paths."""
    family, environment, library = resolved.family, resolved.environment, resolved.library
    followers = library.followers(family.shows(environment))
    pilot = Enumerator(family, environment, followers, seed_of_paths(resolved))
    progress.stage("pool: pilot", PILOT_PATHS)
    rates = pilot.run(0, PILOT_PATHS, progress).rates(len(library.surrogates))
    mean, boundary = rates.mean(0), list(library.surrogates).index(library.boundary)
    crashes = mean > 0.0  # a surrogate that no pilot path makes crash needs many paths: it is not to be known well
    relvar = np.where(crashes, rates.var(0) / np.where(crashes, mean, 1.0) ** 2, np.inf)
    # To be known well are those no more aggressive than the boundary, if they crash in the traffic that it crashes in.
    aim = Aim(pilot, rates, (mean <= mean[boundary]) & (relvar <= FAR_OFF * relvar[boundary]))
    return replace(aim, enumerator=pilot.aimed(rates, aim.share))


def planned_number(aim: Aim, error: float) -> int:
    """How many aimed paths a relative error of the rates needs, by the pilot run; that error is part of every interval.

    Were paths added until their own errors look small, the rate of a surrogate that few of them meet would come out too
    low (docs/internals/performance.md). The pilot's paths are not used again: here each counts by the weight that it
    would have under the proposal.
    """
    rates, weight = aim.pilot, aim.enumerator.weights(0, len(aim.pilot))
    mean = rates.mean(0)
    crashes = mean > 0.0
    relvar = (rates * rates * weight[:, None]).mean(0)[crashes] / mean[crashes] ** 2 - 1.0
    wanted = error * np.where(aim.conservative, 1.0, AGGRESSIVE_ERROR)[crashes]
    rounds = np.ceil(np.max(relvar / wanted**2, initial=1.0) / ROUND_PATHS)
    return ROUND_PATHS * min(int(rounds), MOST_PATHS // ROUND_PATHS)


def pool_of(resolved: Resolved, paths: EnumeratedPaths, key: str, order: IntArray | None = None) -> Pool:
    """Sort the events of paths into shells and cells; keep a sample of each shell.

    ``order`` (D,) are the surrogates as places in the library, by default `conservative_first` of these paths.
    """
    family, environment, library = resolved.family, resolved.environment, resolved.library
    settings = resolved.campaign.pool
    names, n_references = np.array(list(library.surrogates)), len(library.references)
    n_surrogates = names.size
    rates, mass = paths.rates(n_surrogates), paths.mass
    order = conservative_first(rates) if order is None else order
    n, ordered = len(rates), rates[:, order]
    shell, references = shells_of(paths.crashes, order), paths.crashes >> n_surrogates
    cell, cell_shell, cell_references, by_path = cells_of(mass, shell, references, n_references)
    by_reference = by_path @ ((cell_references[:, None] >> np.arange(n_references)) & 1)
    n_within = list(names[order]).index(library.boundary) + 1
    times = np.where(np.arange(n_surrogates + 1) < n_within, 1, family.outside_kept)
    path, step = _sample(mass, shell, (settings.events_per_shell * times).tolist(), settings.seed)
    chosen = family.choose(environment, seed_of_paths(resolved), Paths(paths.index[path], paths.start[path]), step)
    bits = np.concatenate([order, n_surrogates + np.arange(n_references)])
    crashes = ((paths.crashes[path, step][:, None] >> bits[None, :]) & 1).astype(np.bool_)
    path_mass = by_path[path].astype(np.float32)
    events = KeptEvents(PILOT_PATHS + path, step, cell[path, step], *chosen, crashes, path_mass)
    return Pool(
        key=key,
        family=family.name,
        environment=family.digest(environment),
        library=library,
        names=tuple(names[order].tolist()),
        n_paths=n,
        p_event=float(rates[:, -1].mean()),
        p_event_se=float(rates[:, -1].std() / np.sqrt(n)),
        mu=ordered.mean(0),
        mu_covariance=np.atleast_2d(np.cov(ordered.T, bias=True)) / n,
        cell_shell=cell_shell,
        cell_references=cell_references,
        cell_p=by_path.mean(0),
        reference_rate=by_reference.mean(0),
        reference_square=(by_reference * by_reference).mean(0),
        events=events,
    )


def _sample(mass: FloatArray, shell: Int8Array, n_each: Sequence[int], seed: int) -> tuple[IntArray, IntArray]:
    """Systematic sample of ``n_each`` (D + 1) events of the shells, with probability proportional to mass (n, E).

    Returns path and step (row and column in ``mass``) of each, sorted by shell and path.
    """
    samples = []
    for s, n in enumerate(n_each):
        places = np.flatnonzero((shell == s) & (mass > 0.0))
        if places.size == 0:
            continue
        cumulative = np.cumsum(mass.ravel()[places])
        offset = uniforms(seed, s, 1, DIAGNOSTIC, KEEP_DRAW + 1)[0, KEEP_DRAW]
        levels = (offset + np.arange(n)) * (cumulative[-1] / n)
        chosen = places[np.minimum(np.searchsorted(cumulative, levels, side="right"), places.size - 1)]
        samples.append((chosen // mass.shape[1], chosen % mass.shape[1]))
    path, step = (np.concatenate(column) for column in zip(*samples, strict=True))
    return path, step
