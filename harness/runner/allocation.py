"""How many tests each shell gets next: rounds that grow geometrically, to where they narrow the interval most.

Depends on counts alone, not on the stop rule or on time: a run can be continued to a smaller RHW. First the strata
inside the boundary are tested until the conditional statement is roughly known, some hundred tests; then all are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.arrays import BoolArray, FloatArray, IntArray
from harness.estimators.intervals import clopper_pearson
from harness.estimators.shells import combined
from harness.strata import ShellDesign

GROWTH = 1.25
"""Tests after a round over tests before it; also the distance of the looks at the result."""
CONDITIONAL_RHW = 0.3
"""Relative half-width of the conditional statement at which testing turns to what lies outside."""
CONFIDENCE = 0.9
"""Level at which widths are compared, whatever the campaign reports."""
MOST_FIRST_TESTS = 4
"""Testing turns to what lies outside after this many times the first tests, known or not."""
SMALLEST_ROUND = 8
SHARES_PER_ROUND = 32
USED_UP_SHARE = 0.95
"""Share of the squared widths that must lie in exhausted strata for the allocation to end."""


@dataclass(frozen=True)
class Allocation:
    """Rule of a campaign.

    Attributes
    ----------
    design : ShellDesign
    first_tests : int
        Tests of a stratum before anything is decided about it.
    available : ndarray, shape (S,)
        Most tests of each stratum.
    conditional_only : bool
        Whether what lies outside is never tested.
    """

    design: ShellDesign
    first_tests: int
    available: IntArray
    conditional_only: bool

    def next_round(self, tests: IntArray, crashes: IntArray, budget: int, failed: IntArray | int = 0) -> IntArray:
        """Tests to add per stratum, shape (S,); all 0 when no stratum or no budget is left.

        Parameters
        ----------
        tests, crashes, failed : ndarray, shape (S,)
            So far. Failed tests widen the limits that are to be narrowed: they may have been crashes.
        budget : int
            Most tests to add.
        """
        failed = np.zeros_like(tests) + failed
        if self._used_up(tests, crashes, failed):
            return np.zeros_like(tests)
        begun = self._active(tests, crashes, failed)
        active = begun & (tests < self.available)
        wanted = np.where(active, np.maximum(self.first_tests - tests, 0), 0)
        if not wanted.any() and active.any():
            size = max(SMALLEST_ROUND, int(np.ceil(tests[begun].sum() * (GROWTH - 1.0))))
            wanted = self._spread(min(size, budget), tests, crashes, failed, active)
        return _within(np.minimum(wanted, self.available - tests), budget)

    def _used_up(self, tests: IntArray, crashes: IntArray, failed: IntArray) -> bool:
        """Whether nearly all that is left to know lies in strata without further cut-ins."""
        low, high = clopper_pearson(crashes, tests, (1.0 - CONFIDENCE) / 2.0, failed)
        relevant = np.arange(tests.size) < (self.design.n_inside if self.conditional_only else tests.size)
        squares = np.where(relevant, (self.design.p * (high - low)) ** 2, 0.0)
        return bool(squares[tests >= self.available].sum() >= USED_UP_SHARE * squares.sum())

    def _active(self, tests: IntArray, crashes: IntArray, failed: IntArray) -> BoolArray:
        inside = np.arange(tests.size) < self.design.n_inside
        if self.conditional_only:
            return inside
        d, s = self.design, slice(0, self.design.n_inside)
        tail = (1.0 - CONFIDENCE) / 2.0
        inner = combined(d.p[s], crashes[s], tests[s], d.moments[s, s], d.n_paths, tail, failed[s])
        known = inner.rhw <= CONDITIONAL_RHW
        exhausted = bool(np.all(tests[s] >= self.available[s]))
        started = bool(np.any(tests[self.design.n_inside :] > 0))
        # Without this end a vehicle that crashes rarely inside, and often outside, would not be tested outside at all.
        spent = bool(tests[s].sum() >= MOST_FIRST_TESTS * self.first_tests * self.design.n_inside)
        return np.ones_like(inside) if known or exhausted or started or spent else inside

    def _spread(self, size: int, tests: IntArray, crashes: IntArray, failed: IntArray, active: BoolArray) -> IntArray:
        """Give portions, one after the other, to where each narrows the sum of squared half-widths most."""
        low, high = clopper_pearson(crashes, tests, (1.0 - CONFIDENCE) / 2.0, failed)
        half_width = self.design.p * (high - low) / 2.0
        gain = _Gain(half_width, (crashes + failed == 0) | (crashes == tests), tests)
        room = np.where(active, self.available - tests, 0).tolist()
        given = [0] * tests.size
        portion = max(1, size // SHARES_PER_ROUND)
        left = size
        value = [gain.at(s, 0) if room[s] > 0 else -1.0 for s in range(tests.size)]
        while left > 0 and max(value) >= 0.0:
            best = value.index(max(value))
            more = min(portion, left, room[best] - given[best])
            given[best] += more
            left -= more
            value[best] = gain.at(best, given[best]) if given[best] < room[best] else -1.0
        return np.array(given, np.int64)


class _Gain:
    """Fall of the squared half-width per further test: it shrinks as 1/n, or as 1/n² where shares are all 0 or 1."""

    def __init__(self, half_width: FloatArray, one_sided: BoolArray, tests: IntArray) -> None:
        self._tests = tests.tolist()
        self._power = np.where(one_sided, 2, 1).tolist()
        self._scale = (half_width**2).tolist()

    def at(self, stratum: int, given: int) -> float:
        """Gain of one more test after ``given`` further ones."""
        power, tests = self._power[stratum], max(self._tests[stratum], 1)
        n = max(self._tests[stratum] + given, 1)
        return float(self._scale[stratum] * (tests / n) ** power * power / n)


def _within(wanted: IntArray, budget: int) -> IntArray:
    """Cut a round to the budget, from the last stratum on."""
    allowed = np.minimum(np.cumsum(wanted), max(budget, 0))
    return np.diff(allowed, prepend=0)
