"""One comparison of two vehicles on a drawn pool: allocation, rounds, stop rule and limits are those of a real one.

As in `harness.studies.shell_campaign` the world is replaced by random numbers, here a multinomial one per stratum and
round.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from harness.arrays import IntArray
from harness.campaign.models import Campaign
from harness.estimators.limit_search import Level
from harness.estimators.pairs import CRASH, NO_CRASH, PairCounts, no_pairs
from harness.estimators.round_stopping import PairRule
from harness.runner.planner import PairPlanner
from harness.strata import LIBRARY_STATEMENT
from harness.studies.experiment import Fault
from harness.studies.judgement import Row
from harness.studies.shell_campaign import DrawnPool, asking, with_fault
from harness.studies.truths import CONDITIONAL_DIFFERENCE, DIFFERENCE

_CRASHING = ((CRASH, CRASH), (CRASH, NO_CRASH), (NO_CRASH, CRASH))
"""How A and B end: both crash, only A, only B."""


class PairSource(Protocol):
    """Where the pools of replications come from."""

    def draw(self, rng: np.random.Generator) -> list[DrawnPool]:
        """A new pool without references: where both crash, only A, only B."""
        ...


@dataclass(frozen=True, eq=False)
class PairedCampaign:
    """A comparison to replicate; ``campaign`` is that of either vehicle, ``margin`` see `PairRule`."""

    campaign: Campaign
    source: PairSource
    seed: int
    margin: float | None = None
    fault: Fault | None = None

    def run(self, replications: range) -> list[Row]:
        """Rows of both statements for each replication."""
        return [row for replication in replications for row in self._rows(replication)]

    def _rows(self, replication: int) -> Iterator[Row]:
        inside = PairRule(asking(self.campaign, LIBRARY_STATEMENT), None)
        early: PairCounts | None = None
        for pairs, rule in self.rounds(replication):
            reached = rule.reached
            if early is None:
                inside.observe(pairs)
                early = pairs.inside() if inside.reached else None
        yield self._row(DIFFERENCE, replication, pairs, reached=reached)
        yield self._row(CONDITIONAL_DIFFERENCE, replication, early or pairs.inside(), reached=early is not None)

    def rounds(self, replication: int) -> Iterator[tuple[PairCounts, PairRule]]:
        """All pairs so far after each round of one comparison, until its rule is content."""
        rng = np.random.default_rng([self.seed, replication])
        drawn = [with_fault(pool, self.fault) for pool in self.source.draw(rng)]
        design = drawn[0].design
        available = np.full(design.p.size, self.campaign.pool.cut_ins_per_shell, np.int64)
        planner = PairPlanner(self.campaign, design, available, self.margin)
        pairs = no_pairs(design)
        while (added := planner.next_round(pairs)).any():
            pairs = _with_round(pairs, drawn, added, rng)
            enough = planner.rule.observe(pairs)
            yield pairs, planner.rule
            if enough:
                return

    def _row(self, result: str, replication: int, pairs: PairCounts, *, reached: bool) -> Row:
        level = Level.two_sided(self.campaign.stop.confidence)
        found = pairs.difference(level)
        outside = pairs.ends[pairs.design.library.n_inside :]
        return Row(
            result,
            replication,
            n_tests=int(pairs.tests.sum()),
            n_crashes=pairs.n_differing,
            crash_rate=found.value,
            std_error=found.half_width / level.z,
            ci_low=found.ci_low,
            ci_high=found.ci_high,
            reached=reached,
            n_crashes_outside=int(outside.sum() - outside[:, NO_CRASH, NO_CRASH].sum()),
        )


def _with_round(pairs: PairCounts, drawn: list[DrawnPool], added: IntArray, rng: np.random.Generator) -> PairCounts:
    """The pairs after a round of so many more of each stratum (S,)."""
    share = np.column_stack([pool.share for pool in drawn])
    share = np.column_stack([share, np.maximum(1.0 - share.sum(1), 0.0)])
    counts = rng.multinomial(added, share / share.sum(1, keepdims=True))
    ends, mass = pairs.ends.copy(), pairs.mass.copy()
    ends[:, NO_CRASH, NO_CRASH] += counts[:, -1]
    for kind, pool, of_kind in zip(_CRASHING, drawn, counts.T[:-1], strict=True):
        ends[:, *kind] += of_kind
        mass[:, *kind] += [pool.crashed_paths(s, k, rng).sum(0) for s, k in enumerate(of_kind.tolist())]
    return PairCounts(pairs.design, ends, mass)
