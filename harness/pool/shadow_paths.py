"""Paths for a vehicle that acts before the cut-in to walk itself: few, chosen where surrogates that hold speed crash.

LV's and BV's motion does not depend on the AV, and so neither does the choice: a path's weight is known before the
vehicle has moved. Candidates are aimed paths of the pool, walked in the twin beside an AV that holds its speed; paths
are drawn from them with replacement, by how much they contribute to the surrogates' crash rates, with a share that is
drawn evenly and bounds every weight.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.arrays import FloatArray, Int8Array, IntArray, RecordArray
from harness.campaign.models import PoolSettings
from harness.compiled import cache_root
from harness.environment.driving import Environment
from harness.episode.trajectory import empty_trajectory
from harness.pool.aimed_paths import PILOT_PATHS, contributions
from harness.pool.build import POOL_SEED, ROUND_PATHS, careful_first, take_aim
from harness.pool.enumeration import write_traffic
from harness.pool.library import Library
from harness.pool.storage import campaign_pool_key
from harness.progress import Progress, SilentProgress
from harness.random_stream import DIAGNOSTIC, uniforms
from harness.records.folder import require_place, write_atomically
from harness.resolved import Resolved
from harness.state import STATE_COLUMNS, states_from

CANDIDATES = 32_768
"""Paths of an AV that holds its speed to choose from: they cost milliseconds each, and save two of three shadow runs.

Their own error (standard error 0.4 % of the careful surrogates' rates, against 2 % of 500 shadow runs; measured in the
default traffic) is in no interval.
"""
EVENLY = 0.1
"""Share of the choice that does not look at surrogates: no path counts for more than ten times its even weight."""
CHOICE_DRAW = 2
"""Draw of a shadow run within the diagnostic stream."""
_KEY = b"harness_shadow_paths"


@dataclass(frozen=True, eq=False)
class ShadowPaths:
    """Independent draws of paths; some may be the same path, for runs with random streams of their own.

    Attributes
    ----------
    key : str
        Content hash of all that they follow from.
    seed : int
        Of their random numbers.
    order : ndarray of int64, shape (D,)
        Surrogates from careful to careless behind an AV that holds its speed, as places in the library.
    index, state, weight : ndarray, shape (n,)
        The paths' numbers, initial states, and naturalistic density over that of the draw.
    """

    key: str
    seed: int
    order: IntArray
    index: IntArray
    state: RecordArray
    weight: FloatArray

    def __len__(self) -> int:
        return self.index.size

    def traffic(self, environment: Environment) -> tuple[Int8Array, Int8Array]:
        """Maneuvers of LV and BV where nobody cuts in, (n, draws) each."""
        return traffic_without_cut_in(self.seed, self.index, self.state, environment)


def traffic_without_cut_in(
    seed: int, index: IntArray, state: RecordArray, environment: Environment
) -> tuple[Int8Array, Int8Array]:
    """Maneuvers of LV and BV on chosen paths (n,) where nobody cuts in, (n, draws) each."""
    room = empty_trajectory(environment)
    lv, bv = np.zeros((2, index.size, room.lv.size), np.int8)
    write_traffic(seed, index, state, environment, room, lv, bv)
    return lv, bv


def choose_paths(
    environment: Environment,
    library: Library,
    settings: PoolSettings,
    key: str,
    progress: Progress | None = None,
    candidates: int = CANDIDATES,
) -> ShadowPaths:
    """Walk so many candidates, and draw ``settings.shadow_paths`` of them."""
    progress = progress or SilentProgress()
    aim = take_aim(environment, library, settings, progress)
    progress.stage("paths for shadow runs", candidates)
    n_surrogates = len(library.surrogates)
    rounds = range(PILOT_PATHS, PILOT_PATHS + candidates, ROUND_PATHS)
    parts = (aim.enumerator.run(first, ROUND_PATHS, progress) for first in rounds)
    columns = [(part.index, part.state, part.weight, part.rates(n_surrogates)) for part in parts]
    index, state, weight, rates = (np.concatenate(column) for column in zip(*columns, strict=True))
    probability = chances(rates, aim.share)
    u = uniforms(settings.seed ^ POOL_SEED, 0, settings.shadow_paths, DIAGNOSTIC, CHOICE_DRAW + 1)[:, CHOICE_DRAW]
    cumulative = np.cumsum(probability)
    chosen = np.minimum(np.searchsorted(cumulative, u * cumulative[-1], side="right"), candidates - 1)
    weights = weight[chosen] / (candidates * probability[chosen])
    seed, order = settings.seed ^ POOL_SEED, careful_first(rates)
    return ShadowPaths(key, seed, order, index[chosen], state[chosen], weights)


def chances(rates: FloatArray, share: FloatArray) -> FloatArray:
    """Probability of each candidate to be drawn, by what it contributes to the rates (n, columns); sums to 1."""
    importance = contributions(rates, share)
    mean = importance.mean()
    chance = EVENLY + (1.0 - EVENLY) * (importance / mean if mean > 0.0 else np.ones_like(importance))
    found: FloatArray = chance / chance.sum()
    return found


def shadow_paths_key(resolved: Resolved) -> str:
    """Hash of all that the paths depend on: that of the pool which they are chosen from, their number, and code."""
    own = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    content = [campaign_pool_key(resolved), own, resolved.campaign.pool.shadow_paths]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:24]


def shadow_paths_file(resolved: Resolved) -> Path:
    """Where a campaign's paths are cached."""
    return cache_root() / "pools" / f"shadow-{shadow_paths_key(resolved)}.parquet"


