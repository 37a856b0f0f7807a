"""`shells`: crashes counted within shells of known probability p_s (docs/shells.md).

The rate is Σ p_s c_s, c_s being the share of a stratum's tests that crash. Its limits are those of the likelihood
ratio, with the error of the p_s in the same root, and failed tests as crashes in the upper one alone
(`harness.estimators.tally`). A stratum without a crash widens the upper limit only. What lies between a vehicle and
reference drivers is in `harness.estimators.beside`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from harness.estimators.beside import BesideReference, beside, compared
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, Note, Number, note
from harness.estimators.likelihood import Counts, Level, likelihood_limit
from harness.estimators.limits import clopper_pearson
from harness.estimators.tally import (
    FEWEST_PATHS,
    ROOM,
    CrashedTests,
    OnRuns,
    RateLimits,
    Tally,
    combined,
    empty_tally,
    paths_that_count,
    pool_variance,
)
from harness.numbers import two_digits_up
from harness.strata import ASSUMPTION_FREE, ShellDesign, weight_of_a_test
from harness.vocabulary import FloatArray

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
    """The rate if nothing crashes outside the library's boundary; ``refuted_by`` are the first tests that did."""

    boundary: str
    n_shells: int
    crash_rate: float
    ci_low: float
    ci_high: float
    rhw: Number
    rhw_from_pool: Number
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
class ShellDetails:
    """``details`` of the estimate: shells from conservative to aggressive, and the pool that they come from."""

    n_failed: int
    crash_rate_if_failed_had_crashed: float
    pool: str
    rhw_from_pool: Number
    p_event: float
    p_unreachable: float
    references: tuple[BesideReference, ...]
    within: Within
    shells: tuple[Shell, ...]


