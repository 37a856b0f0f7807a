"""Pools of overtaking drawn anew: the strata that a campaign would see, and the share of crashes in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.campaign.sections import ShellSettings
from harness.errors import CampaignError
from harness.pool.cut_ins import CutIns, Pool, shells_of
from harness.pool.library import Library
from harness.pool.shells import cells_in_strata, design_shells, outermost, shells_in_strata
from harness.strata import ShellDesign
from harness.vocabulary import BoolArray, FloatArray, IntArray
from studies.experiment import Adversary
from studies.shell_campaign import DrawnPool
from studies.super_population import SuperPopulation, reference_drivers

EQUAL_RATE = 0.02
"""A surrogate whose crash rate is this close to the vehicle's counts as its equal."""


@dataclass(frozen=True, eq=False)
class DrawnCells:
    """Cells of a super-population's paths, of which pools are drawn.

    The ``template`` is a pool without cut-ins, whose probabilities each draw replaces; ``left_out`` are surrogates that
    are equals of a vehicle, ``limit_mps2`` is the hardest acceleration of the vehicles, and ``mass`` (n, C) the
    probability of a cut-in of each cell, by path of the super-population.
    """

    template: Pool
    left_out: tuple[str, ...]
    limit_mps2: float
    mass: FloatArray

    def draw(self, rng: np.random.Generator, masses: Sequence[FloatArray]) -> tuple[ShellDesign, list[FloatArray]]:
        """The design of a new pool, and for ``masses`` (n, C) what they are on its paths, by the design's cells."""
        rows = rng.integers(0, len(self.mass), self.template.n_paths)
        drawn = self.mass[rows]
        by_reference = drawn @ self._crash_of_references
        pool = replace(
            self.template,
            cell_p=drawn.mean(0),
            p_cut_in=float(drawn.sum(1).mean()),
            reference_rate=by_reference.mean(0),
            reference_square=(by_reference * by_reference).mean(0),
        )
        design = design_shells(pool, limit_mps2=self.limit_mps2)
        groups = shells_in_strata(pool, outermost(pool, ShellSettings()), self.limit_mps2)
        cells = cells_in_strata(pool, groups)
        tested = np.flatnonzero(cells >= 0)
        joined = np.zeros((tested.size, design.cell_p.size))
        joined[np.arange(tested.size), cells[tested]] = 1.0
        found = [of[rows][:, tested] @ joined if of is not self.mass else drawn[:, tested] @ joined for of in masses]
        return design, found

    @property
    def _crash_of_references(self) -> FloatArray:
        """1 where a reference crashes on a cell's cut-ins, shape (C, R)."""
        references = np.arange(len(self.template.library.references))
        return np.asarray((self.template.cell_references[:, None] >> references) & 1, np.float64)

    def crashes_outside(self, crashing: FloatArray) -> dict[str, float]:
        """Share of a crash mass by cell (n, C) that lies beyond the boundary of each statement; 0 of no crash."""
        by_cell, names = crashing.sum(0), self.template.names
        total = by_cell.sum() or 1.0
        places = {
            name: names.index(each.boundary)
            for name, each in self.template.library.statement_settings(ShellSettings()).items()
        }
        return {name: float(by_cell[self.template.cell_shell > place].sum() / total) for name, place in places.items()}


@dataclass(frozen=True, eq=False)
class OvertakingShells:
    """Pools of a vehicle, or of two.

    ``crashing`` are the parts (n, C) of ``cells.mass`` on which the vehicle crashes, or both of two, only A, only B.
    ``failing`` is the share of crashes that end as failed tests.
    """

    cells: DrawnCells
    crashing: tuple[FloatArray, ...]
    failing: float = 0.0

    def draw(self, rng: np.random.Generator) -> list[DrawnPool]:
        """A new pool; see `studies.shell_campaign.Draw`."""
        design, (mass, *crashing) = self.cells.draw(rng, [self.cells.mass, *self.crashing])
        return [DrawnPool(design, mass, each, self.failing) for each in crashing]


