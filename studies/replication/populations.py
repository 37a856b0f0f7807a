"""Large populations of enumerated paths: every cut-in, its probability, which drivers crash on it; and so the truth.

Enumerating a pool takes seconds, thousands of pools hours. So many paths are enumerated once, and the pools of the
replications are drawn from them with replacement, path by path, as real pools are drawn from all paths. The truth is
from other paths, that no pool of the experiment has: crash rates, their ratios and differences are means over paths, or
ratios of two of them, so that each has a standard error.

A vehicle that acts before the cut-in has a population of paths that it has walked. They are chosen as for a campaign's
shadow runs, only many more of them. As there every cut-in is asked where pools are drawn, or the error of few paths
would look larger than it is; of paths for the truth every `stride`-th. Surrogates and references take
over from the vehicle as in its pool, and the vehicle itself drives each of these cut-ins as a test of the campaign
would: told the index of its shadow run, and held to the hash of what it did there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.vehicle import AutomatedVehicle
from harness.controllers.find import build_host
from harness.errors import CampaignError, HarnessError
from harness.families import family_named
from harness.families.cut_in.laws import Environment
from harness.families.protocol import Paths
from harness.loop.judge import motion_hashes
from harness.loop.loop import EpisodeLoop, RecordPolicy
from harness.loop.repeat import Traffic
from harness.pool.aim import PILOT_PATHS, Enumerator
from harness.pool.shells import CANDIDATES, acceleration_limit, onset_steps
from harness.pool.vehicle_pool import BaselinePaths, walk_candidates
from harness.progress import Progress
from harness.resolved import resolve
from harness.sampling.paths import recorded, without_event
from harness.vehicles.drivers import Followers, av_records
from harness.vehicles.library import Library
from harness.vocabulary import CRASH, BoolArray, FloatArray, IntArray, RecordArray
from harness.worlds.twin import TwinWorld
from studies.work import results_of

MOST_DRIVERS = 62
NO_ENVELOPE = -1
CHUNK_PATHS = 2048
Mixed = dict[int, float]
"""A vehicle as drivers of an enumeration: the share of episodes in which it is each."""


class SuperPopulation(NamedTuple):
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

    def crash_mass(self, mixed: Mixed) -> FloatArray:
        """Probability that a cut-in happens and a vehicle crashes on it, shape (m,)."""
        shares = (share * self.crashes(driver) for driver, share in mixed.items())
        return np.asarray(sum(shares, start=np.zeros(self.mass.size)) * self.mass)

    def by_path(self, mass: FloatArray) -> FloatArray:
        """Sum of a mass of cut-ins (m,) over each path, shape (n,)."""
        return np.asarray(np.bincount(self.path, mass, minlength=self.cut_in.size), np.float64)


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
        (records, envelope, *_), vehicles = library.followers(see_onset), dict[str, Mixed]()
        for name, av in avs.items():
            of_av, shares = reactions(av, see_onset)
            vehicles[name] = dict(enumerate(shares, start=records.size))
            records = np.concatenate([records, of_av])
        if records.size > MOST_DRIVERS:
            found = f"{records.size} drivers with the library's {library.n_drivers}"
            mend = "Divide the experiment; an inattentive vehicle counts as two."
            raise CampaignError("avs", found, f"at most {MOST_DRIVERS}", mend)
        enclosed = all(acceleration_limit(av) <= library.envelope_mps2 for av in avs.values())
        return cls(records, envelope if enclosed else NO_ENVELOPE, vehicles, reference_drivers(library))

    def only(self, names: set[str]) -> Drivers:
        """The envelope, the references and the drivers of some vehicles."""
        enclosed = self.envelope != NO_ENVELOPE
        kept = [self.envelope] * enclosed + [*self.references.values()]
        kept += [d for name, one in self.vehicles.items() if name in names for d in one]
        vehicles = {n: {kept.index(d): p for d, p in one.items()} for n, one in self.vehicles.items() if n in names}
        references = {name: kept.index(driver) for name, driver in self.references.items()}
        return Drivers(self.records[kept], 0 if enclosed else NO_ENVELOPE, vehicles, references)


def reference_drivers(library: Library) -> dict[str, int]:
    """The library's reference drivers by name, as places among all its drivers."""
    return {name: len(library.surrogates) + r for r, name in enumerate(library.references)}


def reactions(av: AutomatedVehicle, see_onset: bool) -> tuple[RecordArray, list[float]]:
    """The drivers that a vehicle can be in an episode, attentive or not, and how probable each is."""
    own = av_records(av, see_onset=see_onset)
    late = float(own["inattention_probability"][0] * (own["inattention_steps"][0] > 0.0))
    found = np.repeat(own, 1 + (late > 0.0))
    found["delay_steps"][1:] += found["inattention_steps"][1:]
    found["inattention_probability"] = found["inattention_steps"] = 0.0
    return found, [1.0 - late, late][: found.size]


