"""`shells`: crashes counted within shells of known probability p_s (docs/shells.md).

The rate is Σ p_s c_s, c_s being the share of a stratum's tests that crash. Its limits are those of the likelihood
ratio, with the error of the p_s in the same root, and failed tests as crashes in the upper one alone
(`harness.estimators.tally`). A stratum without a crash widens the upper limit only.

Beside reference drivers in the same traffic, ratio x = μ/μ_R and preventable share y are tested as the contrasts of
docs/estimators.md; each limit is a root of `harness.estimators.likelihood.ratio_limits`. Of the pool's part of their
variance:

- with X and R a path's probabilities that the vehicle and the reference crash, `crash_square` is E[X²], the pool
  knows E[R²], and E[XR] follows from the crashed tests: one of stratum s is a draw in proportion to X there, so that
  Σ p_s/n_s times the sum of R over them has that mean;
- paths may carry preventable and unavoidable crashes, of rates P and U, which makes the contrast's variance smaller;
  how many do is not known, so that E[PU] is taken for its least value, 0.

Given how many tests fell into each cell of a stratum, those of each cell are independent binomials, so that cells take
the place of strata. Tests that failed count as whatever makes an interval wider.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, Note, Number, note
from harness.estimators.likelihood import CRASH, Counts, Level, likelihood_limit, ratio_limits
from harness.estimators.limits import clopper_pearson
from harness.estimators.tally import (
    FEWEST_PATHS,
    ROOM,
    CrashedTests,
    OnRuns,
    RateLimits,
    Tally,
    combined,
    crash_square,
    empty_tally,
    paths_that_count,
    pool_variance,
)
from harness.numbers import two_digits_up
from harness.strata import ShellDesign, weight_of_a_test
from harness.vocabulary import BoolArray, FloatArray

GROWTH, MOST_TIMES = 1.1, 1e6
"""Of numbers of tests that are looked at, and where there is no more looking."""
MOST_NAMED = 10
"""Tests that are named of those that crashed outside."""


@dataclass(frozen=True)
class Shell:
    """A row of the table of shells: probability per test, what was counted, limits of the share that crashes."""

    shell: str
    inside: bool
    p: float
    n_episodes: int
    n_crashes: int
    n_failed: int
    crash_share: float
    crash_share_low: float
    crash_share_high: float
    contribution: float

    @property
    def low(self) -> float:
        """Lower limit of the contribution to the crash rate; ``high`` is the upper one."""
        return self.p * self.crash_share_low

    @property
    def high(self) -> float:
        """See `low`."""
        return self.p * self.crash_share_high

    @property
    def half_width(self) -> float:
        """What this shell alone leaves open of the crash rate."""
        return (self.high - self.low) / 2.0


@dataclass(frozen=True)
class Within:
    """The rate given that there are no crashes outside the library's boundary, and what is known of those.

    ``refuted_by`` are the first few tests (episodes) that crashed outside.
    """

    boundary: str
    assumes: str
    n_shells: int
    crash_rate: float
    ci_low: float
    ci_high: float
    rhw: Number
    rhw_from_pool: Number
    rhw_from_pool_at_least: Number
    n_episodes: int
    n_crashes: int
    n_failed: int
    crash_rate_if_failed_had_crashed: float
    n_episodes_outside: int
    n_crashes_outside: int
    n_failed_outside: int
    refuted: bool
    refuted_by: tuple[int, ...]
    upper_bound_outside: float


@dataclass(frozen=True)
class Unavoidable:
    """The share of a rate, with limits, on whose cut-ins the most careful driver of the library crashes, too."""

    driver: str
    share: float
    share_low: float
    share_high: float


@dataclass(frozen=True)
class ShellDetails:
    """``details`` of the estimate: shells from conservative to aggressive, and the pool that they come from."""

    pool: str
    rhw_from_pool: Number
    rhw_from_pool_at_least: Number
    p_event: float
    p_unreachable: float
    learned: str
    references: tuple[BesideReference, ...]
    within: Within
    shells: tuple[Shell, ...]


class SeenShells:
    """Tests of a shells campaign, counted within the cells of strata.

    ``tally`` has the counts by stratum; of no strata before the first tests.
    """

    _design: ShellDesign  # of the first tests

    def __init__(self) -> None:
        self.tally = self._cells = empty_tally(0)
        self._known: dict[tuple[int, Level], RateLimits] = {}  # of so many first strata
        self._on_runs: list[CrashedTests] = []
        self._crashed: dict[int, list[int]] = {}  # stratum → its first few tests that crashed

    @classmethod
    def of(cls, design: ShellDesign, tally: Tally) -> SeenShells:
        """From counts by stratum, which say nothing about reference drivers."""
        shells = cls()
        shells.count(design.without_references(), tally)
        return shells

    def count(self, design: ShellDesign, cells: Tally, on_runs: CrashedTests | None = None) -> None:
        """Count tests by cell of the design."""
        self._design = design
        known = self._cells if self._cells.tests.size else empty_tally(cells.tests.size)
        self._cells = known.plus(cells)
        self._on_runs += [] if on_runs is None else [on_runs]
        self._join()

    def _join(self) -> None:
        design = self._design
        if self._on_runs:
            tests = CrashedTests(*map(np.concatenate, zip(*self._on_runs, strict=True)))
            self._cells = self._cells._replace(runs=OnRuns.of(design.n_paths, design.cell_p.size, tests))
        self.tally = self._cells.joined(design.joined)
        self._known.clear()

    def add(self, block: Block) -> None:
        """Count one block."""
        design, crash = block.drawn.shells, block.crash
        if design is None:
            raise ValueError("the block has no shells")
        if not self._cells.tests.size:
            self._design, self._cells = design, empty_tally(design.cell_p.size)
        tally, cell, stratum = self._cells, block.cell, block.stratum
        np.add.at(tally.tests, cell, 1)
        for rows, counts, sums in (
            (crash, tally.crashes, tally.crash_mass),
            (block.failed, tally.failed, tally.failed_mass),
        ):
            np.add.at(counts, cell[rows], 1)
            np.add.at(sums, cell[rows], block.cell_mass[rows])
        if design.candidates:
            rows = crash | block.failed
            place = cell[rows] + design.cell_p.size * block.failed[rows]
            self._on_runs.append(CrashedTests(block.shadow[rows], block.step[rows], block.event_mass[rows], place))
        for s in np.unique(stratum[crash]).tolist():
            named = self._crashed.setdefault(s, [])
            episodes = block.first_episode + np.flatnonzero(crash & (stratum == s))
            named += episodes[: MOST_NAMED - len(named)].tolist()
        self._join()

    def result(self, confidence: float) -> Estimate:
        """Assumption-free estimate; that within the boundary is among its details."""
        tally, design = self.tally, self._design
        n, n_crashes, _ = tally.totals
        cautions = tuple(self._cautions())
        free, y = self._limits(design.p.size, Level.two_sided(confidence)), self.weight_of_a_crash()
        squares = float((tally.crashes * y * y).sum())
        return Estimate(
            crash_rate=free.rate,
            std_error=self.std_error(),
            ci_low=free.low,
            ci_high=free.high,
            upper_bound=self._limits(design.p.size, Level.of_bound(confidence, n)).high,
            confidence=confidence,
            rhw=free.rhw,
            n_episodes=n,
            n_crashes=n_crashes,
            n_effective=free.rate**2 / squares if squares > 0.0 else 0.0,
            largest_weight_share=float(np.max(y[tally.crashes > 0], initial=0.0)) / free.rate if free.rate > 0 else 0.0,
            method="crashes within shells of known probability; likelihood-ratio limits of their weighted sum; upper "
            "bound: the same, as an interval's upper limit",
            warnings=(*cautions, *self._warnings(tally, confidence)),
            cautions=cautions,
            details=asdict(
                ShellDetails(
                    design.pool,
                    *free.from_pool_relative(),
                    design.p_event,
                    design.p_unreachable,
                    design.learned,
                    references=() if cautions else compared(design, self._cells, Level.two_sided(confidence)),
                    within=self.within(confidence),
                    shells=self._shells(tally, (1.0 - confidence) / 2.0),
                )
            ),
        )

    def std_error(self, n_strata: int | None = None) -> float:
        """Of the rate of the first strata, all by default, with the pool's own error."""
        tally, p = self.tally.part(slice(0, n_strata)), self._design.p[:n_strata]
        of_tests = p * weight_of_a_test(p, tally.tests) * tally.share * (1.0 - tally.share)
        return math.sqrt(float(of_tests.sum()) + pool_variance(p, tally, self._design.n_independent))

    def weight_of_a_crash(self) -> FloatArray:
        """What a crash in each stratum adds to the rate, p_s/n_s, shape (S,)."""
        return weight_of_a_test(self._design.p, self.tally.tests)

    def unavoidable(self, level: Level) -> Unavoidable | None:
        """See there; None without a crash, and where that driver crashes nowhere."""
        design = self._design
        if not design.n_inside or not self.tally.totals[1]:
            return None
        avoids = np.asarray(design.cell_stratum) > 0
        share, low, high = preventable_share(design.cell_p, self._cells, avoids, design.n_independent, level)
        return Unavoidable(design.strata[0], 1.0 - share, 1.0 - high, 1.0 - low)

    def share_of_crashes(self, some: SeenShells, level: Level, *, of_the_others: bool) -> tuple[float, float]:
        """Limits of the share of the rate that is of ``some`` of its crashes, or of the others, of the same tests.

        A path's parts in both are taken to exclude each other, which makes the variance no smaller.
        """
        p, every, first = self._design.p, self.tally, some.tally
        second = every._replace(crashes=every.crashes - first.crashes, crash_mass=every.crash_mass - first.crash_mass)
        first, second = (second, first) if of_the_others else (first, second)
        rates = [float(p @ each.share) for each in (first, second)]
        of_paths = [pool_variance(p, each, self._design.n_independent) for each in (first, second)]

        def variance(x: float) -> float:
            both = 2.0 * x * (1.0 - x) * rates[0] * rates[1] / self._design.n_independent
            return max((1.0 - x) ** 2 * of_paths[0] + x * x * of_paths[1] + both, 0.0)

        def limits(failed_first: int) -> tuple[float, float]:
            """Failed tests may have been crashes of either kind."""
            a, b = first.crashes + failed_first * every.failed, second.crashes + (1 - failed_first) * every.failed
            counts = np.stack((a, b, every.tests - a - b), axis=1)
            return ratio_limits(np.outer(p, (1.0, 0.0, 0.0)), np.outer(p, (1.0, 1.0, 0.0)), counts, level, variance)

        return min(limits(0)[0], 1.0), min(limits(1)[1], 1.0)

    def limits_of(self, statement: str, level: Level) -> RateLimits:
        """Rate and limits of a statement, or of all strata."""
        return self._limits(self._design.n_within(statement), level)

    @property
    def first_reference(self) -> tuple[str, float] | None:
        """See `ShellDesign`."""
        return self._design.first_reference

    def expected(self, limit: float, driver: str | None, statement: str) -> float:
        """Crashes that these tests of a statement would have brought at a limit, spread evenly over its strata.

        The limit is a crash rate, or a multiple of a reference ``driver``'s.
        """
        design, strata = self._design, slice(0, self._design.n_within(statement))
        if driver is not None:
            limit *= float(design.reference_rate[[each.name for each in design.references].index(driver)])
        return limit * int(self.tally.tests[strata].sum()) / float(design.p[strata].sum())

    def beside(self, driver: str, statement: str, level: Level) -> tuple[float, float]:
        """Limits of a statement's rate over that of a reference driver; any where crashes lie on too few paths."""
        design = self._design
        r = [each.name for each in design.references].index(driver)
        if design.reference_rate[r] <= 0.0 or paths_that_count(design.p, self.tally) < FEWEST_PATHS:
            return 0.0, math.inf
        return _beside(design, self._cells, r, design.n_within(statement), level)

    def more_tests(self, statement: str, level: Level, rhw: float, more_runs: float) -> float:
        """How many times as many tests of each stratum, crashing as often, would leave a relative half-width.

        That is with so many times as many baseline runs; 1 if these tests are enough, infinite beyond a million times.
        """
        n, times, width = self._design.n_within(statement), 1.0, 2.0 * rhw * self.limits_of(statement, level).rate
        p, tally = self._design.p[:n], self.tally.part(slice(0, n))
        variance = pool_variance(p, tally, self._design.n_independent) / more_runs

        def limit(crashes: Counts, side: float) -> float:
            tests = np.rint(tally.tests * times).astype(np.int64)
            return likelihood_limit(p, np.minimum(crashes * times, tests), tests, level, side, variance)

        while limit(tally.crashes + tally.failed, 1.0) - max(limit(tally.crashes, -1.0), 0.0) > width:
            times *= GROWTH
            if times > MOST_TIMES:
                return math.inf
        return times

    def events_for(self, times: float) -> float:
        """How many times the cut-ins that the pool keeps so many times the tests would need; at least 1."""
        kept = np.array(self._design.available or [math.inf])
        return max(float(np.max(self.tally.tests[kept > 0] * times / kept[kept > 0], initial=1.0)), 1.0)

    def _limits(self, n_strata: int, level: Level) -> RateLimits:
        """Of the first strata; anything is possible where crashes lie on too few paths."""
        if (n_strata, level) not in self._known:
            p, tally = self._design.p[:n_strata], self.tally.part(slice(0, n_strata))
            found = RateLimits(float(p @ tally.share), 0.0, 1.0, math.inf, math.inf)
            if not (few := paths_that_count(p, tally) < FEWEST_PATHS):
                found = combined(p, tally, self._design.n_independent, level)
            testable = np.resize(self._design.available[:n_strata] or 1, p.size) > 0
            # Crashes of strata that are still to be tested may lie on other paths.
            to_come = tally.runs is not None and bool((tally.tests[testable] == 0).any())
            if to_come or (few and paths_that_count(p, tally, -ROOM) >= FEWEST_PATHS):
                found = found._replace(from_pool_at_least=0.0)
            self._known[n_strata, level] = found
        return self._known[n_strata, level]

    def _cautions(self) -> list[Note]:
        n_paths, n = self._design.n_paths, paths_that_count(self._design.p, self.tally)
        if n >= FEWEST_PATHS:
            return []
        needed = two_digits_up(n_paths * FEWEST_PATHS / max(n, 1.0))
        return [note("few_paths", n=max(n, 1.0), of=n_paths, least=FEWEST_PATHS, needed=needed)]

    def within(self, confidence: float) -> Within:
        """What holds of a vehicle that crashes only inside the boundary."""
        design, tally = self._design, self.tally
        n, level = design.n_inside, Level.two_sided(confidence)
        inside, outside = tally.part(slice(0, n)), tally.part(slice(n, None))
        limits, (n_outside, n_crashes_outside, n_failed_outside) = self._limits(n, level), outside.totals
        bound = combined(design.p[n:], outside, design.n_independent, Level.of_bound(confidence, n_outside)).high
        crashed = sorted(episode for s, episodes in self._crashed.items() if s >= n for episode in episodes)
        n_tests, n_crashes, n_failed = inside.totals
        return Within(
            boundary=design.boundary,
            assumes=design.assumes,
            n_shells=n,
            crash_rate=limits.rate,
            ci_low=limits.low,
            ci_high=limits.high,
            rhw=limits.rhw,
            rhw_from_pool=limits.from_pool_relative()[0],
            rhw_from_pool_at_least=limits.from_pool_relative()[1],
            n_episodes=n_tests,
            n_crashes=n_crashes,
            n_failed=n_failed,
            crash_rate_if_failed_had_crashed=float(design.p[:n] @ inside.failed_as_crashes().share),
            n_episodes_outside=n_outside,
            n_crashes_outside=n_crashes_outside,
            n_failed_outside=n_failed_outside,
            refuted=n_crashes_outside > 0,
            refuted_by=tuple(crashed[:MOST_NAMED]),
            upper_bound_outside=bound,
        )

    def _shells(self, tally: Tally, tail: float) -> tuple[Shell, ...]:
        design, (low, high) = self._design, clopper_pearson(tally.crashes, tally.tests, tail, tally.failed)
        return tuple(
            Shell(
                shell=name,
                inside=s < design.n_inside,
                p=float(design.p[s]),
                n_episodes=int(tally.tests[s]),
                n_crashes=int(tally.crashes[s]),
                n_failed=int(tally.failed[s]),
                crash_share=float(tally.share[s]),
                crash_share_low=float(low[s]),
                crash_share_high=float(high[s]),
                contribution=float(design.p[s] * tally.share[s]),
            )
            for s, name in enumerate(design.strata)
        )

    def _warnings(self, tally: Tally, confidence: float) -> list[Note]:
        design, found = self._design, []
        if empty := [name for name, n in zip(design.strata, tally.tests, strict=True) if n == 0]:
            found.append(note("untested", shells=empty))
        kept = zip(design.strata, tally.tests, design.available, strict=False)
        free = self._limits(design.p.size, Level.two_sided(confidence))
        if design.shadow_runs and tally.crashes.any() and free.low <= 0.0 and free.from_pool < math.inf:
            n, alone = int(tally.crashes.sum()), free.from_pool_relative()[0]
            found.append(note("runs_leave_nothing", n=n, runs=design.n_paths, alone=alone))
        if used_up := [name for name, n, available in kept if n >= available > 0]:
            found.append(note("used_up", shells=used_up))
        if crashes := int(tally.crashes[design.n_inside :].sum()):
            found.append(note("refuted", n=crashes, boundary=design.boundary))
        return found


