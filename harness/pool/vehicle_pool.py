"""The pool of one vehicle that acts before the event: paths that it drives itself, on which surrogates take over.

LV's and BV's motion does not depend on the AV, and so neither does the choice of paths: a path's weight is known before
the vehicle has moved. Candidates are aimed paths of the pool, walked in the twin beside an AV that holds its speed.
Paths are drawn from them with replacement, mostly by how much they contribute to the surrogates' crash rates; a share
is drawn evenly, which bounds every weight.

Along each path the vehicle is then driven once without an event, its *baseline run*. Its positions there decide how
probable an event is in each step. Surrogates take over from it after the step of the event, in which it still does what
it did. So shells and their probabilities are those of this vehicle; allocation and estimates are as for any other.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np

from harness import cache
from harness.errors import HarnessError
from harness.families.protocol import Paths, Recorded
from harness.loop.judge import motion_hashes
from harness.pool.aim import PILOT_PATHS, EnumeratedPaths, contributions
from harness.pool.build import ROUND_PATHS, campaign_pool_key, pool_of, take_aim
from harness.pool.shells import CANDIDATES, Pool, conservative_first
from harness.progress import Progress
from harness.random_stream import DIAGNOSTIC, uniforms
from harness.resolved import Resolved
from harness.vocabulary import FloatArray, IntArray, RecordArray

EVENLY = 0.1
"""Share of paths that are drawn evenly: none gets more than ten times the weight that it has if all are."""
CHOICE_DRAW = 2
"""Draw within the diagnostic stream by which a baseline run's path is chosen."""


@dataclass(frozen=True, eq=False)
class BaselinePaths:
    """Independent draws of paths; several may be the same path, for runs with random streams of their own.

    ``key`` is the content hash of all that they follow from, ``seed`` that of their random numbers. ``order`` (D,) are
    the surrogates as places in the library, by their crash rates after holding speed, the most conservative first.
    ``index``, ``start``, ``weight`` (n,) are the paths' numbers, how they begin, and naturalistic density over that of
    the draw. ``p_held`` (2,) is the probability of an event ahead of an AV that holds its speed, and its standard
    error.
    """

    key: str
    seed: int
    order: IntArray
    index: IntArray
    start: RecordArray
    weight: FloatArray
    p_held: FloatArray

    @property
    def paths(self) -> Paths:
        """The paths without their weights."""
        return Paths(self.index, self.start)

    def __len__(self) -> int:
        return self.index.size


@dataclass(frozen=True, eq=False)
class Candidates(BaselinePaths):
    """Paths to draw from, each with its ``chance`` (n,) in every draw, and the ``weight`` that it has if drawn."""

    chance: FloatArray

    def draw(self, n: int) -> BaselinePaths:
        """Draw ``n`` of them, with replacement."""
        u = uniforms(self.seed, 0, n, DIAGNOSTIC, CHOICE_DRAW + 1)[:, CHOICE_DRAW]
        cumulative = np.cumsum(self.chance)
        rows = np.minimum(np.searchsorted(cumulative, u * cumulative[-1], side="right"), len(self) - 1)
        index, start, weight = self.index[rows], self.start[rows], self.weight[rows]
        return BaselinePaths(self.key, self.seed, self.order, index, start, weight, self.p_held)


def walk_candidates(resolved: Resolved, key: str, progress: Progress, candidates: int = CANDIDATES) -> Candidates:
    """Walk aimed paths beside an AV that holds its speed, as ``candidates`` for baseline runs."""
    aim = take_aim(resolved, progress)
    progress.stage("paths for baseline runs", candidates)
    n_surrogates = len(resolved.library.surrogates)
    rounds = range(PILOT_PATHS, PILOT_PATHS + candidates, ROUND_PATHS)
    parts = (aim.enumerator.run(first, ROUND_PATHS, progress) for first in rounds)
    columns = [(part.index, part.start, part.weight, part.rates(n_surrogates)) for part in parts]
    index, start, weight, rates = (np.concatenate(column) for column in zip(*columns, strict=True))
    chance = chances(rates, aim.share)
    order = conservative_first(rates)
    event = rates[:, -1]
    p_held = np.array([event.mean(), event.std() / np.sqrt(candidates)])
    return Candidates(key, aim.enumerator.seed, order, index, start, weight / (candidates * chance), p_held, chance)


