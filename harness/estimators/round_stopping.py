"""When rounds are enough: of tests drawn from shells, or of pairs of tests of two vehicles.

A rule looks after each round, and once is enough; tests that are known beforehand are looked at by
`harness.estimators.stopping`. That limits hold at a fixed number of tests says nothing about the number at which a rule
stops: that intervals cover there, and how far rates are biased, is measured (docs/estimators.md, docs/compare.md).
"""

from __future__ import annotations

import math

from harness.campaign.models import Campaign
from harness.estimators.decision import Decision
from harness.estimators.limit_search import Level
from harness.estimators.pairs import PairCounts, Verdict
from harness.estimators.shells import Shells
from harness.estimators.stratified import Limits
from harness.strata import ASSUMPTION_FREE

POOL_SHARE = 0.5
"""Share of the squared width from the pool's own error above which more tests hardly narrow an interval."""
LOOKS = 6
"""A margin is decided at a level that leaves out so many times less than the campaign's, as it is looked at after each
round. Measured where B's rate is 1 + margin times A's, by looks from 40 to 3,000 pairs: docs/compare.md."""


class RoundRule:
    """Looks after each round, and is content with one pass.

    That limits within shells hold at a fixed number of tests says nothing about the number at which a rule stops;
    that intervals cover there, and how far the rate is biased, is measured (docs/estimators.md).

    Parameters
    ----------
    campaign : Campaign
    held : int
        Tests that the run folder holds: before them nothing is given up, whatever precision is asked for now.
    factor : float
        By which the precision is wider than the one that the campaign asks for.

    Attributes
    ----------
    decision : Decision or None
        What is known about the limit that the campaign asks about, if it does; that, not a precision, is then waited
        for.
    of_first_tests : bool
        Whether the round brings the tests that every shell gets before anything is decided about it.
    reached, rhw, heaviest, waited_for, pool_error_above_target
        See `StopRule`.
    """

    def __init__(self, campaign: Campaign, held: int = 0, factor: float = 1.0) -> None:
        self._held = held
        self._target = None if campaign.stop.rhw is None else factor * campaign.stop.rhw
        self._min_crashes, self._confidence = campaign.min_crashes, campaign.stop.confidence
        self._statement, self._accept = campaign.testing.shells.statement, campaign.accept
        self.decision: Decision | None = None
        self.reached = self.pool_error_above_target = False
        self.rhw = float("inf")
        self.heaviest = 0.0  # limits within shells allow for every crash that has not been seen
        self.of_first_tests = False
        self.waited_for: tuple[str, ...] = ()

    def observe(self, seen: Shells) -> bool:
        """Whether to stop at the end of a round, with all tests so far."""
        watched, n_crashes = seen.limits_of(self._statement, self._confidence), int(seen.tally.crashes.sum())
        self.rhw, from_pool = watched.rhw, watched.from_pool_relative()
        if self._accept is not None:
            return self._decide(watched, self._accept.crash_rate_below, contradicted=seen.contradicts(self._statement))
        if self._target is None:
            return False
        met = {
            f"stop.rhw ({self._target:g})": self.rhw <= self._target,
            f"stop.min_crashes ({self._min_crashes:,})": n_crashes >= self._min_crashes,
        }
        missing = tuple(condition for condition, is_met in met.items() if not is_met)
        if missing:
            self.waited_for = missing
        elif self.of_first_tests:
            self.waited_for = ("the first tests of each shell (testing.shells.first_tests)",)
        if n_crashes < self._min_crashes:
            return False
        self.reached = not missing
        self.pool_error_above_target = from_pool["rhw_from_pool_at_least"] > self._target
        hopeless = self.pool_error_above_target and from_pool["rhw_from_pool"] ** 2 >= POOL_SHARE * self.rhw**2
        return self.reached or (hopeless and seen.tally.tests.sum() >= self._held)

    def _decide(self, watched: Limits, limit: float, *, contradicted: bool) -> bool:
        one_sided = (1.0 + self._confidence) / 2.0
        self.decision = Decision(limit, self._statement, one_sided, watched.low, watched.high, contradicted)
        self.reached = self.decision.verdict != "undecided"
        self.waited_for = (f"accept.crash_rate_below ({limit:g})",)
        return self.decision.is_final


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
        See `RoundRule`; ``rhw`` is that of the difference over the larger rate.
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