@dataclass(frozen=True)
class BesideReference:
    """A vehicle beside a reference driver.

    ``crash_rate`` is the reference's, with its standard error. ``ratio`` is the vehicle's crash rate over it, and
    ``preventable`` the share of the vehicle's crashes that the reference would have avoided; NaN where it is not
    defined. ``delay_s`` (s) is when the reference begins to brake after the cut-in, None if it has no delay of its own.
    """

    reference: str
    described: str
    delay_s: float | None
    crash_rate: float
    std_error: Number
    ratio: Number
    ratio_low: Number
    ratio_high: Number
    preventable: Number
    preventable_low: Number
    preventable_high: Number


def compared(design: ShellDesign, cells: Tally, level: Level) -> tuple[BesideReference, ...]:
    """The vehicle beside each reference of a design; ``cells`` are its tests by the design's cells."""
    found, own = [], float(design.p @ cells.joined(design.joined).share)
    for r, reference in enumerate(design.references):
        crashes_too = design.crashes_too(r)
        rate, square = float(design.reference_rate[r]), float(design.reference_square[r])
        if rate == 0.0:  # a reference that crashes nowhere on these paths is nothing to compare with
            continue
        ratio = own / rate if rate > 0.0 else math.nan, *_beside(design, cells, r, design.p.size, level)
        preventable = preventable_share(design.cell_p, cells, ~crashes_too, design.n_independent, level)
        error = math.sqrt(max(square - rate * rate, 0.0) / design.n_independent)
        who = reference.name, reference.described, reference.delay_s
        found.append(BesideReference(*who, rate, error, *ratio, *preventable))
    return tuple(found)


