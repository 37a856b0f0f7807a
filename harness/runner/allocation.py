"""How many tests each shell gets next: rounds that grow geometrically, to where they narrow the interval most.

Depends on counts alone, not on the stop rule or on time: a run can be continued to a smaller RHW. First the strata
inside the boundary are tested until the conditional statement is roughly known, some hundred tests; then all are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.arrays import BoolArray, FloatArray, IntArray
from harness.estimators.stratified import combined, share_limits
from harness.pool.shells import ShellDesign

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

    def next_round(self, tests: IntArray, crashes: IntArray, budget: int) -> IntArray:
        """Tests to add per stratum, shape (S,); all 0 when no stratum or no budget is left.

        Parameters
        ----------
        tests, crashes : ndarray, shape (S,)
            So far.
        budget : int
            Most tests to add.
        """
        active = self._active(tests, crashes) & (tests < self.available)
        wanted = np.where(active, np.maximum(self.first_tests - tests, 0), 0)
        if not wanted.any() and active.any():
            size = max(SMALLEST_ROUND, int(np.ceil(tests[self._active(tests, crashes)].sum() * (GROWTH - 1.0))))
            wanted = self._spread(min(size, budget), tests, crashes, active)
        return _within(np.minimum(wanted, self.available - tests), budget)

    def _active(self, tests: IntArray, crashes: IntArray) -> BoolArray:
        inside = np.arange(tests.size) < self.design.n_inside
        if self.conditional_only:
            return inside
        d, s = self.design, slice(0, self.design.n_inside)
        tail = (1.0 - CONFIDENCE) / 2.0
        known = combined(d.p[s], crashes[s], tests[s], d.moments[s, s], d.n_paths, tail).rhw <= CONDITIONAL_RHW
        exhausted = bool(np.all(tests[s] >= self.available[s]))
        started = bool(np.any(tests[self.design.n_inside :] > 0))
        # Without this end a vehicle that crashes rarely inside, and often outside, would not be tested outside at all.
        spent = bool(tests[s].sum() >= MOST_FIRST_TESTS * self.first_tests * self.design.n_inside)
        return np.ones_like(inside) if known or exhausted or started or spent else inside

    def _spread(self, size: int, tests: IntArray, crashes: IntArray, active: BoolArray) -> IntArray:
        """Give portions, one after the other, to where each narrows the sum of squared half-widths most."""
        low, high = share_limits(crashes, tests, (1.0 - CONFIDENCE) / 2.0)
        half_width = self.design.p * (high - low) / 2.0
        one_sided = (crashes == 0) | (crashes == tests)
        planned = tests.astype(np.float64)
        portion = max(1, size // SHARES_PER_ROUND)
        left = size
        while left > 0 and np.any(open_ := active & (planned < self.available)):
            gain = np.where(open_, _gain(half_width, one_sided, tests, planned), -1.0)
            best = int(np.argmax(gain))
            given = min(portion, left, int(self.available[best] - planned[best]))
            planned[best] += given
            left -= given
        return planned.astype(np.int64) - tests


def _gain(half_width: FloatArray, one_sided: BoolArray, tests: IntArray, planned: FloatArray) -> FloatArray:
    """Fall of the squared half-width per further test: it shrinks as 1/n, or as 1/n² where shares are all 0 or 1."""
    power = np.where(one_sided, 2.0, 1.0)
    n = np.maximum(planned, 1.0)
    gain: FloatArray = half_width**2 * (np.maximum(tests, 1) / n) ** power * power / n
    return gain


def _within(wanted: IntArray, budget: int) -> IntArray:
    """Cut a round to the budget, from the last stratum on."""
    allowed = np.minimum(np.cumsum(wanted), max(budget, 0))
    return np.diff(allowed, prepend=0)
