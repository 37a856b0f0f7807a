"""What the crash rates of an experiment's vehicles are: from paths that no pool of the experiment has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from harness.arrays import IntArray
from harness.environment.driving import Environment
from harness.progress import Progress
from harness.studies.panel import NO_ENVELOPE, Drivers, Mixed
from harness.studies.super_population import SuperPopulation, enumerate_paths

LARGEST_ERROR = 0.005
"""Relative standard error that a truth should have at most."""
MORE_PATHS = 2


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
    population = enumerate_paths(environment, drivers.records, drivers.envelope, seed, n_paths, progress)
    found = _rates(drivers.vehicles, population)
    imprecise = {name: drivers.vehicles[name] for name, truth in found.items() if truth.relative_error > LARGEST_ERROR}
    if not imprecise:
        return found
    enclosed = drivers.envelope != NO_ENVELOPE
    kept: IntArray = np.array(
        [*([drivers.envelope] if enclosed else []), *(d for one in imprecise.values() for d in one.drivers)]
    )
    place = {driver: k for k, driver in enumerate(kept.tolist())}
    again = {name: Mixed(tuple(place[d] for d in one.drivers), one.shares) for name, one in imprecise.items()}
    aimed = enumerate_paths(
        environment, drivers.records[kept], 0 if enclosed else NO_ENVELOPE, seed + 1, MORE_PATHS * n_paths, progress
    )
    return found | {name: combined(found[name], better) for name, better in _rates(again, aimed).items()}


def combined(a: Truth, b: Truth) -> Truth:
    """Mean of two independent truths, weighted by their inverse variances."""
    weights = a.std_error**-2, b.std_error**-2
    total = sum(weights)
    return Truth((weights[0] * a.crash_rate + weights[1] * b.crash_rate) / total, total**-0.5)


def _rates(vehicles: Mapping[str, Mixed], population: SuperPopulation) -> dict[str, Truth]:
    found = {}
    for name, vehicle in vehicles.items():
        by_path = population.by_path(vehicle.crash_mass(population))
        found[name] = Truth(float(by_path.mean()), float(by_path.std() / np.sqrt(by_path.size)))
    return found