def _beside(design: ShellDesign, cells: Tally, r: int, n_strata: int, level: Level) -> tuple[float, float]:
    """Limits of the rate of the first strata over that of a reference."""
    strata, p = slice(0, n_strata), design.p[:n_strata]
    moments = float(design.reference_rate[r]), float(design.reference_square[r])

    def limits(tests: Tally) -> tuple[float, float]:
        with_reference = design.joined.T @ (tests.crash_mass @ design.crashes_too(r))
        own = tests.joined(design.joined).part(strata)
        return rate_ratio_limits(p, own, with_reference[strata], moments, design.n_independent, level)

    low, high = limits(cells)
    return low, high if (worst := cells.failed_as_crashes()) is cells else limits(worst)[1]


def rate_ratio_limits(
    p: FloatArray, tally: Tally, with_reference: FloatArray, moments: tuple[float, float], n_paths: float, level: Level
) -> tuple[float, float]:
    """Limits of Σ p_s θ_s over the crash rate of a reference.

    Of that ``moments`` has the rate and the mean square of a path's probability of a crash; ``with_reference`` (S,) is,
    over the crashed tests of each stratum, the sum of their paths' probability that the reference crashes.
    """
    rate, square = moments
    own, of_paths = float(p @ tally.share), pool_variance(p, tally, n_paths)
    product = float(weight_of_a_test(p, tally.tests) @ with_reference)
    covariance, of_reference = (product - own * rate) / n_paths, (square - rate * rate) / n_paths

    def variance(x: float) -> float:
        return max(of_paths - 2.0 * x * covariance + x * x * of_reference, 0.0)

    # A constant as a sum over strata: the same for either outcome.
    below = np.full((p.size, 2), rate / p.size)
    return ratio_limits(np.outer(p, CRASH), below, tally.outcomes, level, variance)


