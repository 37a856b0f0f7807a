"""Pools of overtaking drawn anew: the strata that a campaign would see, and the share of crashes in each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from harness.arrays import FloatArray, IntArray
from harness.campaign.models import AutomatedVehicle
from harness.campaign.testing import ShellSettings
from harness.errors import CampaignError
from harness.pool.cut_ins import CutIns, Pool, shells_of
from harness.pool.library import Library
from harness.pool.shells import acceleration_limit, design_shells, outermost, shells_in_strata
from harness.studies.experiment import Adversary
from harness.studies.shell_campaign import DrawnPool
from harness.studies.super_population import Mixed, SuperPopulation

EQUAL_RATE = 0.02
"""A surrogate whose crash rate is this close to the vehicle's counts as its equal."""


@dataclass(frozen=True, eq=False)
class OvertakingShells:
    """Pools of one vehicle, with its equals left out of the library; see `harness.studies.shell_campaign.ShellSource`.

    Attributes
    ----------
    template : Pool
        Pool without cut-ins, whose probabilities each draw replaces.
    left_out : tuple of str
        The vehicle's equals.
    limit_mps2 : float
        Hardest acceleration of the vehicle.
    failing : float
        Share of its crashes that end as failed tests.
    shells, crashing : ndarray, shape (n, D + 1)
        Probability of each shell by path of the super-population, and the part on which the vehicle crashes.
    """

    template: Pool
    left_out: tuple[str, ...]
    limit_mps2: float
    shells: FloatArray
    crashing: FloatArray
    failing: float = 0.0

    @property
    def crash_rate(self) -> float:
        """That of the super-population."""
        return float(self.crashing.sum() / len(self.crashing))

    @property
    def crashes_outside(self) -> dict[str, float]:
        """Share of the vehicle's crash rate that lies beyond the boundary of each statement."""
        by_shell, names = self.crashing.sum(0), self.template.names
        inside = {
            name: np.isin(np.arange(by_shell.size), range(names.index(each.boundary) + 1))
            for name, each in self.template.library.statement_settings(ShellSettings()).items()
        }
        return {name: float(by_shell[~within].sum() / by_shell.sum()) for name, within in inside.items()}

    def draw(self, rng: np.random.Generator) -> DrawnPool:
        """A new pool."""
        rows = rng.integers(0, len(self.shells), self.template.n_paths)
        drawn = self.shells[rows]
        pool = replace(self.template, cell_p=drawn.mean(0), p_cut_in=float(drawn.sum(1).mean()))
        design = design_shells(pool, limit_mps2=self.limit_mps2)
        groups = shells_in_strata(pool, outermost(pool, ShellSettings()), self.limit_mps2)

        def by_stratum(by_shell: FloatArray) -> FloatArray:
            return np.column_stack([by_shell[:, group].sum(1) for group in groups])

        return DrawnPool(design, by_stratum(drawn), by_stratum(self.crashing[rows]), self.failing)

    def as_adversary(self, made: Adversary) -> OvertakingShells:
        """The same vehicle with other crashes; see `harness.studies.experiment.Adversary`."""
        inside, crashing = outermost(self.template, ShellSettings()) + 1, self.crashing.copy()
        if made.crashes != "everywhere":
            weight = crashing[:, :inside].sum(1)
            order = np.argsort(-weight if made.crashes == "on_heaviest_paths" else weight, kind="stable")
            kept = np.cumsum(weight[order]) <= made.share * weight.sum()
            crashing[order[~kept]] = 0.0
        tested = slice(inside, -1)  # the last shell is for cut-ins on which nobody crashes
        crashing[:, tested] = np.maximum(crashing[:, tested], made.hole * self.shells[:, tested])
        return replace(self, crashing=crashing, failing=made.failing)


def equals(library: Library, population: SuperPopulation, crashing: FloatArray) -> set[str]:
    """Surrogates that crash on the same cut-ins as a vehicle (its mass of them, shape (m,)), or nearly as often."""
    rate = crashing.sum()
    found = set()
    for driver, name in enumerate(library.surrogates):
        mass = population.mass * population.crashes(driver)
        if abs(mass.sum() / rate - 1.0) <= EQUAL_RATE or np.array_equal(mass, crashing):
            found.add(name)
    return found


