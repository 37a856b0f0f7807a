"""A large population of enumerated paths: every cut-in, its probability, and which drivers crash on it.

Enumerating a pool takes seconds, thousands of pools hours. So many paths are enumerated once, and the pools of the
replications are drawn from them with replacement, path by path, as real pools are drawn from all paths.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.arrays import BoolArray, FloatArray, IntArray, RecordArray
from harness.compiled import cache_root, source_hash
from harness.environment.driving import Environment
from harness.pool.aimed_paths import PILOT_PATHS, EnumeratedPaths, Enumerator
from harness.progress import Progress
from harness.records.folder import write_atomically

CHUNK_PATHS = 2048
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class SuperPopulation:
    """Cut-ins of many paths on which at least one driver crashes.

    Attributes
    ----------
    cut_in : ndarray, shape (n,)
        Weighted probability of a cut-in, by path.
    path : ndarray of int64, shape (m,)
        Path of each cut-in, ascending.
    mass : ndarray, shape (m,)
        Its weighted probability.
    bits : ndarray of int64, shape (m,)
        One bit per driver that crashes.
    """

    cut_in: FloatArray
    path: IntArray
    mass: FloatArray
    bits: IntArray

    @property
    def n_paths(self) -> int:
        """Number of paths."""
        return int(self.cut_in.size)

    def crashes(self, driver: int) -> BoolArray:
        """On which cut-ins a driver crashes, shape (m,)."""
        found: BoolArray = (self.bits >> driver) & 1 == 1
        return found

    def by_path(self, mass: FloatArray) -> FloatArray:
        """Sum of a mass of cut-ins (m,) over each path, shape (n,)."""
        return np.asarray(np.bincount(self.path, mass, minlength=self.n_paths), np.float64)


def enumerate_paths(
    environment: Environment, drivers: RecordArray, envelope: int, seed: int, n_paths: int, progress: Progress
) -> SuperPopulation:
    """Enumerate paths that are aimed at the drivers' crashes, or read them from the cache.

    Parameters
    ----------
    environment : Environment
    drivers : structured ndarray, shape (D,)
        At most 62.
    envelope : int
        See `harness.pool.enumeration.enumerate_cut_ins`.
    seed, n_paths : int
    progress : Progress
    """
    file = cache_root() / "super_populations" / f"{_key(environment, drivers, envelope, seed, n_paths)}.parquet"
    if file.is_file():
        return _read(file)
    pilot = Enumerator(environment, drivers, envelope, seed)
    progress.stage(f"super-population of seed {seed}", n_paths + PILOT_PATHS)
    rates = pilot.run(0, PILOT_PATHS, progress).rates(drivers.size)
    aimed = pilot.aimed(rates)
    parts = []
    for first in range(0, n_paths, CHUNK_PATHS):
        paths = aimed.run(PILOT_PATHS + first, min(CHUNK_PATHS, n_paths - first), progress)
        parts.append(_compressed(paths, first))
    population = _joined(parts)
    _write(file, population)
    return population


def _compressed(paths: EnumeratedPaths, first: int) -> SuperPopulation:
    mass, bits = paths.mass, paths.crashes
    row, step = np.nonzero((bits != 0) & (mass > 0.0))
    return SuperPopulation(mass.sum(1), first + row.astype(np.int64), mass[row, step], bits[row, step])


def _joined(parts: Sequence[SuperPopulation]) -> SuperPopulation:
    return SuperPopulation(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("cut_in", "path", "mass", "bits"))
    )


def _key(environment: Environment, drivers: RecordArray, envelope: int, seed: int, n_paths: int) -> str:
    numbers = {name: environment.numbers[name].item() for name in environment.numbers.dtype.names or ()}
    content = [_FORMAT, source_hash(), numbers, drivers.tolist(), envelope, seed, n_paths]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:24]


def _write(file: Path, population: SuperPopulation) -> None:
    table = pa.table({name: getattr(population, name) for name in ("path", "mass", "bits")})
    table = table.replace_schema_metadata({b"cut_in": population.cut_in.tobytes()})
    write_atomically(file, lambda temporary: pq.write_table(table, temporary, compression="zstd"))


def _read(file: Path) -> SuperPopulation:
    table = pq.read_table(file, partitioning=None)
    cut_in = np.frombuffer(table.schema.metadata[b"cut_in"], np.float64)
    path, mass, bits = (np.asarray(table.column(name)) for name in ("path", "mass", "bits"))
    return SuperPopulation(cut_in, path, mass, bits)