def preventable_share(
    p: FloatArray, cells: Tally, prevented: BoolArray, n_paths: float, level: Level
) -> tuple[float, float, float]:
    """Share of Σ p_c θ_c that lies in the ``prevented`` ones of all cells (C,), with limits; NaN without a crash."""
    contributions = p * cells.share
    total = float(contributions.sum())
    share = float(contributions[prevented].sum()) / total if total > 0.0 else math.nan
    low = _share_limits(p, cells.failed_as_crashes(~prevented), prevented, n_paths, level)[0]
    high = _share_limits(p, cells.failed_as_crashes(prevented), prevented, n_paths, level)[1]
    return share, min(low, 1.0), min(high, 1.0)


def _share_limits(
    p: FloatArray, cells: Tally, prevented: BoolArray, n_paths: float, level: Level
) -> tuple[float, float]:
    scale = weight_of_a_test(p, cells.tests)
    first, second = (crash_square(scale * part, cells) for part in (prevented, ~prevented))
    rates = p * cells.share
    of_prevented, of_others = float(rates[prevented].sum()), float(rates[~prevented].sum())

    def variance(y: float) -> float:
        rest = 1.0 - y
        mean = rest * of_prevented - y * of_others
        return max(rest * rest * first + y * y * second - mean * mean, 0.0) / n_paths

    above, below = np.outer(p * prevented, CRASH), np.outer(p, CRASH)
    return ratio_limits(above, below, cells.outcomes, level, variance)
