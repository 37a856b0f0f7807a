"""Which cut-ins two vehicles are compared on next, and when the difference is known well enough.

Rounds are those of one vehicle (`harness.runner.planner`), with pairs in place of tests; within a round pairs go to
where the likelihood ratio says that one more narrows the interval of the difference most.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from harness.arrays import IntArray
from harness.campaign.models import Campaign
from harness.estimators.decision import Decision
from harness.estimators.likelihood_search import Level
from harness.estimators.pairs import PairCounts, Verdict
from harness.estimators.stratified import Tally
from harness.runner.allocation import CONFIDENCE, Allocation, first_tests
from harness.runner.planner import POOL_SHARE
from harness.strata import ASSUMPTION_FREE, ShellDesign

LOOKS = 6
"""A margin is decided at a level that leaves out so many times less than the campaign's, as it is looked at after each
round. Measured where B's rate is 1 + margin times A's, by looks from 40 to 3,000 pairs: docs/compare.md."""


def decision_level(confidence: float) -> Level:
    """Level at which a margin is decided, by looks after every round."""
    return Level.two_sided(1.0 - (1.0 - confidence) / LOOKS)


class PairRule:
    """Looks after each round at the difference, or whether B is worse than A by more than a margin.

    Attributes
    ----------
    verdict : {"proven", "refuted", "open"} or None
        Whether B's rate is at most 1 + margin times A's; None without a margin.
    conditional : bool
        Whether only what lies within the boundary is looked at.
    of_first_tests, reached, rhw, heaviest, waited_for, pool_error_above_target
        See `harness.runner.planner.RoundRule`; ``rhw`` is that of the difference over the larger rate.
    """

    decision: Decision | None = None  # it is a margin that comparisons decide

    def __init__(self, campaign: Campaign, margin: float | None) -> None:
        self._target, self._margin = campaign.stop.rhw, margin
        self._min_crashes = campaign.min_crashes
        self._level = Level.two_sided(campaign.stop.confidence)
        self._decision = decision_level(campaign.stop.confidence)
        self._statement = campaign.testing.shells.statement
        self.conditional = self._statement != ASSUMPTION_FREE
        self.reached = self.pool_error_above_target = self.of_first_tests = False
        self.rhw, self.heaviest = math.inf, 0.0
        self.waited_for: tuple[str, ...] = ()
        self.verdict: Verdict | None = None if margin is None else "open"

    def observe(self, pairs: PairCounts) -> bool:
        """Whether to stop at the end of a round."""
        inside = {each.name: each.n_inside for each in pairs.design.statements}
        watched = pairs.inside(inside[self._statement]) if self.conditional else pairs
        self.rhw = watched.rhw(self._level)
        if self._margin is not None:
            return self._decide(watched, self._margin)
        if self._target is None:
            return False
        met = {
            f"stop.rhw ({self._target:g}, of the difference)": self.rhw <= self._target,
            f"stop.min_crashes ({self._min_crashes:,})": pairs.n_crashes >= self._min_crashes,
            "the first tests of each shell (testing.shells.first_tests)": not self.of_first_tests,
        }
        missing = tuple(condition for condition, is_met in met.items() if not is_met)
        self.waited_for = missing or self.waited_for
        self.reached = not missing
        return self.reached or self._is_hopeless(watched, self._target)

    def _decide(self, watched: PairCounts, margin: float) -> bool:
        self.verdict = watched.verdict(margin, self._decision)
        self.reached = self.verdict != "open"
        self.waited_for = (f"--margin ({margin:g})",)
        return self.reached

    def _is_hopeless(self, watched: PairCounts, target: float) -> bool:
        """Whether the pool's own error, which no test narrows, is too large for the asked precision."""
        pool = watched.rhw_from_pool(self._level)
        self.pool_error_above_target = pool > target
        return self.pool_error_above_target and pool**2 >= POOL_SHARE * self.rhw**2


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
