"""Which shells are tested next, and why: first a few tests of each, then where one more narrows the interval most."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from harness.campaign.sections import ShellSettings
from harness.estimators.likelihood import Level, spread
from harness.estimators.limits import clopper_pearson
from harness.estimators.tally import Tally, combined
from harness.strata import ASSUMPTION_FREE, ShellDesign
from harness.vocabulary import FloatArray, IntArray

GROWTH = 1.1
"""Tests after a round over tests before it; also the distance of the looks at the result."""
INNER_RHW = 0.3
"""Relative half-width inside the boundary at which testing turns to what lies outside."""
CONFIDENCE = 0.9
"""Level at which widths are compared, whatever the campaign reports."""
LEVEL = Level.two_sided(CONFIDENCE)
FIRST_TESTS = 36
"""First tests of all strata within the boundary together, each its share of the probability there."""
LEAST_FIRST_TESTS, MOST_FIRST_TESTS = 3, 12
"""Of one stratum."""
MOST_INNER_TESTS = 8
"""Testing turns to what lies outside after this many times the first tests, known or not."""
SMALLEST_ROUND = 8
ADDED = 0.25
"""Crash, and test without one, that each stratum is thought to have had besides: without it those in which the first
tests crash get all further ones, and the rate is 4 % too low for some vehicles (measured)."""
USED_UP_SHARE = 0.95
"""Share of the squared widths that must lie in exhausted strata for the allocation to end."""


def first_tests(design: ShellDesign, asked: int | None = None) -> IntArray:
    """Tests that each stratum gets before anything is decided about it, shape (S,); ``asked`` is a number for all.

    A stratum without a crash leaves about p_s/n_s open, and of several the largest counts. So tests go in proportion
    to the probability, which leaves the same open in each; further ones come where crashes are seen.
    """
    if asked is not None:
        return np.full(design.p.size, asked, np.int64)
    within = design.p[: design.n_inside].sum()
    share = np.ceil(FIRST_TESTS * design.p / within) if within > 0.0 else np.full(design.p.size, np.inf)
    return np.asarray(np.clip(share, LEAST_FIRST_TESTS, MOST_FIRST_TESTS).astype(np.int64))


@dataclass(frozen=True)
class Allocation:
    """How many tests each shell gets next.

    Strata have the probabilities ``p`` (S,), known from ``n_paths``; ``n_inside`` are inside the boundary. One gets
    ``first_tests`` before anything is decided about it, and at most those ``available``, (S,) each. With the
    ``statement`` `library` what lies outside the boundary is never tested. A round has at least ``smallest_round``
    tests, where there are as many.
    """

    p: FloatArray
    n_inside: int
    first_tests: IntArray
    available: IntArray
    statement: str = ASSUMPTION_FREE
    smallest_round: int = 1
    n_paths: float = math.inf

    @classmethod
    def of(cls, shells: ShellSettings, design: ShellDesign, available: IntArray) -> Allocation:
        """That of a campaign's ``testing.shells``."""
        first, asked = first_tests(design, shells.first_tests), (shells.statement, shells.smallest_round)
        return cls(design.p, design.n_inside, first, available, *asked, design.n_independent)

    def is_first(self, tests: IntArray, added: IntArray) -> bool:
        """Whether a round after so many tests per stratum, (S,) each, brings some that a stratum gets in any case."""
        return bool(np.any((tests < self.first_tests)[added > 0]))

    @property
    def n_asked(self) -> int:
        """Strata that may be tested, which come first."""
        return self.p.size if self.statement == ASSUMPTION_FREE else self.n_inside

    def next_round(
        self,
        tally: Tally,
        budget: int,
        *,
        inner_rhw: Callable[[int], float] | None = None,
        given_by: Callable[[int, IntArray], IntArray] | None = None,
    ) -> IntArray:
        """Tests to add per stratum, at most ``budget``; all 0 when no stratum or no budget is left.

        Failed tests widen the limits that are to be narrowed: they may have been crashes. ``inner_rhw`` gives the
        relative half-width from so many first strata, by default that of a crash rate; ``given_by`` gives so many tests
        to strata with so much room (S,) each, by default to where a crash rate is narrowed.
        """
        tests = tally.tests
        if self._used_up(tally):
            return np.zeros_like(tests)

        def of_crashes(n: int) -> float:
            return combined(self.p[:n], tally.part(slice(0, n)), self.n_paths, LEVEL).rhw

        begun = np.arange(tests.size) < self._n_begun(tests, inner_rhw or of_crashes)
        active = begun & (tests < self.available)
        wanted = np.where(active, np.maximum(self.first_tests - tests, 0), 0)
        if wanted.any():
            # Further first tests by the probability of strata, while that is all that is known of them.
            missing, p = max(self.smallest_round - int(wanted.sum()), 0), np.where(active, self.p, 0.0)
            if p.any():
                wanted = wanted + np.ceil(missing * p / p.sum()).astype(np.int64)
        elif active.any():
            size = max(SMALLEST_ROUND, self.smallest_round, int(np.ceil(tests[begun].sum() * (GROWTH - 1.0))))
            room = np.where(active, self.available - tests, 0)
            wanted = (given_by or partial(self._spread, tally))(min(size, budget), room)
        wanted = np.minimum(wanted, self.available - tests)
        return np.asarray(np.diff(np.minimum(np.cumsum(wanted), max(budget, 0)), prepend=0))  # cut from the last one on

    def _used_up(self, tally: Tally) -> bool:
        """Whether nearly all that is left to know lies in strata without further events."""
        tests, tail = tally.tests, (1.0 - CONFIDENCE) / 2.0
        low, high = clopper_pearson(tally.crashes, tests, tail, tally.failed)
        relevant = np.arange(tests.size) < self.n_asked
        squares = np.where(relevant, (self.p * (high - low)) ** 2, 0.0)
        return bool(squares[tests >= self.available].sum() >= USED_UP_SHARE * squares.sum())

    def _n_begun(self, tests: IntArray, inner_rhw: Callable[[int], float]) -> int:
        """Of how many strata it is time: of those inside the boundary while they leave much open."""
        n = min(self.n_inside, self.n_asked)
        enough = n == self.n_asked or np.any(tests[n:] > 0) or np.all(tests[:n] >= self.available[:n])
        # Without this end a vehicle that crashes rarely inside, and often outside, would not be tested outside at all.
        enough = enough or tests[:n].sum() >= MOST_INNER_TESTS * self.first_tests[:n].sum()
        return self.n_asked if enough or inner_rhw(n) <= INNER_RHW else n

    def _spread(self, tally: Tally, size: int, most: IntArray) -> IntArray:
        weights, room = np.column_stack([self.p, np.zeros_like(self.p)]), ADDED * (tally.tests > 0)
        lower, upper = (
            np.column_stack([crashes + room, tally.tests - crashes + room])
            for crashes in (tally.crashes, tally.crashes + tally.failed)
        )
        return spread(weights, lower, upper, LEVEL, size, most)