def enumerate_paths(
    environment: Environment, progress: Progress, drivers: Drivers, seed: int, n_paths: int
) -> SuperPopulation:
    """Enumerate paths that are aimed at the drivers' crashes, and keep the cut-ins with crashes."""
    pilot = Enumerator(family_named("cut_in"), environment, Followers(drivers.records, drivers.envelope), seed)
    progress.stage(f"super-population of seed {seed}", n_paths + PILOT_PATHS)
    aimed, parts = pilot.aimed(pilot.run(0, PILOT_PATHS, progress).rates(drivers.records.size)), []
    for first in range(0, n_paths, CHUNK_PATHS):
        paths = aimed.run(PILOT_PATHS + first, min(CHUNK_PATHS, n_paths - first), progress)
        mass, bits = paths.mass, paths.crashes
        row, step = np.nonzero((bits != 0) & (mass > 0.0))
        parts.append(SuperPopulation(mass.sum(1), first + row.astype(np.int64), mass[row, step], bits[row, step]))
    return joined(parts)


def joined(parts: Sequence[SuperPopulation]) -> SuperPopulation:
    """All in one; each part knows the numbers that its paths have in the whole."""
    return SuperPopulation(*map(np.concatenate, zip(*parts, strict=True)))


LARGEST_ERROR = 0.005
"""Standard error of a crash rate, over the rate, that a truth should have at most."""
MORE_PATHS = 3
RATE, DIFFERENCE, CONDITIONAL_DIFFERENCE = "rate", "difference", "difference, conditional"
ratio_to, preventable_by = "ratio to {}".format, "preventable by {}".format
"""Names of the ratio of a vehicle's crash rate to a reference driver's, and of the share that this one prevents."""


@dataclass(frozen=True)
class Known:
    """A true value, its standard error, and what deviations from it are to be seen beside.

    That is the value itself, but 1 for a share, and the larger of the two rates for a difference: both may be 0.
    """

    value: float
    std_error: float
    scale: float

    @classmethod
    def exactly(cls, value: float) -> Known:
        """One that is known without error, and is its own scale."""
        return cls(value, 0.0, value)

    @property
    def relative_error(self) -> float:
        """Standard error over the scale; infinite at scale 0."""
        return self.std_error / self.scale if self.scale > 0.0 else float("inf")


def ratio_of(above: FloatArray, below: FloatArray | None = None, scale: float | None = None) -> Known:
    """Ratio of the means of two numbers that each path has (n,), with the error of the delta method; or one mean."""
    mean = 1.0 if below is None else float(below.mean())
    if mean <= 0.0:
        return Known(np.nan, np.nan, np.nan if scale is None else scale)
    ratio = float(above.mean()) / mean
    error = float((above if below is None else above - ratio * below).std() / np.sqrt(above.size)) / mean
    return Known(ratio, error, ratio if scale is None else scale)


def of_vehicle(population: SuperPopulation, crashing: FloatArray, references: Mapping[str, int]) -> dict[str, Known]:
    """Everything about a vehicle by its mass of crashes (m,), beside reference drivers."""
    own = population.by_path(crashing)
    found = {RATE: ratio_of(own)}
    for name, driver in references.items():
        crashes_too = population.crashes(driver)
        found[ratio_to(name)] = ratio_of(own, population.by_path(population.mass * crashes_too))
        found[preventable_by(name)] = ratio_of(population.by_path(crashing * ~crashes_too), own, 1.0)
    return found


def of_pair(population: SuperPopulation, a: FloatArray, b: FloatArray) -> dict[str, Known]:
    """How much more often one vehicle crashes than another, by their masses of crashes (m,); both statements' truth."""
    larger = max(float(x.sum()) for x in (a, b)) / population.n_paths
    difference = ratio_of(population.by_path(a - b), scale=larger)
    return {DIFFERENCE: difference, CONDITIONAL_DIFFERENCE: difference}


Enumerate = Callable[[Drivers, int, int], SuperPopulation]
"""`enumerate_paths` by drivers, seed and number of paths."""


