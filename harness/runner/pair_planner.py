"""Which cut-ins two vehicles are compared on next.

Rounds are those of one vehicle (`harness.runner.planner`), with pairs in place of tests; within a round pairs go to
where the likelihood ratio says that one more narrows the interval of the difference most.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from harness.arrays import IntArray
from harness.campaign.models import Campaign
from harness.estimators.limit_search import Level
from harness.estimators.pairs import PairCounts
from harness.estimators.round_stopping import PairRule
from harness.estimators.stratified import Tally
from harness.runner.allocation import CONFIDENCE, Allocation, first_tests
from harness.strata import ShellDesign


class PairPlanner:
    """Says which pairs are driven next, from counts alone.

    Parameters
    ----------
    campaign : Campaign
        Of either vehicle: both are equal but for the vehicle.
    design : ShellDesign
    available : ndarray of int64, shape (S,)
        Most pairs of each stratum.
    margin : float, optional
        See `PairRule`.
    """

    def __init__(self, campaign: Campaign, design: ShellDesign, available: IntArray, margin: float | None) -> None:
        shells = campaign.testing.shells
        self.rule = PairRule(campaign, margin)
        self._budget, self._first_tests = campaign.stop.episodes, first_tests(design, shells.first_tests)
        self._allocation = Allocation(design, self._first_tests, available, shells.statement, shells.smallest_round)
        self._level = Level.two_sided(CONFIDENCE)

    def next_round(self, pairs: PairCounts) -> IntArray:
        """Pairs to add per stratum, shape (S,); all 0 when no stratum or no budget is left."""
        tests = pairs.tests
        added = self._allocation.next_round(
            _differing(pairs),
            self._budget - int(tests.sum()),
            inner_rhw=lambda n: pairs.inside(n).rhw(self._level),
            given_by=partial(pairs.spread, self._level),
        )
        self.rule.of_first_tests = bool(np.any((tests < self._first_tests)[added > 0]))
        return added


def _differing(pairs: PairCounts) -> Tally:
    """Pairs of which one vehicle has crashed and the other has not, in the crashes' place."""
    differing = pairs.outcomes()[:, 1:3].sum(1)
    may_differ = np.maximum(pairs.tally(0).failed, pairs.tally(1).failed)
    no_mass = np.zeros((differing.size, differing.size))
    return Tally(pairs.tests, differing, np.minimum(may_differ, pairs.tests - differing), no_mass, no_mass)
