"""When tests are enough: a precision asked for beforehand, looked for at places fixed beforehand; or a decision.

Whatever the tests were drawn from, a rule looks at them now and then, leaves what it has found in ``look``, and says
whether to go on, while there are tests left to be asked for (`harness.vocabulary.StoppedBy`). Looking after every test
and stopping at the first narrow interval favours runs that were narrow by luck; and while the rare crashes of large
weight have not occurred, mean, standard error and largest weight seen are all too small. So looks at weighted tests
(`StopRule`) follow from the campaign alone, two in a row must pass, and one more crash of the largest weight that the
design allows may move the estimate by no more than the half-width asked for: cap/(n·rate) ≤ RHW. Tests drawn from
shells (`RoundRule`) and pairs of tests of two vehicles (`PairRule`) are looked at after each round, and once is enough.
That limits hold at a fixed number of tests says nothing about the number at which a rule stops: that intervals cover
there, how far rates are biased, and how often decisions are wrong, is measured (docs/estimators.md, docs/compare.md,
docs/gate.md).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from harness.campaign.campaign import Campaign
from harness.campaign.sections import MIN_CRASHES, Accept, Stop
from harness.estimators.estimate import Estimate, Note, finite_json, note
from harness.estimators.likelihood import Level
from harness.estimators.limits import clopper_pearson
from harness.estimators.pairs import PairDecision, Pairs
from harness.estimators.per_hour import PerHour
from harness.estimators.shells import SeenShells
from harness.numbers import two_digits_up
from harness.strata import ASSUMPTION_FREE

LOOK_RATIO = 1.1
"""Of neighbouring looks: since the half-width shrinks with 1/√n, they differ by 5 % in precision, which is the noise of
the half-width itself at the default floor of 100 crashes (half of 1/√100); a finer grid mostly repeats the same look.
With two passes a campaign uses about 20 % more tests than a fixed size would need, at a ratio of 1.25 nearly 50 %."""
POOL_SHARE = 0.5
"""Share of the squared width from the pool's own error above which more tests hardly narrow an interval."""
NARROW = 0.1
"""Half-width of a difference over the larger rate at which two vehicles are as good as told apart."""
MOST_TIMES = 1e3
"""As many pairs as there are that nobody foresees what would be seen."""
DECISION_THRESHOLDS = ((2.5, 4.5), (10.0, 3.4), (100.0, 4.5), (1_000.0, 5.0), (math.inf, 5.5))
"""Below so many crashes, the threshold of the likelihood ratio at which a limit is decided with an error of 5 % a side.

They are those expected at the limit if tests and crashes were spread evenly over all strata, whatever traffic and
vehicle are: n tests of strata of probability P expect n limit/P. Calibrated by replication where limit = truth, looked
at after every round and in the midst of each (docs/gate.md): the error is spent where vehicles at half and at twice the
limit are decided. Few tests need more than some more: then one crash in a shell of small share decides."""
DECISION_TAIL = 0.05
"""Error a side for which the thresholds are."""

Verdict = Literal["accepted", "rejected", "undecided"]
Ended = Literal["rhw", "accept", "below_reference"]


def decision_level(expected: float, confidence: float) -> Level:
    """The level at which one look decides, so that all looks together err in (1 - confidence)/2 of campaigns a side.

    ``expected`` crashes see `DECISION_THRESHOLDS`; few and many have the same threshold, the pool's error its quantile.
    """
    threshold = next(threshold for most, threshold in DECISION_THRESHOLDS if expected < most)
    threshold = max(threshold + math.log(2.0 * DECISION_TAIL / (1.0 - confidence)), 0.5)
    return Level(threshold, math.sqrt(2.0 * threshold))


@dataclass(frozen=True)
class Decision:
    """What is known about a limit of the crash rate, by an interval that allows for every look.

    ``limit``, ``low`` and ``high`` are in crashes per test, or in crash rates of a reference ``driver``; after
    ``n_episodes`` tests the rate lies between the latter two. Whatever the budget, at most 1 - ``confidence`` of
    campaigns decide wrongly, even where the limit is the rate itself. Nothing is accepted with ``n_milder`` crashes
    before events, or on events too mild to count or made milder by the vehicle; with ``n_differing`` tests that were
    not the same when run twice; or where ``n_runs`` baseline runs (0: there are enough) are needed to see what it does
    in one of many drives. ``over_assumed`` are the outermost ``low`` and ``high`` of a sum over assumed exposures.
    """

    limit: float
    statement: str
    confidence: float
    low: float
    high: float
    n_episodes: int = 0
    driver: str | None = None
    n_milder: int = 0
    n_differing: int = 0
    n_runs: int = 0
    over_assumed: tuple[float, float] | None = None

    @property
    def verdict(self) -> Verdict:
        """On which side of the limit the interval lies, if that can be said."""
        if self.low > self.limit:
            return "rejected"
        doubted = self.n_milder or self.n_differing or self.n_runs
        return "accepted" if self.high < self.limit and not doubted else "undecided"

    def to_json(self) -> dict[str, Any]:
        """All of it; no upper end is null."""
        return finite_json({"verdict": self.verdict, **asdict(self)})