def chances(rates: FloatArray, share: FloatArray) -> FloatArray:
    """Probability of each candidate to be drawn, by what it contributes to the rates (n, columns); sums to 1."""
    importance = contributions(rates, share)
    mean = importance.mean()
    chance = EVENLY + (1.0 - EVENLY) * (importance / mean if mean > 0.0 else np.ones_like(importance))
    normalised: FloatArray = chance / chance.sum()
    return normalised


def _candidates_key(resolved: Resolved) -> str:
    """Hash of all that the candidates depend on: the key of their pool, and this file."""
    code = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    return hashlib.sha256(json.dumps([campaign_pool_key(resolved), code]).encode()).hexdigest()[:24]


def baseline_paths_name(resolved: Resolved) -> str:
    """Name of the candidates' file in the cache."""
    return f"pools/baseline-{_candidates_key(resolved)}.npz"


def campaign_baseline_paths(resolved: Resolved, progress: Progress) -> BaselinePaths:
    """Draw the paths that a campaign's vehicle is to drive, from candidates of the cache, or walked and cached."""
    key, name = _candidates_key(resolved), baseline_paths_name(resolved)
    if (content := cache.read(name)) is not None:
        with np.load(BytesIO(content)) as stored:
            columns = {name: stored[name] for name in ("order", "index", "start", "weight", "p_held", "chance")}
            candidates = Candidates(key, int(stored["seed"]), **columns)
    else:
        candidates = walk_candidates(resolved, key, progress)
        np.savez(file := BytesIO(), **vars(candidates))
        cache.keep(name, file.getbuffer())
    return candidates.draw(resolved.campaign.pool.shadow_paths)


def vehicle_pool(resolved: Resolved, paths: BaselinePaths, runs: Recorded) -> Pool:
    """Pool of the vehicle that was driven along the paths in these baseline ``runs``.

    Raises `HarnessError`: no event was found on which even the envelope crashes.
    """
    environment = resolved.environment
    followers = resolved.library.followers(resolved.family.shows(environment))
    events = resolved.family.events(environment, paths.seed, paths.paths, followers, runs)
    if not events.crashes.any():
        failed = f" ({n:,} of them failed)" if (n := int(runs.failed.sum())) else ""
        found = f"no event on {len(paths):,} paths{failed} after which even the most careless surrogate would crash"
        mend = "Raise pool.shadow_paths, use testing.method forced, or see whether the vehicle moves "
        mend += "(`harness av-check`)."
        raise HarnessError("baseline runs", found, "some: the crash rate is estimated from them", mend)
    mass = events.probability * paths.weight[:, None]
    enumerated = EnumeratedPaths(paths.index, paths.start, paths.weight, mass, events.crashes)
    key = hashlib.sha256(" ".join((paths.key, resolved.content_hash, runs.digest())).encode()).hexdigest()[:24]
    pool = pool_of(resolved, enumerated, key, paths.order)
    hashes = motion_hashes(runs.x_m, runs.v_mps)
    row, step, onset = pool.events.row, pool.events.step, pool.events.onset
    # A kept event also stands for similar ones that are too improbable to be kept: at least its share of the shell.
    least = pool.shell_p[pool.shell] * (len(paths) / np.bincount(pool.shell)[pool.shell])
    kept = replace(pool.events, motion=hashes[row, onset], mass=np.maximum(mass[row, step], least))
    p_after_failure = float((events.after_failure * paths.weight).mean())
    p_held, p_held_se = paths.p_held.tolist()
    return replace(pool, events=kept, p_after_failure=p_after_failure, p_held=p_held, p_held_se=p_held_se)