class SeenShells:
    """Tests of a shells campaign, counted within the ``cells`` of strata; ``tally`` has the counts by stratum."""

    design: ShellDesign
    """That of the first tests, if none is given."""

    def __init__(self, design: ShellDesign | None = None) -> None:
        self.tally = self.cells = empty_tally(0)
        if design is not None:
            self.design, self.cells, self.tally = design, empty_tally(design.cell_p.size), empty_tally(design.p.size)
        self._on_runs: list[CrashedTests] = []
        self._crashed: dict[int, list[int]] = {}  # stratum → its first few tests that crashed

    @classmethod
    def of(cls, design: ShellDesign, cells: Tally) -> SeenShells:
        """Tests known by their counts in the design's cells."""
        shells = cls()
        shells.count(design, cells)
        return shells

    @classmethod
    def of_blocks(cls, blocks: Iterable[Block]) -> SeenShells:
        """All tests of some blocks."""
        shells = cls()
        for block in blocks:
            shells.add(block)
        return shells

    def count(self, design: ShellDesign, cells: Tally, on_runs: CrashedTests | None = None) -> None:
        """Count tests by cell of the design."""
        self.design = design
        counted = self.cells if self.cells.tests.size else empty_tally(cells.tests.size)
        self.cells = counted.plus(cells)
        self._on_runs += [] if on_runs is None else [on_runs]
        self._join()

    def _join(self) -> None:
        design = self.design
        if self._on_runs:
            tests = CrashedTests(*map(np.concatenate, zip(*self._on_runs, strict=True)))
            self.cells = self.cells._replace(runs=OnRuns.of(design.n_paths, design.cell_p.size, tests))
        self.tally = self.cells.joined(design.joined)

    def add(self, block: Block) -> None:
        design, crash = block.drawn.shells, block.crash
        if design is None:
            raise ValueError("the block has no shells")
        if not self.cells.tests.size:
            self.design, self.cells = design, empty_tally(design.cell_p.size)
        tally, cell, stratum = self.cells, block.cell, block.stratum
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
            first_few = self._crashed.setdefault(s, [])
            episodes = block.first_episode + np.flatnonzero(crash & (stratum == s))
            first_few += episodes[: MOST_NAMED - len(first_few)].tolist()
        self._join()

    def result(self, confidence: float) -> Estimate:
        """Assumption-free estimate; that within the boundary is among its details."""
        tally, design, level = self.tally, self.design, Level.two_sided(confidence)
        n, n_crashes, n_failed = tally.totals
        free, cautions = self._limits(design.p.size, level), self._cautions()
        y = self.weight_of_a_crash()
        squares = float((tally.crashes * y * y).sum())
        details = ShellDetails(
            n_failed, tally.failed_as_crashes().rate(design.p), design.pool, free.from_pool_relative()[0],
            design.p_event, design.p_unreachable, () if cautions else compared(design, self.cells, level),
            self.within(confidence), self._shells((1.0 - confidence) / 2.0),
        )  # fmt: skip
        return Estimate(
            crash_rate=free.rate, std_error=self.std_error(), ci_low=free.low, ci_high=free.high,
            upper_bound=self._limits(design.p.size, Level.of_bound(confidence, n)).high, confidence=confidence,
            rhw=free.rhw, n_episodes=n, n_crashes=n_crashes,
            n_effective=free.rate**2 / squares if squares > 0.0 else 0.0,
            largest_weight_share=float(np.max(y[tally.crashes > 0], initial=0.0)) / free.rate if free.rate > 0 else 0.0,
            interval="likelihood_ratio", bound="two_sided", warnings=(*cautions, *self._warnings(free)),
            cautions=cautions,
            details=asdict(details),
        )  # fmt: skip

    def std_error(self, n_strata: int | None = None) -> float:
        """Standard error of the rate of the first strata (all by default), with the pool's own error."""
        tally, p = self.tally.part(slice(0, n_strata)), self.design.p[:n_strata]
        variances = p * weight_of_a_test(p, tally.tests) * tally.share * (1.0 - tally.share)
        return math.sqrt(float(variances.sum()) + pool_variance(p, tally, self.design.n_independent))

    @property
    def totals(self) -> tuple[int, int, int]:
        """Tests, crashes and failed tests."""
        return self.tally.totals

    @property
    def first_reference(self) -> tuple[str, float] | None:
        """The first reference driver of the library that crashes at all, and its crash rate; None without one."""
        rates = zip(self.design.references, self.design.reference_rate.tolist(), strict=True)
        return next(((reference.name, rate) for reference, rate in rates if rate > 0.0), None)

    def weight_of_a_crash(self) -> FloatArray:
        """What a crash in each stratum adds to the rate, p_s/n_s, shape (S,)."""
        return weight_of_a_test(self.design.p, self.tally.tests)

    def limits(self, level: Level, statement: str = ASSUMPTION_FREE) -> RateLimits:
        """Rate and limits of a statement, by default of all strata."""
        return self._limits(self.design.n_within(statement), level)

    def expected(self, limit: float, driver: str | None, statement: str) -> float:
        """Crashes that a statement's tests would have brought at a limit: a rate, or a multiple of a ``driver``'s."""
        design, strata = self.design, slice(0, self.design.n_within(statement))
        if driver is not None:
            limit *= float(design.reference_rate[self._reference(driver)])
        return limit * int(self.tally.tests[strata].sum()) / float(design.p[strata].sum())

    def beside(self, driver: str, statement: str, level: Level) -> tuple[float, float]:
        """Limits of a statement's rate over a reference driver's; 0 and infinity where crashes lie on too few paths."""
        design, r = self.design, self._reference(driver)
        if design.reference_rate[r] <= 0.0:
            return 0.0, math.inf
        return beside(design, self.cells, r, design.n_within(statement), level)

    def _reference(self, driver: str) -> int:
        return [reference.name for reference in self.design.references].index(driver)

    def more_tests(self, statement: str, level: Level, rhw: float, more_runs: float) -> float:
        """Factor on the tests of each stratum, crashing as often, that would leave a relative half-width.

        Baseline runs are ``more_runs`` times as many. It is 1 if these tests are enough, infinite beyond a million.
        """
        n = self.design.n_within(statement)
        width = 2.0 * rhw * self.limits(level, statement).rate
        times = 1.0
        p, tally = self.design.p[:n], self.tally.part(slice(0, n))
        variance = pool_variance(p, tally, self.design.n_independent) / more_runs

        def limit(crashes: Counts, side: float) -> float:
            tests = np.rint(tally.tests * times).astype(np.int64)
            return likelihood_limit(p, np.minimum(crashes * times, tests), tests, level, side, variance)

        while limit(tally.crashes + tally.failed, 1.0) - max(limit(tally.crashes, -1.0), 0.0) > width:
            times *= GROWTH
            if times > MOST_TIMES:
                return math.inf
        return times

    def events_for(self, times: float) -> float:
        """Factor on the events that the pool keeps for so many ``times`` the tests; at least 1."""
        available = np.resize(self.design.available or math.inf, self.tally.tests.size)
        limited = (available > 0) & (self.tally.tests > 0)  # 0 · infinity is no number
        return max(float(np.max(self.tally.tests[limited] * times / available[limited], initial=1.0)), 1.0)

    def _limits(self, end: int, level: Level, begin: int = 0) -> RateLimits:
        """Rate and limits of strata ``begin … end - 1``; the limits are 0 and 1 where crashes lie on too few paths."""
        p, tally = self.design.p[begin:end], self.tally.part(slice(begin, end))
        limits = RateLimits(tally.rate(p), 0.0, 1.0, math.inf, math.inf)
        if not (few := paths_that_count(p, tally) < FEWEST_PATHS):
            limits = combined(p, tally, self.design.n_independent, level)
            if paths_that_count(p, tally.failed_as_crashes()) < FEWEST_PATHS:
                limits = limits._replace(high=1.0)
        testable = np.resize(self.design.available[begin:end] or 1, p.size) > 0
        # Crashes of strata that are still to be tested may lie on other paths.
        to_come = tally.runs is not None and bool((tally.tests[testable] == 0).any())
        if to_come or (few and paths_that_count(p, tally, -ROOM) >= FEWEST_PATHS):
            limits = limits._replace(from_pool_at_least=0.0)
        return limits

    def _cautions(self) -> tuple[Note, ...]:
        n = paths_that_count(self.design.p, self.tally)
        if n >= FEWEST_PATHS:
            return ()
        needed = two_digits_up(self.design.n_paths * FEWEST_PATHS / max(n, 1.0))
        return (note("few_paths", n=max(n, 1.0), of=self.design.n_paths, least=FEWEST_PATHS, needed=needed),)

    def within(self, confidence: float) -> Within:
        """What holds of a vehicle that crashes only inside the boundary."""
        design, n = self.design, self.design.n_inside
        inside, outside = self.tally.part(slice(0, n)), self.tally.part(slice(n, None))
        limits = self._limits(n, Level.two_sided(confidence))
        bound = self._limits(design.p.size, Level.of_bound(confidence, outside.totals[0]), n)
        crashed = sorted(episode for s, episodes in self._crashed.items() if s >= n for episode in episodes)
        names = "n_episodes", "n_crashes", "n_failed"
        counts: dict[str, Any] = dict(zip(names, inside.totals, strict=True))
        counts |= zip((f"{name}_outside" for name in names), outside.totals, strict=True)
        return Within(
            boundary=design.boundary, n_shells=n, crash_rate=limits.rate, ci_low=limits.low, ci_high=limits.high,
            rhw=limits.rhw, rhw_from_pool=limits.from_pool_relative()[0],
            crash_rate_if_failed_had_crashed=inside.failed_as_crashes().rate(design.p[:n]),
            refuted=outside.totals[1] > 0, refuted_by=tuple(crashed[:MOST_NAMED]),
            upper_bound_outside=bound.high, **counts,
        )  # fmt: skip

    def _shells(self, tail: float) -> tuple[Shell, ...]:
        design, tally = self.design, self.tally
        low, high = clopper_pearson(tally.crashes, tally.tests, tail, tally.failed)

        def shell(s: int, name: str) -> Shell:
            p, share = float(design.p[s]), float(tally.share[s])
            return Shell(
                shell=name, inside=s < design.n_inside, p=p, n_episodes=int(tally.tests[s]),
                n_crashes=int(tally.crashes[s]), n_failed=int(tally.failed[s]), crash_share=share,
                crash_share_low=float(low[s]), crash_share_high=float(high[s]), contribution=p * share,
            )  # fmt: skip

        return tuple(shell(s, name) for s, name in enumerate(design.strata))

    def _warnings(self, free: RateLimits) -> list[Note]:
        design, tally, notes = self.design, self.tally, list[Note]()
        if empty := [name for name, n in zip(design.strata, tally.tests, strict=True) if n == 0]:
            notes.append(note("untested", shells=empty))
        n, n_crashes, n_failed = tally.totals
        if design.shadow_runs and n_crashes and free.low <= 0.0 and free.from_pool < math.inf:
            alone, _ = free.from_pool_relative()
            notes.append(note("runs_leave_nothing", n=n_crashes, runs=design.n_paths, alone=alone))
        shells = zip(design.strata, tally.tests, design.available, strict=False)
        if used_up := [name for name, tests, available in shells if tests >= available > 0]:
            notes.append(note("used_up", shells=used_up))
        if outside := int(tally.crashes[design.n_inside :].sum()):
            notes.append(note("refuted", n=outside, boundary=design.boundary))
        if n_failed:
            notes.append(note("failed", n=n_failed, of=n))
        return notes