@dataclass(frozen=True)
class Look:
    """What a rule has found at its last look; a relative half-width is infinite where the interval may be wrong.

    ``ended`` is which end was reached, if any; ``unmet`` are the conditions that a look last failed. With
    ``pool_error_above_target`` no test would help: the pool's own error is too large; ``rhw_from_pool`` is what it
    alone would leave, 0 while little is known. ``decision`` is what is known about the campaign's limit, if it has one.
    """

    rhw: float = math.inf
    ended: Ended | None = None
    unmet: tuple[Note, ...] = ()
    pool_error_above_target: bool = False
    rhw_from_pool: float = 0.0
    decision: Decision | None = None

    @property
    def stopped(self) -> bool:
        """Whether the asked precision, or decision, was reached; always False when none was asked."""
        return self.ended is not None


class Rule:
    """Looks at results, leaves what it found in ``look``, and says when they are enough.

    ``target`` is the relative half-width that is asked for, None where only the budget ends the tests.
    ``of_first_tests`` says whether a round brings the tests that every shell gets before anything is decided of it.
    """

    of_first_tests = False
    seen: SeenShells | PerHour | None = None
    """All tests at the last look, of rules about a rate from shells."""
    _needed = 1  # looks in a row that must find it

    def __init__(self, target: float | None, min_crashes: int) -> None:
        self.target, self._min_crashes = target, min_crashes
        self._passes = 0
        self.look = Look()

    def _looked(
        self,
        rhw: float,
        n_crashes: int,
        *,
        key: str = "rhw",
        one_more_crash: float = 0.0,
        after_first_tests: bool = False,
        also: Note | None = None,
        pool: tuple[float, float] = (0.0, 0.0),
    ) -> bool:
        """Record a look at a precision, and say whether to stop; ``key`` is that of its note.

        ``one_more_crash`` is the share by which one more, of the largest weight, would move the estimate; ``also`` is
        what was waited for if nothing else is unmet; ``pool`` are half-widths by the pool's error, seen and least.
        """
        if (target := self.target) is None:
            self.look = Look(rhw)
            return False
        conditions = [
            (note(key, target=target), rhw <= target),
            (note("one_more_crash", target=target), one_more_crash <= target),
            (note("min_crashes", least=self._min_crashes), n_crashes >= self._min_crashes),
            (note("first_tests"), not (after_first_tests and self.of_first_tests)),
        ]
        unmet = tuple(condition for condition, is_met in conditions if not is_met)
        self._passes = 0 if unmet else self._passes + 1
        stopped = self._passes >= self._needed
        too_rough = pool[1] > target
        unmet = unmet or ((also,) if also else self.look.unmet)
        self.look = Look(rhw, "rhw" if stopped else None, unmet, too_rough, pool[0])
        return stopped or (too_rough and pool[0] ** 2 >= POOL_SHARE * rhw**2)


def look_grid(n_episodes: int, shard_ends: Sequence[int], ratio: float = LOOK_RATIO) -> tuple[int, ...]:
    """Numbers of episodes at which a campaign is looked at, ascending.

    The last is `n_episodes`, all others are of ``shard_ends``, nearest to a geometric grid of this ratio.
    """
    looks: list[int] = []
    target = float(shard_ends[0])
    while target < n_episodes:
        place = bisect_right(shard_ends, target)
        below, above = shard_ends[max(place - 1, 0)], shard_ends[place]
        nearest = below if target - below < above - target else above
        if nearest < n_episodes and (not looks or nearest > looks[-1]):
            looks.append(nearest)
        target *= ratio
    return (*looks, n_episodes)


