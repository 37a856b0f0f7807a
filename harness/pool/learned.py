"""A surrogate that is learned from the vehicle itself: what it does behind another one, from a few pilot tests.

Outside the library's boundary crashes are rare, and a vehicle that has some there has them somewhere in a stratum of
thousands of events on which nothing happens. A surrogate that drives as the vehicle does says where. How well it was
learned changes the number of tests, never what is estimated: its shell is fixed before the first test that counts, and
the pilot tests do not.

Its acceleration is a_t = ρ a_(t-1) + (1 - ρ) f(gap, closing speed), both as they were a dead time earlier; until the
event has been seen it goes on as in the baseline run. Table, ρ and dead time are those that predict the pilot's
accelerations best.
"""

from __future__ import annotations

import hashlib
import math
from typing import NamedTuple

import numpy as np

from harness.compiled import compiled_inline, compiled_threads, unboxed
from harness.families.protocol import Recorded
from harness.vehicles.kinematics import STEP_S, gap, next_position, next_speed
from harness.vocabulary import FloatArray, IntArray

NEAR_M, NEAR_BIN_M, FAR_RATIO = 3.0, 0.1, 1.06
"""Gaps are told apart by 0.1 m up to 3 m, then by 6 %."""
GAP_BINS, CLOSING_BINS = 96, 300
"""Up to 140 m."""
SLOWEST_MPS, CLOSING_BIN_MPS = -10.0, 0.1
LAGS = (0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9)
LONGEST_DEAD_STEPS = 12
FAR_OFF_M = 2.0
"""A retraced test counts as no worse than this."""


class Learned(NamedTuple):
    """What was learned of how many tests: ``table`` (GAP_BINS, CLOSING_BINS) of f (m/s²), ρ, and dead time in steps."""

    table: FloatArray
    lag: float
    dead_steps: int
    n_tests: int

    @property
    def in_words(self) -> str:
        """What is not in the table."""
        lag = f", with {self.lag:g} of its last acceleration" if self.lag else ""
        late = f"{self.dead_steps * STEP_S:.1f} s after what it sees" if self.dead_steps else "at once"
        return f"it acts {late}{lag}"

    def digest(self) -> str:
        """Hash of all of it."""
        return hashlib.sha256(self.table.tobytes() + repr(self[1:]).encode()).hexdigest()


class Following(NamedTuple):
    """Motion of tests (n,) from the step after the onset of the event, ``first``, to the ``last`` that is on record.

    ``shadow`` (n,) are the baseline runs that they repeat. Positions (m) and speeds (m/s) of the AV and of the
    principal vehicle are (n, steps + 1) each, undefined elsewhere.
    """

    shadow: IntArray
    first: IntArray
    last: IntArray
    x_av: FloatArray
    v_av: FloatArray
    x_ahead: FloatArray
    v_ahead: FloatArray


@compiled_inline
def bin_of(ahead: float, closing: float) -> tuple[int, int]:
    """Place of a gap (m) and a closing speed (m/s) in the table."""
    near = int(max(ahead, 0.0) / NEAR_BIN_M)
    if ahead >= NEAR_M:
        near = int(NEAR_M / NEAR_BIN_M + 0.5) + int(math.log(ahead / NEAR_M) / math.log(FAR_RATIO))
    fast = int(max((closing - SLOWEST_MPS) / CLOSING_BIN_MPS, 0.0))
    return min(near, GAP_BINS - 1), min(fast, CLOSING_BINS - 1)


@compiled_threads
def _bins_of(tests: Following, place: IntArray) -> None:
    """Bins of all that was seen, (n, steps), as places in the flat table."""
    for i in range(tests.first.size):
        for step in range(tests.first[i], tests.last[i]):
            ahead = gap(tests.x_ahead[i, step], tests.x_av[i, step])
            g, c = bin_of(ahead, tests.v_av[i, step] - tests.v_ahead[i, step])
            place[i, step] = g * CLOSING_BINS + c


@compiled_inline
def respond(
    learned: Learned, a: float, step: int, first: int, wanted: FloatArray, n_steps: int, v_run: FloatArray
) -> float:
    """Acceleration (m/s²) in a step after ``a`` in the last one; that of the baseline run until it can be another."""
    if step >= first + learned.dead_steps:
        return float(learned.lag * a + (1.0 - learned.lag) * wanted[step - learned.dead_steps])
    return float((v_run[step + 1] - v_run[step]) / STEP_S) if step < n_steps else a


@compiled_threads
def _retrace(learned: Learned, tests: Following, runs: Recorded, error: FloatArray) -> None:
    """How far (m) from the vehicle its surrogate is at the end of each test (n,)."""
    wanted = np.zeros(tests.x_av.shape[1])
    for i in range(tests.first.size):
        first, last = tests.first[i], tests.last[i]
        x, v, run = tests.x_av[i, first], tests.v_av[i, first], tests.shadow[i]
        a = (v - tests.v_av[i, first - 1]) / STEP_S
        for step in range(first, last):
            wanted[step] = learned.table[bin_of(gap(tests.x_ahead[i, step], x), v - tests.v_ahead[i, step])]
            a = respond(learned, a, step, first, wanted, runs.n_steps[run], runs.v_mps[run])
            v_after = next_speed(v, a)
            x, v = next_position(x, v, v_after), v_after
        error[i] = abs(x - tests.x_av[i, last])


def learn(tests: Following, runs: Recorded) -> Learned:
    """Learn the vehicle from tests in which it followed somebody.

    Of tables from every other test that one is taken with which the tests in between are retraced best.
    """
    step, acceleration = np.arange(tests.x_av.shape[1] - 1), np.diff(tests.v_av, axis=1) / STEP_S
    place = np.zeros(acceleration.shape, np.int64)
    _bins_of(unboxed(tests), place)

    def fitted(tests_of: IntArray, lag: float, dead: int) -> Learned:
        known = (step >= tests.first[tests_of, None] + dead) & (step < tests.last[tests_of, None])
        row, t = np.nonzero(known)
        row = tests_of[row]
        wanted = (acceleration[row, t] - lag * acceleration[row, t - 1]) / (1.0 - lag)
        return Learned(_filled(place[row, t - dead], wanted), lag, dead, tests_of.size)

    everyone = np.arange(tests.first.size)
    best = math.inf, 0.0, 0
    for dead in range(LONGEST_DEAD_STEPS + 1):
        for lag in LAGS:
            error = np.zeros(everyone.size)
            _retrace(fitted(everyone[::2], lag, dead), unboxed(tests), unboxed(runs), error)
            best = min(best, (float(np.minimum(error[1::2], FAR_OFF_M).sum()), lag, dead))
    return fitted(everyone, *best[1:])


def _filled(seen: IntArray, wanted: FloatArray) -> FloatArray:
    """Mean of each bin, and of those that nobody has met the nearest other's."""
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - only a vehicle that is learned needs it

    n = np.bincount(seen, minlength=GAP_BINS * CLOSING_BINS).reshape(GAP_BINS, CLOSING_BINS)
    mean = np.bincount(seen, wanted, minlength=n.size).reshape(n.shape) / np.maximum(n, 1)
    nearest = distance_transform_edt(n == 0, return_distances=False, return_indices=True)
    return np.ascontiguousarray(mean[tuple(nearest)])
