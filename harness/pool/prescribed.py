"""From draws of a campaign to the episodes that the world runs: initial states, and what LV and BV do."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from harness.arrays import IntArray, RecordArray
from harness.campaign.models import Campaign
from harness.episode.cells import PrescribedTraffic
from harness.pool.cut_ins import Pool
from harness.pool.shells import Draws, acceleration_limit, design_shells, shells_in_strata
from harness.strata import ShellDesign


@dataclass(frozen=True)
class Draw:
    """Consecutive draws from one stratum."""

    stratum: int
    first: int
    n: int


class PrescribedEpisodes:
    """The tests of a shells campaign.

    Parameters
    ----------
    campaign : Campaign
    pool : Pool

    Attributes
    ----------
    design : ShellDesign
    draws : Draws
    """

    def __init__(self, campaign: Campaign, pool: Pool) -> None:
        limit = acceleration_limit(campaign.av)
        self._pool = pool
        design = design_shells(pool, boundary=campaign.testing.shells.boundary, limit_mps2=limit)
        self.draws = Draws(pool, shells_in_strata(pool, pool.names.index(design.boundary), limit), campaign.seed)
        self.design: ShellDesign = replace(design, available=tuple(self.draws.available.tolist()))

    def rows(self, draws: tuple[Draw, ...]) -> tuple[IntArray, IntArray]:
        """Rows of the pool's cut-ins, and their strata, shape (n,) each."""
        rows = [self.draws.take(draw.stratum, draw.first, draw.n) for draw in draws]
        return np.concatenate(rows), np.repeat([draw.stratum for draw in draws], [draw.n for draw in draws])

    def episodes(self, draws: tuple[Draw, ...]) -> tuple[RecordArray, PrescribedTraffic, IntArray]:
        """Initial states (n,), traffic, and rows of the pool's cut-ins (n,)."""
        rows, stratum = self.rows(draws)
        return (*self.of_rows(rows, stratum), rows)

    def of_rows(self, rows: IntArray, stratum: IntArray) -> tuple[RecordArray, PrescribedTraffic]:
        """Initial states (n,) and traffic of given cut-ins of the pool (n,), tested for given strata (n,)."""
        c = self._pool.cut_ins
        traffic = PrescribedTraffic(
            lv=np.ascontiguousarray(c.lv[rows]),
            bv=np.ascontiguousarray(c.bv[rows]),
            cut_step=c.step[rows],
            component=stratum.astype(np.int64),
            log_weight=np.log(self.design.p[stratum]),
        )
        return c.state[rows], traffic