class StopRule(Rule):
    """Looks at the estimate of weighted tests, by the campaign's own estimator, at ``looks``: numbers of episodes."""

    _needed = 2

    def __init__(self, campaign_stop: Stop, shard_ends: Sequence[int], ratio: float = LOOK_RATIO) -> None:
        super().__init__(campaign_stop.rhw, campaign_stop.min_crashes or MIN_CRASHES)
        self.looks = look_grid(campaign_stop.episodes, shard_ends, ratio)
        self._n_looks = 0

    def due(self, n: int) -> bool:
        """Whether `observe` wants the estimate of the first ``n`` episodes."""
        return self._n_looks < len(self.looks) and n == self.looks[self._n_looks]

    def observe(self, n: int, estimate: Estimate) -> bool:
        """Whether to stop after the look at ``n`` episodes, the next of `looks`, with the estimate of exactly these."""
        self._n_looks += 1
        last = self._n_looks == len(self.looks)
        total = n * estimate.crash_rate
        one_more = estimate.weight_cap / total if total > 0.0 else math.inf
        also = note("second_look") if last and self._passes == 0 else None
        return self._looked(estimate.precision, estimate.n_crashes, one_more_crash=one_more, also=also) or last


class RoundRule(Rule):
    """Looks at the crash rate from shells after each round, of one scenario or of the sum of several per hour.

    If a limit is asked about, it waits for the decision whether the rate is below it, at ``level_at`` an expected
    number of crashes and a confidence, whatever the budget: a run that is continued is looked at where it would have
    been without the break, and once more where that was. It gives nothing up before the tests ``held`` by the folder.
    """

    level_at = staticmethod(decision_level)

    def __init__(self, campaign: Campaign, held: int = 0) -> None:
        super().__init__(campaign.stop.rhw, campaign.min_crashes)
        self._held, self._confidence = held, campaign.stop.confidence
        self._statement, self._accept = campaign.testing.shells.statement, campaign.accept
        self._below_reference, self._each = campaign.stop.below_reference, campaign.stop.each_family

    def observe(self, seen: SeenShells | PerHour) -> bool:
        """Whether to stop at the end of a round, with all tests so far."""
        self.seen = seen
        n, n_crashes, _ = seen.totals
        if self._accept is not None:
            return self._decided(seen, self._accept) and n >= self._held
        level = Level.two_sided(self._confidence)
        limits = seen.limits(level, self._statement)
        limit = self._below_reference
        of_families = seen.families if self._each and isinstance(seen, PerHour) else ()
        rhws = [family.limits(level).rhw for family in of_families]
        also = note("first_tests") if self.of_first_tests else None
        pool = limits.from_pool_relative() if n_crashes >= self._min_crashes else (0.0, 0.0)
        enough = self._looked(max(rhws, default=limits.rhw), n_crashes, also=also, pool=pool)
        if not self.look.stopped and limit is not None and not rhws and self._is_below(seen, limit, limits.high):
            self.look = replace(self.look, ended="below_reference", unmet=(note("below_reference", limit=limit),))
        return self.look.stopped or (enough and n >= self._held)

    def _is_below(self, seen: SeenShells | PerHour, limit: float, high: float) -> bool:
        """Whether the rate, ``high`` at most, is known to be below ``limit`` times that of a reference driver."""
        if (first := seen.first_reference) is None:
            return False
        driver, rate = first
        # Limits of a ratio take a hundred times as long as those of a rate: most looks are far from an end.
        return high <= 2.0 * limit * rate and self._beside(seen, limit, driver).verdict == "accepted"

    def _beside(self, seen: SeenShells | PerHour, limit: float, driver: str | None) -> Decision:
        """What is known about a limit after these tests, at the level of decisions."""
        statement = self._statement
        level = self.level_at(seen.expected(limit, driver, statement), self._confidence)
        ends = seen.limits(level, statement)[1:3] if driver is None else seen.beside(driver, statement, level)
        return Decision(limit, statement, (1.0 + self._confidence) / 2.0, *ends, seen.totals[0], driver=driver)

    def _decided(self, seen: SeenShells | PerHour, accept: Accept) -> bool:
        """Look at a limit until it is decided; that answer stays, also while the folder holds further tests."""
        if not self.look.stopped:
            key, limit, driver = accept.asked
            decision = self._beside(seen, limit, driver)
            rhw = seen.limits(Level.two_sided(self._confidence), self._statement).rhw
            ended: Ended | None = None if decision.verdict == "undecided" else "accept"
            if decision.verdict == "accepted":
                decision = replace(decision, n_runs=self._runs_needed(seen, decision))
            if ended and isinstance(seen, PerHour):
                level = self.level_at(seen.expected(limit, driver, self._statement), self._confidence)
                ends = seen.limits_over_assumed(level, ratio=driver is not None)
                decision = replace(decision, over_assumed=ends)
            self.look = Look(rhw, ended, (note("accept", asked=key, limit=limit),), decision=decision)
        return self.look.stopped

    def _runs_needed(self, seen: SeenShells | PerHour, decision: Decision) -> int:
        """Number of baseline runs that would show what may break the limit; 0 where there are enough.

        However many tests there are, they repeat these runs. What a vehicle that acts before the event does in a share
        of drives below the upper limit of 0 of n, none of n runs may show; it may crash on all events then.
        """
        if isinstance(seen, PerHour):
            masses = [(family.p, family.seen.design) for family in seen.families]
        else:
            masses = [(seen.design.p, seen.design)]
        on_runs = [(float(p.sum()), design.n_independent) for p, design in masses if design.shadow_runs]
        if not on_runs:
            return 0
        n_runs = min(n for _, n in on_runs)
        unseen = float(clopper_pearson(0, n_runs, 1.0 - decision.confidence)[1])
        share = math.fsum(p for p, _ in on_runs) / math.fsum(float(p.sum()) for p, _ in masses)
        expected = seen.expected(decision.limit, decision.driver, ASSUMPTION_FREE)
        times = share * unseen * decision.n_episodes / expected
        return two_digits_up(n_runs * times) if times > 1.0 else 0


