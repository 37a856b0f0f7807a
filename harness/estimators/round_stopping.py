"""When rounds are enough: of tests drawn from shells, or of pairs of tests of two vehicles.

A rule looks after each round, and once is enough; tests that are known beforehand are looked at by
`harness.estimators.stopping`. That limits hold at a fixed number of tests says nothing about the number at which a rule
stops: that intervals cover there, and how far rates are biased, is measured (docs/estimators.md, docs/compare.md).
"""

from __future__ import annotations

from harness.campaign.campaign import Campaign
from harness.estimators.limit_search import Level
from harness.estimators.pairs import PairCounts, Verdict
from harness.estimators.shells import Shells
from harness.estimators.stopping import Decision, Rule, missing
from harness.estimators.stratified import Limits
from harness.strata import ASSUMPTION_FREE

FIRST_TESTS = "the first tests of each shell (testing.shells.first_tests)"
POOL_SHARE = 0.5
"""Share of the squared width from the pool's own error above which more tests hardly narrow an interval."""
LOOKS = 6
"""A margin is decided at a level that leaves out so many times less than the campaign's, as it is looked at after each
round. Measured where B's rate is 1 + margin times A's, by looks from 40 to 3,000 pairs: docs/compare.md."""


class _AfterRounds(Rule):
    """Looks after each round, and is content with one pass.

    ``of_first_tests`` says whether the round brings the tests that every shell gets before anything is decided of it.
    """

    of_first_tests = False

    def _is_hopeless(self, target: float, pool: float, at_least: float) -> bool:
        """Whether the pool's own error, as seen and at least, is too large, and nearly all that is left."""
        self.pool_error_above_target = at_least > target
        return self.pool_error_above_target and pool**2 >= POOL_SHARE * self.rhw**2


class RoundRule(_AfterRounds):
    """Looks at a crash rate, or whether it is below a limit.

    Parameters
    ----------
    campaign : Campaign
    held : int
        Tests that the run folder holds: before them nothing is given up, whatever precision is asked for now.
    factor : float
        By which the precision is wider than the one that the campaign asks for.
    """

    def __init__(self, campaign: Campaign, held: int = 0, factor: float = 1.0) -> None:
        rhw = campaign.stop.rhw
        super().__init__(None if rhw is None else factor * rhw, campaign.min_crashes)
        self._held, self._confidence = held, campaign.stop.confidence
        self._statement, self._accept = campaign.testing.shells.statement, campaign.accept

    def observe(self, seen: Shells) -> bool:
        """Whether to stop at the end of a round, with all tests so far."""
        watched, n_crashes = seen.limits_of(self._statement, self._confidence), int(seen.tally.crashes.sum())
        self.rhw = watched.rhw
        if self._accept is not None:
            return self._decide(watched, self._accept.crash_rate_below, contradicted=seen.contradicts(self._statement))
        if self._target is None:
            return False
        found = missing(
            {
                f"stop.rhw ({self._target:g})": self.rhw <= self._target,
                f"stop.min_crashes ({self._min_crashes:,})": n_crashes >= self._min_crashes,
            }
        )
        if found or self.of_first_tests:
            self.waited_for = found or (FIRST_TESTS,)
        if n_crashes < self._min_crashes:
            return False
        self.reached = not found
        pool = watched.from_pool_relative()
        hopeless = self._is_hopeless(self._target, pool["rhw_from_pool"], pool["rhw_from_pool_at_least"])
        return self.reached or (hopeless and seen.tally.tests.sum() >= self._held)

    def _decide(self, watched: Limits, limit: float, *, contradicted: bool) -> bool:
        one_sided = (1.0 + self._confidence) / 2.0
        self.decision = Decision(limit, self._statement, one_sided, watched.low, watched.high, contradicted)
        self.reached = self.decision.verdict != "undecided"
        self.waited_for = (f"accept.crash_rate_below ({limit:g})",)
        return self.decision.is_final


def decision_confidence(confidence: float) -> float:
    """Confidence at which a margin is decided, by looks after every round."""
    return 1.0 - (1.0 - confidence) / LOOKS


class PairRule(_AfterRounds):
    """Looks at the difference, or whether B is worse than A by more than a margin.

    Attributes
    ----------
    rhw : float
        That of the difference, over the larger rate.
    verdict : {"proven", "refuted", "open"} or None
        Whether B's rate is at most 1 + margin times A's; None without a margin.
    conditional : bool
        Whether only what lies within the boundary is looked at.
    """

    def __init__(self, campaign: Campaign, margin: float | None) -> None:
        super().__init__(campaign.stop.rhw, campaign.min_crashes)
        self._margin, self._confidence = margin, campaign.stop.confidence
        self._statement = campaign.testing.shells.statement
        self.conditional = self._statement != ASSUMPTION_FREE
        self.verdict: Verdict | None = None if margin is None else "open"

    def observe(self, pairs: PairCounts) -> bool:
        """Whether to stop at the end of a round."""
        watched, level = pairs.inside(pairs.design.n_within(self._statement)), Level.two_sided(self._confidence)
        self.rhw = watched.rhw(level)
        if self._margin is not None:
            self.verdict = watched.verdict(self._margin, Level.two_sided(decision_confidence(self._confidence)))
            self.reached = self.verdict != "open"
            self.waited_for = (f"--margin ({self._margin:g})",)
            return self.reached
        if self._target is None:
            return False
        found = missing(
            {
                f"stop.rhw ({self._target:g}, of the difference)": self.rhw <= self._target,
                f"stop.min_crashes ({self._min_crashes:,})": pairs.n_crashes >= self._min_crashes,
                FIRST_TESTS: not self.of_first_tests,
            }
        )
        self.waited_for = found or self.waited_for
        self.reached = not found
        pool = watched.rhw_from_pool(level)
        return self.reached or self._is_hopeless(self._target, pool, pool)
