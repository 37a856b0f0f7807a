"""Shells as strata of a test campaign: which cut-ins belong together, their probability, and the tests drawn from them.

Shells up to the boundary are strata of their own. All beyond it is one stratum, *outside*: what a careful vehicle is
tested for there is that nothing happens, and dividing a stratum without crashes only costs tests. A shell on which not
even the full-throttle envelope crashes is left out, with crash probability 0, if the vehicle cannot accelerate harder.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from harness.arrays import IntArray, RecordArray
from harness.campaign.models import AutomatedVehicle, BuiltInParameters, Campaign
from harness.episode.cells import PrescribedCutIns, PrescribedTraffic
from harness.errors import CampaignError
from harness.pool.cut_ins import Pool
from harness.strata import FAILED_SHADOWS, OUTSIDE, ShellDesign


def acceleration_limit(av: AutomatedVehicle) -> float:
    """Hardest acceleration (m/s²) that an AV can reach; infinite if nothing in the harness limits it."""
    if isinstance(av.parameters, BuiltInParameters):
        return av.parameters.max_acceleration_mps2
    if av.controller is not None or av.fmu is not None:
        return av.limits.max_acceleration_mps2
    return float("inf")


def require_boundary(name: str, surrogates: tuple[str, ...]) -> None:
    """Refuse a boundary that is none of the surrogates, with a CampaignError."""
    if name not in surrogates:
        raise CampaignError(
            "testing.shells.boundary",
            found=f"'{name}'",
            expected=f"a surrogate of the library: {', '.join(surrogates)}",
            mend="Name one of them, or leave boundary out for the library's own.",
        )


def shells_in_strata(pool: Pool, boundary: int, limit_mps2: float) -> list[list[int]]:
    """Which shells of the pool make up each stratum; empty shells belong to none.

    ``boundary`` is the index of the outermost shell inside, ``limit_mps2`` the vehicle's hardest acceleration.
    """
    present = [s for s in range(pool.shell_p.size) if pool.shell_p[s] > 0.0]
    tested = present if limit_mps2 > pool.library.envelope_mps2 else [s for s in present if s < len(pool.names)]
    inside = [[s] for s in tested if s <= boundary]
    outside = [s for s in tested if s > boundary]
    return [*inside, outside] if outside else inside


def design_shells(pool: Pool, *, boundary: str | None = None, limit_mps2: float) -> ShellDesign:
    """Strata of a campaign; see `acceleration_limit`.

    ``boundary`` is the surrogate up to which strata are inside, the library's by default; CampaignError if the pool
    knows no such surrogate.
    """
    name = boundary or pool.library.boundary
    require_boundary(name, pool.names)
    groups = shells_in_strata(pool, pool.names.index(name), limit_mps2)
    cells = cells_in_strata(pool, groups)
    first = np.unique(cells, return_index=True)[1][-(cells.max() + 1) :]
    n_inside = sum(group[-1] <= pool.names.index(name) for group in groups)
    p = np.asarray(np.bincount(cells[cells >= 0], pool.cell_p[cells >= 0]), np.float64)
    design = ShellDesign(
        pool=pool.key,
        strata=(*(pool.names[group[0]] for group in groups[:n_inside]), *([OUTSIDE] * (len(groups) - n_inside))),
        cell_stratum=tuple(_stratum_of_shell(pool, groups)[pool.cell_shell[first]].tolist()),
        cell_p=p,
        cell_references=tuple(pool.cell_references[first].tolist()),
        references=tuple(pool.library.references),
        reference_rate=pool.reference_rate,
        reference_square=pool.reference_square,
        n_paths=pool.n_paths,
        n_inside=n_inside,
        boundary=name,
        p_cut_in=pool.p_cut_in,
        p_impossible=pool.p_cut_in - float(p.sum()),
        shadow_runs=pool.cut_ins.motion.size > 0,
    )
    return design if pool.p_unknown == 0.0 else _with_failed_shadows(design, pool.p_unknown)


def _with_failed_shadows(design: ShellDesign, p: float) -> ShellDesign:
    """One more stratum, of probability ``p`` at most: as it has no test, it may crash as often as it happens."""
    return replace(
        design,
        strata=(*design.strata, FAILED_SHADOWS),
        cell_stratum=(*design.cell_stratum, len(design.strata)),
        cell_p=np.append(design.cell_p, p),
        cell_references=(*design.cell_references, 0),
    )


def _stratum_of_shell(pool: Pool, groups: list[list[int]]) -> IntArray:
    """Stratum that each shell of the pool belongs to, -1 for none, shape (D + 1,)."""
    stratum = np.full(pool.shell_p.size, -1, np.int64)
    for place, group in enumerate(groups):
        stratum[group] = place
    return stratum


def cells_in_strata(pool: Pool, groups: list[list[int]]) -> IntArray:
    """Cell of a campaign that each cell of the pool belongs to, by stratum and references; -1 for none, shape (C,)."""
    stratum = _stratum_of_shell(pool, groups)[pool.cell_shell]
    kind = np.where(stratum < 0, -1, (stratum << len(pool.library.references)) | pool.cell_references)
    kinds = np.unique(kind[kind >= 0])
    return np.where(kind < 0, -1, np.searchsorted(kinds, kind))


@dataclass(frozen=True)
class Draw:
    """Consecutive draws from one stratum."""

    stratum: int
    first: int
    n: int


class PrescribedEpisodes:
    """The tests of a shells campaign.

    Each stratum's cut-ins are taken in a random order that is fixed by the campaign's seed: within a shell without
    replacement. In a stratum of several shells the shell is drawn first, by its probability; the order ends where a
    shell has no cut-in left.

    Attributes
    ----------
    design : ShellDesign
    """

    def __init__(self, campaign: Campaign, pool: Pool) -> None:
        limit = acceleration_limit(campaign.av)
        design = design_shells(pool, boundary=campaign.testing.shells.boundary, limit_mps2=limit)
        groups = shells_in_strata(pool, pool.names.index(design.boundary), limit)
        self._cut_ins = pool.cut_ins
        self._cells = cells_in_strata(pool, groups)
        self._order = [_order(pool, group, campaign.seed, stratum) for stratum, group in enumerate(groups)]
        self._order += [np.zeros(0, np.int64)] * (len(design.strata) - len(groups))
        self.design = replace(design, available=tuple(order.size for order in self._order))

    @property
    def available(self) -> IntArray:
        """How many draws each stratum allows, shape (S,)."""
        return np.array(self.design.available, np.int64)

    def rows(self, draws: tuple[Draw, ...]) -> tuple[IntArray, IntArray]:
        """Rows of the pool's cut-ins, and their strata, shape (n,) each; IndexError beyond what a stratum allows."""
        for draw in draws:
            allowed, asked = self.design.available[draw.stratum], draw.first + draw.n
            if asked > allowed:
                raise IndexError(f"stratum {draw.stratum} allows {allowed} draws, {asked} were asked for")
        rows = [self._order[draw.stratum][draw.first : draw.first + draw.n] for draw in draws]
        return np.concatenate(rows), np.repeat([draw.stratum for draw in draws], [draw.n for draw in draws])

    def episodes(self, draws: tuple[Draw, ...]) -> tuple[RecordArray, PrescribedTraffic, PrescribedCutIns]:
        """Initial states (n,), traffic, and which cut-ins they are."""
        rows, stratum = self.rows(draws)
        return (*self.of_rows(rows, stratum), self.cut_ins(rows))

    def cut_ins(self, rows: IntArray) -> PrescribedCutIns:
        """What records say of given cut-ins of the pool (n,)."""
        joined = np.eye(len(self.design.cell_stratum) + 1)[self._cells, :-1]  # the last row is for what is not tested
        mass = self._cut_ins.path_mass[rows] @ joined
        return PrescribedCutIns(rows, self._cells[self._cut_ins.cell[rows]], mass)

    def of_rows(self, rows: IntArray, stratum: IntArray) -> tuple[RecordArray, PrescribedTraffic]:
        """Initial states (n,) and traffic of given cut-ins of the pool (n,), tested for given strata (n,)."""
        c = self._cut_ins
        acts = c.motion.size > 0
        traffic = PrescribedTraffic(
            lv=np.ascontiguousarray(c.lv[rows]),
            bv=np.ascontiguousarray(c.bv[rows]),
            cut_step=c.step[rows],
            stratum=stratum.astype(np.int64),
            log_weight=np.log(self.design.p[stratum]),
            told=c.row[rows] if acts else np.zeros(0, np.int64),
            motion=c.motion[rows] if acts else c.motion,
        )
        return c.state[rows], traffic


def _order(pool: Pool, group: list[int], seed: int, stratum: int) -> IntArray:
    """Rows of the pool's cut-ins in the order in which a stratum, made of a group of shells, takes them."""
    rng = np.random.Generator(np.random.Philox(key=np.array([seed, stratum], np.uint64)))
    rows = [rng.permutation(np.flatnonzero(pool.shell == s)) for s in group]
    if len(rows) == 1:
        return rows[0]
    p = pool.shell_p[group]
    which = np.minimum(
        np.searchsorted(np.cumsum(p) / p.sum(), rng.random(sum(map(len, rows))), side="right"), len(rows) - 1
    )
    order, end = np.zeros(which.size, np.int64), which.size
    for s, members in enumerate(rows):
        chosen = np.flatnonzero(which == s)
        order[chosen[: members.size]] = members[: chosen.size]
        if chosen.size > members.size:
            end = min(end, int(chosen[members.size]))
    return order[:end]
