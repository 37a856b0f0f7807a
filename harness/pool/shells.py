"""Shells as strata of a test campaign: which cut-ins belong together, their probability, the order of draws.

Shells up to the boundary are strata of their own. All beyond it is one stratum, *outside*: what a careful vehicle is
tested for there is that nothing happens, and dividing a stratum without crashes only costs tests. A shell on which not
even the full-throttle envelope crashes is left out, with crash probability 0, if the vehicle cannot accelerate harder.
"""

from __future__ import annotations

import numpy as np

from harness.arrays import IntArray
from harness.campaign.models import AutomatedVehicle, BuiltInParameters
from harness.errors import CampaignError
from harness.pool.cut_ins import Pool
from harness.strata import OUTSIDE, ShellDesign


def acceleration_limit(av: AutomatedVehicle) -> float:
    """Hardest acceleration (m/s²) that an AV can reach; infinite if nothing in the harness limits it."""
    if isinstance(av.parameters, BuiltInParameters):
        return av.parameters.max_acceleration_mps2
    if av.controller is not None or av.fmu is not None:
        return av.limits.max_acceleration_mps2
    return float("inf")


def shells_in_strata(pool: Pool, boundary: int, limit_mps2: float) -> list[list[int]]:
    """Which shells of the pool make up each stratum; empty shells belong to none.

    Parameters
    ----------
    pool : Pool
    boundary : int
        Index of the outermost shell inside.
    limit_mps2 : float
        Hardest acceleration of the vehicle.
    """
    present = [s for s in range(pool.shell_p.size) if pool.shell_p[s] > 0.0]
    tested = present if limit_mps2 > pool.library.envelope_mps2 else [s for s in present if s < len(pool.names)]
    inside = [[s] for s in tested if s <= boundary]
    outside = [s for s in tested if s > boundary]
    return [*inside, outside] if outside else inside


def require_boundary(name: str, surrogates: tuple[str, ...]) -> None:
    """Refuse a boundary that is none of the surrogates.

    Raises
    ------
    CampaignError
        There is no such surrogate.
    """
    if name not in surrogates:
        raise CampaignError(
            "testing.shells.boundary",
            found=f"'{name}'",
            expected=f"a surrogate of the library: {', '.join(surrogates)}",
            mend="Name one of them, or leave boundary out for the library's own.",
        )


def design_shells(pool: Pool, *, boundary: str | None = None, limit_mps2: float) -> ShellDesign:
    """Strata of a campaign.

    Parameters
    ----------
    pool : Pool
    boundary : str, optional
        Surrogate up to which strata are inside; the library's by default.
    limit_mps2 : float
        See `acceleration_limit`.

    Raises
    ------
    CampaignError
        The pool knows no such surrogate.
    """
    name = boundary or pool.library.boundary
    require_boundary(name, pool.names)
    groups = shells_in_strata(pool, pool.names.index(name), limit_mps2)
    joined = np.zeros((len(groups), pool.shell_p.size))
    for row, group in enumerate(groups):
        joined[row, group] = 1.0
    n_inside = sum(group[-1] <= pool.names.index(name) for group in groups)
    return ShellDesign(
        pool=pool.key,
        strata=(*(pool.names[group[0]] for group in groups[:n_inside]), *([OUTSIDE] * (len(groups) - n_inside))),
        p=joined @ pool.shell_p,
        moments=joined @ pool.shell_moments @ joined.T,
        n_paths=pool.n_paths,
        n_inside=n_inside,
        boundary=name,
        p_cut_in=pool.p_cut_in,
        p_impossible=pool.p_cut_in - float((joined @ pool.shell_p).sum()),
    )


class Draws:
    """The order in which a campaign takes cut-ins from each stratum: a random one, fixed by its seed.

    Within a shell cut-ins are taken without replacement. In a stratum of several shells the shell is drawn first, by
    its probability; the order ends where a shell has no cut-in left.

    Parameters
    ----------
    pool : Pool
    groups : list of list of int
        Shells of each stratum, see `shells_in_strata`.
    seed : int
        Campaign seed.
    """

    def __init__(self, pool: Pool, groups: list[list[int]], seed: int) -> None:
        self._order = [_order(pool, group, seed, stratum) for stratum, group in enumerate(groups)]

    @property
    def available(self) -> IntArray:
        """How many draws each stratum allows, shape (S,)."""
        return np.array([order.size for order in self._order], np.int64)

    def take(self, stratum: int, first: int, n: int) -> IntArray:
        """Rows of the pool's cut-ins that are draws ``first … first + n - 1`` of a stratum, shape (n,)."""
        rows = self._order[stratum][first : first + n]
        if rows.size < n:
            raise IndexError(f"stratum {stratum} allows {self._order[stratum].size} draws, {first + n} were asked for")
        return rows


def _order(pool: Pool, group: list[int], seed: int, stratum: int) -> IntArray:
    rng = np.random.Generator(np.random.Philox(key=np.array([seed, stratum], np.uint64)))
    rows = [rng.permutation(np.flatnonzero(pool.cut_ins.shell == s)) for s in group]
    if len(rows) == 1:
        return rows[0]
    p = pool.shell_p[group]
    which = np.minimum(
        np.searchsorted(np.cumsum(p) / p.sum(), rng.random(sum(map(len, rows))), side="right"), len(rows) - 1
    )
    rank = np.zeros(which.size, np.int64)
    for s, members in enumerate(rows):
        chosen = which == s
        rank[chosen] = np.arange(chosen.sum())
        rank[chosen & (rank >= len(members))] = -1
    end = int(np.argmax(rank < 0)) if (rank < 0).any() else which.size
    order = np.zeros(end, np.int64)
    for s, members in enumerate(rows):
        chosen = np.flatnonzero(which[:end] == s)
        order[chosen] = members[rank[chosen]]
    return order