def campaign_shadow_paths(resolved: Resolved, progress: Progress | None = None) -> ShadowPaths:
    """The paths that a campaign's vehicle is to walk, from the cache or chosen and cached.

    Raises
    ------
    RunFolderError
        They could not be kept.
    """
    key, path = shadow_paths_key(resolved), shadow_paths_file(resolved)
    if (cached := _cached(path, key)) is not None:
        return cached
    require_place(path.parent, mend="Change its permissions, or name another place in HARNESS_CACHE_DIR.")
    chosen = choose_paths(resolved.environment, resolved.library, resolved.campaign.pool, key, progress)
    table = _table(chosen)
    write_atomically(path, lambda temporary: pq.write_table(table, temporary, compression="zstd"))
    return chosen


def _table(paths: ShadowPaths) -> pa.Table:
    columns = {"index": paths.index, "weight": paths.weight, **{name: paths.state[name] for name in STATE_COLUMNS}}
    table = pa.table({name: pa.array(np.ascontiguousarray(values)) for name, values in columns.items()})
    facts = {"key": paths.key, "seed": paths.seed, "order": paths.order.tolist()}
    return table.replace_schema_metadata({_KEY: json.dumps({**facts, "digest": _digest(table)})})


def _cached(path: Path, key: str) -> ShadowPaths | None:
    """What is kept under a key; None if there is none, or the file is damaged or of another key."""
    try:
        table = pq.read_table(path, partitioning=None)
        facts = json.loads((table.schema.metadata or {})[_KEY])
    except (OSError, pa.ArrowException, KeyError, ValueError):
        return None
    if facts.get("key") != key or facts.get("digest") != _digest(table):
        return None
    index, weight = table.column("index").to_numpy(), table.column("weight").to_numpy()
    state = states_from(np.asarray(table.column(name)) for name in STATE_COLUMNS)
    return ShadowPaths(key, facts["seed"], np.array(facts["order"], np.int64), index, state, weight)


def _digest(table: pa.Table) -> str:
    """Hash of all values: Parquet notices a truncated file, but hardly any flipped bit."""
    digest = hashlib.sha256()
    for column in table.columns:
        digest.update(column.to_numpy().tobytes())
    return digest.hexdigest()
