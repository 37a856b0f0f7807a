"""Which tests of several families are next: as within one, with the strata of all side by side, by crashes per hour.

The next test goes where it narrows the rate of the sum most. Where each family's own rate is asked for, it is the one
that is known worst.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.campaign.campaign import Campaign
from harness.estimators.per_hour import PerHour
from harness.estimators.stopping import HourRule
from harness.sampling.allocation import LEVEL, Allocation, Joined
from harness.vocabulary import IntArray


class HourRounds:
    """Says which tests of each family are driven next, from counts alone.

    ``available`` (S,) of each are the most tests of its strata; ``rule`` looks at each round.
    """

    def __init__(self, campaign: Campaign, hour: PerHour, available: Sequence[IntArray], rule: HourRule) -> None:
        self.rule, self._budget, self._each = rule, campaign.stop.episodes, campaign.stop.each_family
        shells, designs = campaign.testing.shells, [of.seen.design for of in hour.families]
        self._own = [Allocation.of(shells, *each) for each in zip(designs, available, strict=True)]
        self._all = Joined(shells, designs, np.concatenate([of.p for of in hour.families]), available)

    def next_round(self, hour: PerHour) -> list[IntArray]:
        """Tests to add per stratum of each family; all 0 when no stratum or no budget is left."""
        tallies = [of.tally for of in hour.families]
        left = self._budget - hour.totals[0]
        if self._each and all(tally.tests.any() for tally in tallies):
            worst = int(np.argmax([of.limits(LEVEL).rhw for of in hour.families]))
            of_each = [np.zeros_like(tally.tests) for tally in tallies]
            of_each[worst] = self._own[worst].next_round(tallies[worst], left)
            return of_each
        columns = [np.concatenate(column) for column in zip(*(each[:3] for each in tallies), strict=True)]
        added, first = self._all.next_round(columns, left, lambda: hour.limits(LEVEL, inside=True).rhw)
        self.rule.of_first_tests = first
        return added
