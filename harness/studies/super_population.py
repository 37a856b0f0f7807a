"""A large population of enumerated paths: every cut-in, its probability, which drivers crash on it; and so the truth.

Enumerating a pool takes seconds, thousands of pools hours. So many paths are enumerated once, and the pools of the
replications are drawn from them with replacement, path by path, as real pools are drawn from all paths. The true crash
rates are from other paths, that no pool of the experiment has.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.arrays import BoolArray, FloatArray, IntArray, RecordArray
from harness.campaign.models import AutomatedVehicle, BuiltInParameters, Reflexes
from harness.compiled import cache_root, source_hash
from harness.environment.driving import Environment
from harness.errors import CampaignError
from harness.pool.aimed_paths import PILOT_PATHS, Enumerator
from harness.pool.cut_ins import environment_hash
from harness.pool.library import Library
from harness.pool.shells import acceleration_limit
from harness.progress import Progress
from harness.records.folder import write_atomically
from harness.vehicles.models import driver_records

MOST_DRIVERS = 62
NO_ENVELOPE = -1
CHUNK_PATHS = 2048
LARGEST_ERROR = 0.005
"""Relative standard error that a truth should have at most."""
MORE_PATHS = 2
_FORMAT = 1
_COLUMNS = ("path", "mass", "bits")


@dataclass(frozen=True, eq=False)
class SuperPopulation:
    """Cut-ins of n paths on which at least one driver crashes.

    Attributes
    ----------
    cut_in : ndarray, shape (n,)
        Weighted probability of a cut-in, by path.
    path, mass : ndarray of int64 and float64, shape (m,)
        Path of each cut-in, ascending, and its weighted probability.
    bits : ndarray of int64, shape (m,)
        One bit per driver that crashes.
    """

    cut_in: FloatArray
    path: IntArray
    mass: FloatArray
    bits: IntArray

    def crashes(self, driver: int) -> BoolArray:
        """On which cut-ins a driver crashes, shape (m,)."""
        return np.asarray((self.bits >> driver) & 1 == 1)

    def by_path(self, mass: FloatArray) -> FloatArray:
        """Sum of a mass of cut-ins (m,) over each path, shape (n,)."""
        return np.asarray(np.bincount(self.path, mass, minlength=self.cut_in.size), np.float64)


@dataclass(frozen=True)
class Mixed:
    """A vehicle as drivers of the enumeration, each with the share of episodes in which it is that one."""

    drivers: tuple[int, ...]
    shares: tuple[float, ...]

    def crash_mass(self, population: SuperPopulation) -> FloatArray:
        """Probability that a cut-in happens and the vehicle crashes on it, shape (m,)."""
        crashing = np.zeros(population.mass.size)
        for driver, share in zip(self.drivers, self.shares, strict=True):
            crashing += share * population.crashes(driver)
        return crashing * population.mass


@dataclass(frozen=True, eq=False)
class Drivers:
    """All drivers of an enumeration, which are asked about the same cut-ins.

    Attributes
    ----------
    records : structured ndarray, shape (D,)
    envelope : int
        The driver that crashes wherever another one does; -1 if there is none.
    vehicles : dict of Mixed
        By name.
    """

    records: RecordArray
    envelope: int
    vehicles: dict[str, Mixed]

    @classmethod
    def of(cls, library: Library, avs: Mapping[str, AutomatedVehicle], *, see_onset: bool = False) -> Drivers:
        """The library's, in the order of its file, and then those of vehicles with built-in models.

        ``see_onset`` as in `harness.vehicles.models.driver_records`.

        The envelope is the library's, unless a vehicle accelerates harder.
        """
        models = list(library.surrogates.values())
        parameters: list[BuiltInParameters] = [model.parameters for model in models]
        reactions: list[Reflexes] = [model.reaction for model in models]
        vehicles = {}
        for name, av in avs.items():
            reflexes, shares = zip(*_reactions(av), strict=True)
            vehicles[name] = Mixed(tuple(range(len(parameters), len(parameters) + len(shares))), shares)
            parameters += [cast(BuiltInParameters, av.parameters)] * len(shares)
            reactions += reflexes
        if len(parameters) > MOST_DRIVERS:
            raise CampaignError(
                "avs",
                found=f"{len(parameters)} drivers with the library's {len(models)}",
                expected=f"at most {MOST_DRIVERS}",
                mend="Divide the experiment; an inattentive vehicle counts as two.",
            )
        enclosed = all(acceleration_limit(av) <= library.envelope_mps2 for av in avs.values())
        envelope = list(library.surrogates).index(library.envelope) if enclosed else NO_ENVELOPE
        return cls(driver_records(parameters, reactions, see_onset=see_onset), envelope, vehicles)

    def only(self, names: set[str]) -> Drivers:
        """The envelope and the drivers of some vehicles."""
        vehicles = {name: one for name, one in self.vehicles.items() if name in names}
        enclosed = self.envelope != NO_ENVELOPE
        kept = [self.envelope] * enclosed + [d for one in vehicles.values() for d in one.drivers]
        renumbered = {name: Mixed(tuple(map(kept.index, one.drivers)), one.shares) for name, one in vehicles.items()}
        return Drivers(self.records[kept], 0 if enclosed else NO_ENVELOPE, renumbered)


def _reactions(av: AutomatedVehicle) -> list[tuple[Reflexes, float]]:
    """The reflexes that a vehicle can have in an episode, and how probable each is."""
    own = av.reaction
    reflexes = Reflexes(delay_s=own.delay_s, max_jerk_mps3=own.max_jerk_mps3)
    if own.inattention_probability == 0.0 or own.inattention_delay_s == 0.0:
        return [(reflexes, 1.0)]
    late = reflexes.model_copy(update={"delay_s": own.delay_s + own.inattention_delay_s})
    return [(reflexes, 1.0 - own.inattention_probability), (late, own.inattention_probability)]


def enumerate_paths(
    environment: Environment, drivers: Drivers, seed: int, n_paths: int, progress: Progress
) -> SuperPopulation:
    """Enumerate paths that are aimed at the drivers' crashes, or read them from the cache."""
    asked = environment, drivers.records, drivers.envelope, seed
    file = cache_root() / "super_populations" / f"{_key(*asked, n_paths)}.parquet"
    if file.is_file():
        return _read(file)
    pilot = Enumerator(*asked)
    progress.stage(f"super-population of seed {seed}", n_paths + PILOT_PATHS)
    rates = pilot.run(0, PILOT_PATHS, progress).rates(drivers.records.size)
    aimed = pilot.aimed(rates)
    population = _compressed(aimed, n_paths, progress)
    _write(file, population)
    return population


