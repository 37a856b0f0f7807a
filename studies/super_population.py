"""A large population of enumerated paths: every cut-in, its probability, which drivers crash on it; and so the truth.

Enumerating a pool takes seconds, thousands of pools hours. So many paths are enumerated once, and the pools of the
replications are drawn from them with replacement, path by path, as real pools are drawn from all paths. The truth is
from other paths (`studies.truths`), that no pool of the experiment has.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.campaign.vehicle import AutomatedVehicle, BuiltInParameters, Reflexes
from harness.compiled import WORLD_SOURCES, cache_root, source_hash
from harness.episode.path import Followers
from harness.errors import CampaignError
from harness.pool.aimed_paths import PILOT_PATHS, Enumerator
from harness.pool.cut_ins import environment_hash
from harness.pool.library import Library
from harness.pool.shells import acceleration_limit
from harness.progress import Progress
from harness.traffic.laws import Environment
from harness.vehicles.drivers import driver_records
from harness.vocabulary import BoolArray, FloatArray, IntArray, RecordArray
from studies.work import write_table

MOST_DRIVERS = 62
NO_ENVELOPE = -1
CHUNK_PATHS = 2048
_FORMAT = 1
_COLUMNS = ("path", "mass", "bits")


@dataclass(frozen=True, eq=False)
class SuperPopulation:
    """Cut-ins of n paths on which at least one driver crashes.

    ``cut_in`` (n,) is the weighted probability of a cut-in, by path; ``path`` and ``mass`` (m,) are the path of each
    cut-in, ascending, and its weighted probability; ``bits`` (m,) have one bit per driver that crashes.
    """

    cut_in: FloatArray
    path: IntArray
    mass: FloatArray
    bits: IntArray

    @property
    def n_paths(self) -> int:
        """Number of paths."""
        return self.cut_in.size

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
    """All drivers of an enumeration (D,), which are asked about the same cut-ins.

    The ``envelope`` crashes wherever another one does; -1 if there is none. Vehicles and reference drivers are by name.
    """

    records: RecordArray
    envelope: int
    vehicles: dict[str, Mixed]
    references: dict[str, int]

    @classmethod
    def of(cls, library: Library, avs: Mapping[str, AutomatedVehicle], *, see_onset: bool = False) -> Drivers:
        """The library's, references last, in the order of its file, and then vehicles with built-in models.

        The envelope is the library's, unless a vehicle accelerates harder; ``see_onset`` is that of `driver_records`.
        """
        models = [*library.surrogates.values(), *library.references.values()]
        parameters: list[BuiltInParameters] = [model.parameters for model in models]
        reactions: list[Reflexes] = [model.reaction for model in models]
        vehicles = {}
        for name, av in avs.items():
            reflexes, shares = zip(*_reactions(av), strict=True)
            vehicles[name] = Mixed(tuple(range(len(parameters), len(parameters) + len(shares))), shares)
            parameters += [cast(BuiltInParameters, av.parameters)] * len(shares)
            reactions += reflexes
        if len(parameters) > MOST_DRIVERS:
            found = f"{len(parameters)} drivers with the library's {len(models)}"
            mend = "Divide the experiment; an inattentive vehicle counts as two."
            raise CampaignError("avs", found, f"at most {MOST_DRIVERS}", mend)
        enclosed = all(acceleration_limit(av) <= library.envelope_mps2 for av in avs.values())
        envelope = list(library.surrogates).index(library.envelope) if enclosed else NO_ENVELOPE
        records = driver_records(parameters, reactions, see_onset=see_onset)
        return cls(records, envelope, vehicles, reference_drivers(library))

    def only(self, names: set[str]) -> Drivers:
        """The envelope, the references and the drivers of some vehicles."""
        vehicles = {name: one for name, one in self.vehicles.items() if name in names}
        enclosed = self.envelope != NO_ENVELOPE
        kept = [self.envelope] * enclosed + [*self.references.values()]
        kept += [d for one in vehicles.values() for d in one.drivers]
        renumbered = {name: Mixed(tuple(map(kept.index, one.drivers)), one.shares) for name, one in vehicles.items()}
        references = {name: kept.index(driver) for name, driver in self.references.items()}
        return Drivers(self.records[kept], 0 if enclosed else NO_ENVELOPE, renumbered, references)


def reference_drivers(library: Library) -> dict[str, int]:
    """The library's reference drivers by name, as places among all its drivers."""
    return {name: len(library.surrogates) + r for r, name in enumerate(library.references)}


