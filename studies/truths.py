"""What replications are judged by: crash rates, their ratios and differences, from paths that no pool has.

All are means over paths, or ratios of two of them, so that each has a standard error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from harness.progress import Progress
from harness.traffic.laws import Environment
from harness.vocabulary import FloatArray
from studies.super_population import Drivers, SuperPopulation, enumerate_paths

LARGEST_ERROR = 0.005
"""Standard error of a crash rate, over the rate, that a truth should have at most."""
MORE_PATHS = 3
RATE, DIFFERENCE, CONDITIONAL_DIFFERENCE = "rate", "difference", "difference, conditional"


def ratio_to(reference: str) -> str:
    """Name of the ratio of a vehicle's crash rate to a reference driver's."""
    return f"ratio to {reference}"


def preventable_by(reference: str) -> str:
    """Name of the share of a vehicle's crashes that a reference driver would have avoided."""
    return f"preventable by {reference}"


@dataclass(frozen=True)
class Known:
    """A true value, its standard error, and what deviations from it are to be seen beside.

    That is the value itself, but 1 for a share, and the larger of the two rates for a difference: both may be 0.
    """

    value: float
    std_error: float
    scale: float

    @property
    def relative_error(self) -> float:
        """Standard error over the scale; infinite at scale 0."""
        return self.std_error / self.scale if self.scale > 0.0 else float("inf")


def mean_of(by_path: FloatArray, scale: float | None = None) -> Known:
    """Mean of a number that each path has (n,)."""
    mean = float(by_path.mean())
    return Known(mean, float(by_path.std() / np.sqrt(by_path.size)), mean if scale is None else scale)


def ratio_of(above: FloatArray, below: FloatArray, scale: float | None = None) -> Known:
    """Ratio of the means of two numbers that each path has (n,), with the error of the delta method."""
    mean = float(below.mean())
    ratio = float(above.mean()) / mean if mean > 0.0 else float("nan")
    error = float((above - ratio * below).std() / np.sqrt(below.size)) / mean if mean > 0.0 else float("nan")
    return Known(ratio, error, ratio if scale is None else scale)


def of_vehicle(population: SuperPopulation, crashing: FloatArray, references: Mapping[str, int]) -> dict[str, Known]:
    """Everything about a vehicle by its mass of crashes (m,), beside reference drivers."""
    own = population.by_path(crashing)
    found = {RATE: mean_of(own)}
    for name, driver in references.items():
        crashes_too = population.crashes(driver)
        found[ratio_to(name)] = ratio_of(own, population.by_path(population.mass * crashes_too))
        found[preventable_by(name)] = ratio_of(population.by_path(crashing * ~crashes_too), own, 1.0)
    return found


def of_pair(population: SuperPopulation, a: FloatArray, b: FloatArray) -> dict[str, Known]:
    """How much more often one vehicle crashes than another, by their masses of crashes (m,); both statements' truth."""
    by_path = population.by_path(a - b)
    difference = mean_of(by_path, max(float(x.sum()) for x in (a, b)) / population.n_paths)
    return {DIFFERENCE: difference, CONDITIONAL_DIFFERENCE: difference}


class Truths:
    """Paths that vehicles' truths are from: aimed at all drivers, and again at some that these leave imprecise.

    Those mostly crash in quite other places than the rest. They are enumerated again with more paths, aimed at them
    alone, and at vehicles that they are to be seen ``beside``.
    """

    def __init__(
        self,
        environment: Environment,
        drivers: Drivers,
        seed: int,
        n_paths: int,
        progress: Progress,
        beside: Mapping[str, set[str]] | None = None,
    ) -> None:
        population = enumerate_paths(environment, drivers, seed, n_paths, progress)
        self._enumerated = [(drivers, population)]
        imprecise = {name for name in drivers.vehicles if self.vehicle(name)[RATE].relative_error > LARGEST_ERROR}
        if imprecise:
            again = drivers.only(imprecise.union(*((beside or {}).get(name, set()) for name in imprecise)))
            population = enumerate_paths(environment, again, seed + 1, MORE_PATHS * n_paths, progress)
            self._enumerated.insert(0, (again, population))

    def vehicle(self, name: str) -> dict[str, Known]:
        """Everything about one vehicle."""
        drivers, population, (crashing,) = self._where(name)
        return of_vehicle(population, crashing, drivers.references)

    def pair(self, a: str, b: str) -> dict[str, Known]:
        """Everything about two vehicles."""
        _, population, crashing = self._where(a, b)
        return of_pair(population, *crashing)

    def _where(self, *names: str) -> tuple[Drivers, SuperPopulation, list[FloatArray]]:
        """The most precise paths that have all of them, and their masses of crashes."""
        drivers, population = next(found for found in self._enumerated if set(names) <= set(found[0].vehicles))
        return drivers, population, [drivers.vehicles[name].crash_mass(population) for name in names]