def _compressed(aimed: Enumerator, n_paths: int, progress: Progress) -> SuperPopulation:
    """Enumerate chunk by chunk, and keep the cut-ins with crashes of each."""
    parts = []
    for first in range(0, n_paths, CHUNK_PATHS):
        paths = aimed.run(PILOT_PATHS + first, min(CHUNK_PATHS, n_paths - first), progress)
        mass, bits = paths.mass, paths.crashes
        row, step = np.nonzero((bits != 0) & (mass > 0.0))
        parts.append((mass.sum(1), first + row.astype(np.int64), mass[row, step], bits[row, step]))
    return SuperPopulation(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _key(environment: Environment, drivers: RecordArray, envelope: int, seed: int, n_paths: int) -> str:
    content = [_FORMAT, source_hash(), environment_hash(environment), drivers.tolist(), envelope, seed, n_paths]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:24]


def _write(file: Path, population: SuperPopulation) -> None:
    table = pa.table({name: getattr(population, name) for name in _COLUMNS})
    table = table.replace_schema_metadata({b"cut_in": population.cut_in.tobytes()})
    write_atomically(file, lambda temporary: pq.write_table(table, temporary, compression="zstd"))


def _read(file: Path) -> SuperPopulation:
    table = pq.read_table(file, partitioning=None)
    cut_in = np.frombuffer(table.schema.metadata[b"cut_in"], np.float64)
    return SuperPopulation(cut_in, *(np.asarray(table.column(name)) for name in _COLUMNS))


@dataclass(frozen=True)
class Truth:
    """A crash rate and its standard error."""

    crash_rate: float
    std_error: float

    @property
    def relative_error(self) -> float:
        """Standard error over the rate; infinite at rate 0."""
        return self.std_error / self.crash_rate if self.crash_rate > 0.0 else float("inf")


def truths(environment: Environment, drivers: Drivers, seed: int, n_paths: int, progress: Progress) -> dict[str, Truth]:
    """Crash rates of all vehicles.

    Paths are aimed at all drivers together. Vehicles that this leaves too imprecise, mostly those that crash in quite
    other places than the rest, are enumerated again with twice the paths, aimed at them alone.
    """
    found = _rates(drivers, enumerate_paths(environment, drivers, seed, n_paths, progress))
    imprecise = {name for name, truth in found.items() if truth.relative_error > LARGEST_ERROR}
    if not imprecise:
        return found
    again = drivers.only(imprecise)
    aimed = enumerate_paths(environment, again, seed + 1, MORE_PATHS * n_paths, progress)
    return found | {name: combined(found[name], better) for name, better in _rates(again, aimed).items()}


def combined(a: Truth, b: Truth) -> Truth:
    """Mean of two independent truths, weighted by their inverse variances."""
    weights = a.std_error**-2, b.std_error**-2
    total = sum(weights)
    return Truth((weights[0] * a.crash_rate + weights[1] * b.crash_rate) / total, total**-0.5)


def _rates(drivers: Drivers, population: SuperPopulation) -> dict[str, Truth]:
    found = {}
    for name, vehicle in drivers.vehicles.items():
        by_path = population.by_path(vehicle.crash_mass(population))
        found[name] = Truth(float(by_path.mean()), float(by_path.std() / np.sqrt(by_path.size)))
    return found