class Division:
    """Cut-ins of a super-population, divided into ``cells`` by a library without the equals of some vehicles."""

    def __init__(
        self,
        library: Library,
        population: SuperPopulation,
        crashing: Sequence[FloatArray],
        pool_paths: int,
        *,
        limit_mps2: float,
        shadow_runs: bool = False,
    ) -> None:
        """Leave out the equals of vehicles that crash on these masses of cut-ins, (m,) each."""
        bit = {name: driver for driver, name in enumerate(library.surrogates)}
        rate = {name: float(population.mass[population.crashes(driver)].sum()) for name, driver in bit.items()}
        careful_first = tuple(sorted(bit, key=rate.__getitem__))
        alike = set().union(*(equals(library, population, of_vehicle) for of_vehicle in crashing))
        reduced = leave_out(library, alike, careful_first)
        names = tuple(name for name in careful_first if name in reduced.surrogates)
        self._population = population
        self._shell = shells_of(population.bits, np.array([bit[name] for name in names])).astype(np.int64)
        references = list(reference_drivers(library).values())
        crash_too = sum(
            (population.crashes(driver).astype(np.int64) << r for r, driver in enumerate(references)),
            start=np.zeros(population.bits.size, np.int64),
        )
        nobody = len(names) << len(references)
        kind = np.append((self._shell << len(references)) | crash_too, nobody)
        kinds, cell = np.unique(kind, return_inverse=True)
        self._cell, self._n_cells = cell[:-1], kinds.size
        mass = self.by_cell(population.mass)
        mass[:, cell[-1]] += np.maximum(population.cut_in - mass.sum(1), 0.0)
        divided = kinds >> len(references), kinds & ((1 << len(references)) - 1)
        template = _template(reduced, names, divided, mass, pool_paths, shadow_runs=shadow_runs)
        left_out = tuple(name for name in careful_first if name not in reduced.surrogates)
        self.cells = DrawnCells(template, left_out, limit_mps2, mass)

    def by_cell(self, mass: FloatArray) -> FloatArray:
        """A mass of cut-ins (m,) by path and cell, (n, C)."""
        place = self._population.path * self._n_cells + self._cell
        summed = np.bincount(place, mass, minlength=self._population.n_paths * self._n_cells)
        return np.asarray(summed, np.float64).reshape(-1, self._n_cells)

    def of_vehicle(self, crashing: FloatArray, failing: float = 0.0) -> OvertakingShells:
        """Pools of a vehicle that crashes on this mass of cut-ins (m,)."""
        return OvertakingShells(self.cells, (self.by_cell(crashing),), failing)

    def of_pair(self, a: FloatArray, b: FloatArray) -> OvertakingShells:
        """Pools of two vehicles that crash on these masses of cut-ins (m,).

        Where either crashes on a share of a cut-in's episodes, by inattention or by what an adversary is made of, the
        two do so independently.
        """
        mass = self._population.mass
        both = a * np.divide(b, mass, out=np.zeros_like(mass), where=mass > 0.0)
        only_a, only_b = (np.maximum(one - both, 0.0) for one in (a, b))
        return OvertakingShells(self.cells, (self.by_cell(both), self.by_cell(only_a), self.by_cell(only_b)))

    def as_adversary(self, made: Adversary, crashing: FloatArray) -> FloatArray:
        """The mass of crashes (m,) of an adversary made of a vehicle; see `studies.experiment.Adversary`."""
        boundary, population = outermost(self.cells.template, ShellSettings()), self._population
        inside: BoolArray = self._shell <= boundary
        if made.crashes != "everywhere":
            weight = population.by_path(crashing * inside)
            order = np.argsort(-weight if made.crashes == "on_heaviest_paths" else weight, kind="stable")
            kept = np.zeros(weight.size, np.bool_)
            kept[order] = np.cumsum(weight[order]) <= made.share * weight.sum()
            crashing = crashing * kept[population.path]
        # Cut-ins on which nobody crashes are no part of a hole either: they are not tested.
        tested = ~inside & (self._shell < len(self.cells.template.names))
        return np.where(tested, np.maximum(crashing, made.hole * population.mass), crashing)


def equals(library: Library, population: SuperPopulation, crashing: FloatArray) -> set[str]:
    """Surrogates that crash on the same cut-ins as a vehicle (its mass of them, shape (m,)), or nearly as often."""
    rate = crashing.sum()
    found = set()
    for driver, name in enumerate(library.surrogates):
        mass = population.mass * population.crashes(driver)
        if abs(mass.sum() - rate) <= EQUAL_RATE * rate or np.array_equal(mass, crashing):
            found.add(name)
    return found


def leave_out(library: Library, names: set[str], careful_first: tuple[str, ...]) -> Library:
    """The library without a vehicle's equals; the envelope stays, and another surrogate takes over as boundary.

    That is the next more careful one that is left, or the next more careless one if none is; ``careful_first`` are all
    surrogates.

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
            found = f"no surrogate but the envelope, without the vehicle's equals ({', '.join(sorted(names))})"
            mend = "Add a surrogate to the library, or leave this vehicle out of the experiment."
            raise CampaignError("campaign.pool.library", found, "one that can be the boundary", mend)
        library = library.model_copy(update={"boundary": left[0]})
    return library.without(names)


def _template(
    library: Library,
    names: tuple[str, ...],
    kind: tuple[IntArray, IntArray],
    mass: FloatArray,
    n_paths: int,
    *,
    shadow_runs: bool,
) -> Pool:
    """Pool without cut-ins; ``kind`` are shell and references of each cell, ``mass`` is (n, C)."""
    d, r = len(names), len(library.references)
    none: IntArray = np.zeros(0, np.int64)
    no_draws = np.zeros((0, 0), np.int8)
    return Pool(
        key="drawn",
        environment="drawn",
        library=library,
        names=names,
        n_paths=n_paths,
        p_cut_in=float(mass.sum(1).mean()),
        p_cut_in_se=0.0,
        mu=np.zeros(d),
        mu_covariance=np.zeros((d, d)),
        p_cut_in_at_crash=np.ones(d),
        cell_shell=kind[0],
        cell_references=kind[1],
        cell_p=mass.mean(0),
        reference_rate=np.zeros(r),
        reference_square=np.zeros(r),
        cut_ins=CutIns(
            path=none,
            step=none,
            cell=none,
            state=np.zeros((0, 5)),
            lv=no_draws,
            bv=no_draws,
            n_lv=none,
            n_bv=none,
            crashes=np.zeros((0, d + r), np.bool_),
            lead=none,
            path_mass=np.zeros((0, kind[0].size), np.float32),
            motion=np.zeros(int(shadow_runs), np.uint64),
        ),
    )