def _reactions(av: AutomatedVehicle) -> list[tuple[Reflexes, float]]:
    """The reflexes that a vehicle can have in an episode, and how probable each is."""
    own = av.reaction
    reflexes = Reflexes(**own.model_dump(include=set(Reflexes.model_fields)))
    if own.inattention_probability == 0.0 or own.inattention_delay_s == 0.0:
        return [(reflexes, 1.0)]
    late = reflexes.model_copy(update={"delay_s": own.delay_s + own.inattention_delay_s})
    return [(reflexes, 1.0 - own.inattention_probability), (late, own.inattention_probability)]


def enumerate_paths(
    environment: Environment, drivers: Drivers, seed: int, n_paths: int, progress: Progress
) -> SuperPopulation:
    """Enumerate paths that are aimed at the drivers' crashes, or read them from the cache."""
    asked = environment, Followers(drivers.records, drivers.envelope), seed

    def enumerated() -> SuperPopulation:
        pilot = Enumerator(*asked)
        progress.stage(f"super-population of seed {seed}", n_paths + PILOT_PATHS)
        rates = pilot.run(0, PILOT_PATHS, progress).rates(drivers.records.size)
        return _compressed(pilot.aimed(rates), n_paths, progress)

    return cached(population_key(environment, drivers.records.tolist(), drivers.envelope, seed, n_paths), enumerated)


def cached(key: str, make: Callable[[], SuperPopulation]) -> SuperPopulation:
    """A population of a key, read from the cache or made and kept there."""
    file = cache_root() / "super_populations" / f"{key}.parquet"
    with suppress(OSError, pa.ArrowException, KeyError, TypeError, ValueError):  # a damaged one is made anew
        table = pq.read_table(file, partitioning=None)
        cut_in = np.frombuffer(table.schema.metadata[b"cut_in"], np.float64)
        return SuperPopulation(cut_in, *(np.asarray(table.column(name)) for name in _COLUMNS))
    population = make()
    table = pa.table({name: getattr(population, name) for name in _COLUMNS})
    write_table(file, table.replace_schema_metadata({b"cut_in": population.cut_in.tobytes()}))
    return population


def _compressed(aimed: Enumerator, n_paths: int, progress: Progress) -> SuperPopulation:
    """Enumerate chunk by chunk, and keep the cut-ins with crashes of each."""
    parts = []
    for first in range(0, n_paths, CHUNK_PATHS):
        paths = aimed.run(PILOT_PATHS + first, min(CHUNK_PATHS, n_paths - first), progress)
        mass, bits = paths.mass, paths.crashes
        row, step = np.nonzero((bits != 0) & (mass > 0.0))
        parts.append(SuperPopulation(mass.sum(1), first + row.astype(np.int64), mass[row, step], bits[row, step]))
    return joined(parts)


def joined(parts: Sequence[SuperPopulation]) -> SuperPopulation:
    """All in one; each part knows the numbers that its paths have in the whole."""
    columns = ("cut_in", *_COLUMNS)
    return SuperPopulation(*(np.concatenate([getattr(part, name) for part in parts]) for name in columns))


def population_key(environment: Environment, *content_of: object) -> str:
    """Hash of all that a population depends on: plain content, an environment, and code."""
    content = [_FORMAT, source_hash(WORLD_SOURCES), environment_hash(environment), *content_of]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:24]