class Truths:
    """Paths that vehicles' truths are from: aimed at all drivers, and again at some that these leave imprecise.

    Those mostly crash in quite other places than the rest. They are enumerated again with more paths, aimed at them
    alone, and at vehicles that they are compared with: ``together`` are pairs.
    """

    def __init__(
        self, enumerated: Enumerate, drivers: Drivers, seed: int, n_paths: int, together: Iterable[set[str]] = ()
    ) -> None:
        self._enumerated = [(drivers, enumerated(drivers, seed, n_paths))]
        imprecise = {name for name in drivers.vehicles if self.vehicle(name)[RATE].relative_error > LARGEST_ERROR}
        if imprecise:
            again = drivers.only(imprecise.union(*(pair for pair in together if pair & imprecise)))
            self._enumerated.insert(0, (again, enumerated(again, seed + 1, MORE_PATHS * n_paths)))

    def vehicle(self, name: str) -> dict[str, Known]:
        """Everything about one vehicle."""
        drivers, population = self._where(name)
        return of_vehicle(population, population.crash_mass(drivers.vehicles[name]), drivers.references)

    def pair(self, a: str, b: str) -> dict[str, Known]:
        """Everything about two vehicles."""
        drivers, population = self._where(a, b)
        return of_pair(population, *(population.crash_mass(drivers.vehicles[name]) for name in (a, b)))

    def _where(self, *names: str) -> tuple[Drivers, SuperPopulation]:
        """The most precise paths that have all of them."""
        return next(found for found in self._enumerated if {*names} <= {*found[0].vehicles})


CELLS = 1024
WALKED_CHUNK = 1024
"""Paths that one task walks: some 15 MB of motion."""


def choose_paths(
    campaign: Campaign, seed: int, n_paths: int, progress: Progress, candidates: int = CANDIDATES
) -> BaselinePaths:
    """Choose paths in the traffic of a campaign, out of so many, or of as many as are asked for."""
    resolved = resolve(campaign.replaced(("pool", "seed"), seed))
    return walk_candidates(resolved, "walked", progress, max(n_paths, candidates)).draw(n_paths)


def walk_paths(
    campaign: Campaign,
    paths: BaselinePaths,
    executor: Executor,
    progress: Progress,
    stride: int = family_named("cut_in").stride,
) -> SuperPopulation:
    """Let the campaign's vehicle walk paths, and ask every ``stride``-th of their cut-ins.

    Raises `HarnessError`: the vehicle failed, or did something else in a test than in its shadow run.
    """
    jobs = []
    for first in range(0, len(paths), WALKED_CHUNK):
        part = {name: getattr(paths, name)[first : first + WALKED_CHUNK] for name in ("index", "start", "weight")}
        jobs.append((first, replace(paths, **part)))
    walk = partial(_walk, campaign.model_dump_json(), stride)
    return joined(results_of("walked paths", jobs, walk, progress, executor))


def _walk(campaign_json: str, stride: int, job: tuple[int, BaselinePaths]) -> SuperPopulation:
    """Walk paths that have numbers from a first one on, and drive the vehicle on their cut-ins as tests would be."""
    first, paths = job
    resolved = resolve(Campaign.model_validate_json(campaign_json))
    campaign, environment, library = resolved.campaign, resolved.environment, resolved.library
    host = build_host(campaign.av, n_cells=CELLS, seed=campaign.seed)
    loop = EpisodeLoop(TwinWorld(CELLS), resolved.scenario, RecordPolicy("none", 0.0), host)  # keeps all of its motion
    runs = recorded(without_event(loop, resolved, paths.seed, paths.paths, first))
    offset = np.random.default_rng([paths.seed, first]).integers(0, stride, len(paths))
    followers = library.followers(environment.lateral.present)
    events = resolved.family.events(environment, paths.seed, paths.paths, followers, runs, stride, offset)
    bits, mass = events.crashes, events.probability * paths.weight[:, None]
    row, step = np.nonzero(mass > 0.0)
    chosen = resolved.family.choose(environment, paths.seed, Paths(paths.index[row], paths.start[row]), step)
    motion = motion_hashes(runs.x_m, runs.v_mps)[row, onset_steps(step, chosen.lead)]
    script = resolved.family.script(environment, chosen)
    tests = loop.run(0, Traffic(script._replace(announced_index=first + row, motion_hash=motion), chosen.facts))
    if n_failed := int(runs.failed.sum()) + len(tests.failures):
        found = f"{n_failed:,} of {len(paths):,} shadow runs and {row.size:,} tests failed"
        expected = "none: what a vehicle would have done is not known, and so neither is its crash rate"
        mend = "Mend the vehicle (`harness av-check` looks at it in seconds), or leave it out of the experiment."
        raise HarnessError(f"avs: {campaign.av.controller or campaign.av.fmu}", found, expected, mend)
    crashes = tests.episode["outcome"] == CRASH
    of_cut_ins = bits[row, step] | (crashes.astype(np.int64) << library.n_drivers)  # the vehicle comes after these
    somebody = of_cut_ins != 0
    row, step = row[somebody], step[somebody]
    return SuperPopulation(mass.sum(1), first + row, mass[row, step], of_cut_ins[somebody])
