"""When a campaign may stop: a precision asked for beforehand, looked for at places fixed beforehand.

Looking after every test and stopping at the first narrow interval favours runs that were narrow by luck; and while the
rare crashes of large weight have not occurred, mean, standard error and largest weight seen are all too small. So looks
follow from the campaign alone, two in a row must pass, and one more crash of the largest weight that the design allows
may move the estimate by no more than the half-width asked for: cap/(n·rate) ≤ RHW (docs/estimators.md).

Ratio 1.1: since the half-width shrinks with 1/√n, neighbouring looks differ by 5 % in precision, which is the noise of
the half-width itself at the default floor of 100 crashes (half of 1/√100); a finer grid mostly repeats the same look.
With two passes a campaign uses about 20 % more tests than a fixed size would need, with a ratio of 1.25 nearly 50 %.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from harness.campaign.campaign import Campaign
from harness.campaign.sections import Stop
from harness.estimators.estimate import Estimate
from harness.estimators.likelihood import Level
from harness.estimators.pairs import MarginVerdict, PairCounts
from harness.estimators.shells import Shells
from harness.estimators.tally import RateLimits
from harness.strata import ASSUMPTION_FREE
from harness.vocabulary import SAMPLING, EstimatorName, Method

LOOK_RATIO = 1.1
PASSES_NEEDED = 2
DEFAULT_MIN_CRASHES = 100


def look_grid(n_episodes: int, shard_size: int, ratio: float = LOOK_RATIO) -> tuple[int, ...]:
    """Numbers of episodes at which a campaign is looked at, ascending.

    The last is `n_episodes`, all others are multiples of ``shard_size``, nearest to a geometric grid of this ratio.
    """
    looks: list[int] = []
    target = float(shard_size)
    while target < n_episodes:
        boundary = max(1, math.floor(target / shard_size + 0.5)) * shard_size
        if boundary < n_episodes and (not looks or boundary > looks[-1]):
            looks.append(boundary)
        target *= ratio
    return (*looks, n_episodes)


Verdict = Literal["accepted", "rejected", "undecided"]


@dataclass(frozen=True)
class Decision:
    """What is known about a limit, by an interval that is looked at after each round.

    Looks inflate errors, and limits by the likelihood ratio are wider than a level needs where crashes are few. What is
    left is measured: decisions are wrong in at most 1 % where 5 % are allowed (docs/gate.md).

    Attributes
    ----------
    crash_rate_below : float
        The limit, per test.
    statement : str
        Which statement decides.
    confidence : float
        That the crash rate lies on the side which is said: an interval leaves out half as much there as at both sides.
    low, high : float
        The interval.
    contradicted : bool
        Whether a test has shown that the vehicle does not do what the statement assumes. Its upper limit then says
        nothing, while what crashed, crashed.
    """

    crash_rate_below: float
    statement: str
    confidence: float
    low: float
    high: float
    contradicted: bool = False

    @property
    def verdict(self) -> Verdict:
        """On which side of the limit the interval lies, if that can be said."""
        if self.low > self.crash_rate_below:
            return "rejected"
        return "accepted" if self.high < self.crash_rate_below and not self.contradicted else "undecided"

    @property
    def is_final(self) -> bool:
        """Whether further tests would change nothing."""
        return self.verdict != "undecided" or self.high < self.crash_rate_below

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        given = "" if self.statement == ASSUMPTION_FREE else f", given statement {self.statement},"
        level, limit = f"{self.confidence:.3g}", f"{self.crash_rate_below:.3g}"
        if self.contradicted and self.verdict == "undecided":
            return (
                f"UNDECIDED: whether the crash rate is below {limit} per test is not known: the vehicle does not do "
                f"what statement {self.statement} assumes. Ask for accept.statement: {ASSUMPTION_FREE}, and use a new "
                "folder."
            )
        if self.verdict == "undecided":
            between = f"it may be {self.low:.3g} as well as {self.high:.3g}"
            return f"UNDECIDED: whether the crash rate{given} is below {limit} per test is not known; {between}."
        side, shown = ("below", self.high) if self.verdict == "accepted" else ("above", self.low)
        word = "upper" if side == "below" else "lower"
        return (
            f"{self.verdict.upper()}: with confidence {level} the crash rate{given} is {side} {limit} per test "
            f"({word} limit {shown:.3g})."
        )

    def to_json(self) -> dict[str, Any]:
        """All of it."""
        return {"verdict": self.verdict, **asdict(self), "sentence": self.sentence}


class Rule:
    """Looks at results, and says why a run ended.

    Attributes
    ----------
    reached : bool
        Whether the asked precision, or decision, was reached; always False when none was asked.
    rhw : float
        Relative half-width at the last look; infinite where the interval may be wrong.
    heaviest : float
        By how much of itself one more crash of the largest weight would have moved the last look's estimate; 0 for
        limits within shells, which allow for every crash that has not been seen.
    waited_for : tuple of str
        Conditions that were missing when a look last failed: what decided, or what is still missing.
    pool_error_above_target : bool
        Whether the error of the pool, which no test narrows, is too large for the asked precision.
    decision : Decision or None
        What is known about the limit that the campaign asks about, if it does; that, not a precision, is then waited
        for.
    """

    def __init__(self, target: float | None, min_crashes: int) -> None:
        self._target, self._min_crashes = target, min_crashes
        self.reached = self.pool_error_above_target = False
        self.rhw, self.heaviest = math.inf, 0.0
        self.waited_for: tuple[str, ...] = ()
        self.decision: Decision | None = None


def missing(met: Mapping[str, bool]) -> tuple[str, ...]:
    """Names of the conditions that are not met."""
    return tuple(condition for condition, is_met in met.items() if not is_met)


class StopRule(Rule):
    """Fed with the estimate at each look in turn; says when to stop.

    Parameters
    ----------
    campaign_stop : Stop
        The campaign's ``stop`` section.
    method : str
        ``testing.method``; decides whose interval is watched unless ``stop.estimator`` does.
    shard_size, ratio
        See `look_grid`.
    min_crashes : int
        Floor on sampled crashes where ``stop.min_crashes`` says nothing.

    Attributes
    ----------
    estimator : str
        Whose estimate `observe` wants.
    looks : tuple of int
        Numbers of episodes at which it wants it.
    """

    def __init__(
        self,
        campaign_stop: Stop,
        method: Method,
        shard_size: int,
        ratio: float = LOOK_RATIO,
        *,
        min_crashes: int = DEFAULT_MIN_CRASHES,
    ) -> None:
        super().__init__(campaign_stop.rhw, campaign_stop.min_crashes or min_crashes)
        self.estimator: EstimatorName = campaign_stop.estimator or SAMPLING[method].headline
        self.looks = look_grid(campaign_stop.episodes, shard_size, ratio)
        self.heaviest = math.inf
        self._n_seen = self._n_passes = 0

    def due(self, n: int) -> bool:
        """Whether `observe` wants the estimate of the first ``n`` episodes."""
        return self._n_seen < len(self.looks) and n == self.looks[self._n_seen]

    def observe(self, n: int, estimate: Estimate) -> bool:
        """Whether to stop after the look at `n` episodes, the next of `looks`, with the estimate from exactly these.

        Raises
        ------
        ValueError
            If looks are skipped, repeated or taken elsewhere: the rule is valid only as declared.
        """
        if self.reached or self._n_seen == len(self.looks):
            raise ValueError("the campaign has already stopped")
        if not self.due(n) or estimate.n_episodes != n:
            raise ValueError(
                f"expected the estimate of the first {self.looks[self._n_seen]} episodes, "
                f"got n = {n} with an estimate of {estimate.n_episodes}"
            )
        self._n_seen += 1
        self.rhw = estimate.precision
        total = n * estimate.crash_rate
        self.heaviest = estimate.weight_cap / total if total > 0.0 else math.inf
        last = self._n_seen == len(self.looks)
        if self._target is None:
            return last
        found = missing(
            {
                f"stop.rhw ({self._target:g})": self.rhw <= self._target,
                f"stop.rhw ({self._target:g}) for one more crash of the largest possible weight": self.heaviest
                <= self._target,
                f"stop.min_crashes ({self._min_crashes:,})": estimate.n_crashes >= self._min_crashes,
            }
        )
        self._n_passes = 0 if found else self._n_passes + 1
        self.reached = self._n_passes >= PASSES_NEEDED
        self.waited_for = found or self.waited_for
        if last and self._n_passes and not self.reached:
            self.waited_for = ("the same at a second look",)
        return self.reached or last


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

    def _decide(self, watched: RateLimits, limit: float, *, contradicted: bool) -> bool:
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
        self.verdict: MarginVerdict | None = None if margin is None else "open"

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