class PairRule(Rule):
    """Looks at two vehicles after each round: who crashes less often, or whether B is worse by more than a ``margin``.

    ``decision`` is what is known of that. Without a margin it is also enough if the half-width of the difference, which
    is ``look.rhw``, is `NARROW` of the larger rate, or if both rates are below ``stop.below_reference``. If an ``rhw``
    is asked for it alone is waited for (``ends_at_rhw``). If ``conditional``, only pairs within the boundary count.
    """

    level_at = staticmethod(decision_level)

    def __init__(self, campaign: Campaign, margin: float | None = None, rhw: float | None = None) -> None:
        stop, self._statement = campaign.stop, campaign.testing.shells.statement
        super().__init__(NARROW if margin is None and rhw is None else rhw, campaign.min_crashes)
        self._confidence, self.ends_at_rhw = stop.confidence, rhw is not None
        self._below_reference = stop.below_reference if margin is None and rhw is None else None
        self._asked = note("sign") if margin is None else note("margin", margin=margin)
        self.conditional = self._statement != ASSUMPTION_FREE
        self.decision = PairDecision(margin, "open", (1.0 + stop.confidence) / 2.0, self.conditional)

    def observe(self, pairs: Pairs) -> bool:
        """Whether to stop at the end of a round."""
        watched = pairs.within(self._statement)
        level = Level.two_sided(self._confidence)
        verdict = watched.verdict(self.decision.margin or 0.0, self._level(watched))
        self.decision = replace(self.decision, verdict=verdict)
        if self.decision.margin is not None and watched.n_crashes:
            _, low, high = watched.ratio(self._level(watched))
            self.decision = replace(self.decision, ratio=(1.0 / high, 1.0 / low if low > 0.0 else math.inf))
        pool = (watched.rhw_from_pool(level),) * 2
        rhw, key = watched.rhw(level), "rhw_of_difference"
        given_up = self._looked(rhw, pairs.n_crashes, key=key, after_first_tests=True, pool=pool)
        if not self.ends_at_rhw:
            ended = self.look.ended
            if self.decision.verdict != "open":
                ended = "accept"
            elif ended is None and self._both_below(watched):
                ended = "below_reference"
            unmet = self.look.unmet if ended == "rhw" else (self._asked,)
            self.look = replace(self.look, ended=ended, unmet=unmet)
        return self.look.stopped or given_up

    def more_pairs(self, pairs: Pairs) -> float:
        """How many times as many pairs mostly decide, if they end as often; infinite where nobody can tell."""
        watched = pairs.within(self._statement)
        times = 1.0
        while times < MOST_TIMES:
            times *= LOOK_RATIO
            ahead = watched.times(times)
            if ahead.verdict(self.decision.margin or 0.0, self._level(ahead).likely()) != "open":
                return times
        return math.inf

    def _level(self, watched: Pairs) -> Level:
        if watched.n_crashes and not self.ends_at_rhw:
            return self.level_at(watched.expected(watched.larger_rate), self._confidence)
        return Level.two_sided(self._confidence)

    def _both_below(self, watched: Pairs) -> bool:
        """Whether both are known to crash less than so many times as often as the reference driver does at least."""
        limit, reference = self._below_reference, watched.reference
        if limit is None or reference is None:
            return False
        rate, error = reference
        level = self.level_at(watched.expected(limit * rate), self._confidence)
        return watched.highest_rate(level) < limit * (rate - level.z * error)