def leave_out(library: Library, names: set[str], careful_first: tuple[str, ...]) -> Library:
    """The library without a vehicle's equals; the envelope stays, and another surrogate takes over as boundary.

    That is the next more careful one that is left, or the next more careless one if none is.

    Parameters
    ----------
    library : Library
    names : set of str
        What to leave out.
    careful_first : tuple of str
        All surrogates, from careful to careless.

    Raises
    ------
    CampaignError
        No surrogate is left but the envelope.
    """
    names = names - {library.envelope}
    if library.boundary in names:
        place = careful_first.index(library.boundary)
        candidates = [*reversed(careful_first[:place]), *careful_first[place + 1 :]]
        left = [name for name in candidates if name not in names and name != library.envelope]
        if not left:
            raise CampaignError(
                "campaign.pool.library",
                found=f"no surrogate but the envelope, without the vehicle's equals ({', '.join(sorted(names))})",
                expected="one that can be the boundary",
                mend="Add a surrogate to the library, or leave this vehicle out of the experiment.",
            )
        library = library.model_copy(update={"boundary": left[0]})
    return library.without(names)


def overtaking_shells(
    library: Library, population: SuperPopulation, av: AutomatedVehicle, vehicle: Mixed, pool_paths: int
) -> OvertakingShells:
    """Source of a vehicle's pools; the library's drivers are the first of the population's."""
    crashing = vehicle.crash_mass(population)
    pools, by_shell = _pools(library, population, [crashing], acceleration_limit(av), pool_paths)
    return replace(pools, crashing=by_shell(crashing))


def _pools(
    library: Library, population: SuperPopulation, crashing: list[FloatArray], limit_mps2: float, pool_paths: int
) -> tuple[OvertakingShells, Callable[[FloatArray], FloatArray]]:
    """Pools without the vehicles' equals, and what divides a mass of cut-ins (m,) by path and shell (n, D + 1)."""
    bit = {name: driver for driver, name in enumerate(library.surrogates)}
    rate = {name: float(population.mass[population.crashes(driver)].sum()) for name, driver in bit.items()}
    careful_first = tuple(sorted(bit, key=rate.__getitem__))
    alike = set().union(*(equals(library, population, of_vehicle) for of_vehicle in crashing))
    reduced = leave_out(library, alike, careful_first)
    names = tuple(name for name in careful_first if name in reduced.surrogates)
    shell = shells_of(population.bits, np.array([bit[name] for name in names]))

    def by_shell(mass: FloatArray) -> FloatArray:
        return np.column_stack([population.by_path(mass * (shell == s)) for s in range(len(names) + 1)])

    shells = by_shell(population.mass)
    shells[:, -1] = np.maximum(population.cut_in - shells[:, :-1].sum(1), 0.0)
    left_out = tuple(name for name in careful_first if name not in reduced.surrogates)
    template = _template(reduced, names, shells, pool_paths)
    return OvertakingShells(template, left_out, limit_mps2, shells, np.zeros_like(shells)), by_shell


def _template(library: Library, names: tuple[str, ...], shells: FloatArray, n_paths: int) -> Pool:
    d = len(names)
    none: IntArray = np.zeros(0, np.int64)
    no_draws = np.zeros((0, 0), np.int8)
    return Pool(
        key="drawn",
        environment="drawn",
        library=library.model_copy(update={"references": {}}),
        names=names,
        n_paths=n_paths,
        p_cut_in=float(shells.sum(1).mean()),
        p_cut_in_se=0.0,
        mu=np.zeros(d),
        mu_covariance=np.zeros((d, d)),
        cell_shell=np.arange(d + 1),
        cell_references=np.zeros(d + 1, np.int64),
        cell_p=shells.mean(0),
        reference_rate=np.zeros(0),
        reference_square=np.zeros(0),
        cut_ins=CutIns(
            path=none,
            step=none,
            cell=none,
            state=np.zeros((0, 5)),
            lv=no_draws,
            bv=no_draws,
            n_lv=none,
            n_bv=none,
            crashes=np.zeros((0, d), np.bool_),
            path_mass=np.zeros((0, d + 1), np.float32),
        ),
    )