class Joined:
    """The same for pools side by side, of which the strata stand for ``p`` (S,): those inside a boundary come first.

    ``available`` are the most tests of each pool's strata.
    """

    def __init__(
        self, shells: ShellSettings, designs: Sequence[ShellDesign], p: FloatArray, available: Sequence[IntArray]
    ) -> None:
        inside = np.concatenate([np.arange(design.p.size) < design.n_inside for design in designs])
        self._order = np.argsort(~inside, kind="stable")
        self._place = np.argsort(self._order)
        self._ends = np.cumsum([design.p.size for design in designs])[:-1]
        first = np.concatenate([first_tests(design, shells.first_tests) for design in designs])
        most, n = np.concatenate(available), int(inside.sum())
        asked = shells.statement, shells.smallest_round
        self.all = Allocation(p[self._order], n, first[self._order], most[self._order], *asked)

    def next_round(
        self,
        counts: Sequence[IntArray],
        budget: int,
        inner_rhw: Callable[[], float],
        given_by: Callable[[int, IntArray], IntArray] | None = None,
    ) -> tuple[list[IntArray], bool]:
        """Tests to add per stratum of each pool, and whether they are first ones; ``counts`` see `Tally.counted`."""
        tally = Tally.counted(*(column[self._order] for column in counts))
        given = None if given_by is None else (lambda n, room: given_by(n, room[self._place])[self._order])
        added = self.all.next_round(tally, budget, inner_rhw=lambda _: inner_rhw(), given_by=given)
        return np.split(added[self._place], self._ends), self.all.is_first(tally.tests, added)
