"""How hard a vehicle crashes: the rate of crashes above each impact speed, from the same tests.

The impact speed is the closing speed at contact, v_AV - v_BV. The rate above a speed is that of the method's own
estimator with only the harder crashes as crashes, so that its limits promise what those of the rate do, at each speed
for itself. A failed test may have been a crash of any speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harness.estimators.beside import share_of_crashes
from harness.estimators.block import Block
from harness.estimators.estimate import Accumulator, Number
from harness.estimators.likelihood import Level
from harness.estimators.shells import SeenShells
from harness.vocabulary import FloatArray

SPEEDS_MPS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0)
"""At which the rate is asked; at 0, or at what the campaign counts from, all crashes count."""
TOUCH_MPS, HARD_MPS = 1.0, 5.0
"""Below the first a crash is a touch at walking pace; shares of the rate are told below it and above the second."""


@dataclass(frozen=True)
class Exceedance:
    """Rate per test of crashes with an impact above a speed, its interval and one-sided upper bound."""

    above_mps: float
    crash_rate: float
    ci_low: Number
    ci_high: Number
    upper_bound: Number
    n_crashes: int


@dataclass(frozen=True)
class Severity:
    """Impact speeds of the crashes, each counted by what it adds to the rate.

    ``median_mps`` and ``p95_mps`` are quantiles of the speed, ``share_below_1_mps`` and ``share_above_5_mps`` shares of
    the rate, with ``limits`` in runs of shells; ``exceedance`` has a row for each of the `SPEEDS_MPS` that count.
    """

    median_mps: float
    p95_mps: float
    share_below_1_mps: float
    share_above_5_mps: float
    exceedance: tuple[Exceedance, ...]
    limits_below_1_mps: tuple[float, float] | None = None
    limits_above_5_mps: tuple[float, float] | None = None


class Impacts:
    """Running state: an accumulator, made by ``empty``, for each speed; and impact speeds with weights."""

    def __init__(self, empty: Callable[[], Accumulator], counts_above_mps: float = 0.0) -> None:
        speeds = [counts_above_mps, *(speed for speed in SPEEDS_MPS if speed > counts_above_mps)]
        self._above = {speed: empty() for speed in speeds}
        self._first = counts_above_mps
        self._crashes: list[tuple[FloatArray, FloatArray]] = []
        self._cut_off: list[FloatArray] = []
        self.cut_off_test: int | None = None  # the first
        self._n = 0

    def add(self, block: Block) -> None:
        self._n += len(block)
        crash = block.crash
        weight = np.asarray(block.stratum if block.drawn.shells is not None else np.exp(block.log_weight), np.float64)
        self._crashes.append((block.impact_mps[crash], weight[crash]))
        cut_off = block.columns.get("cut_off", np.zeros(len(block), np.bool_))
        self._cut_off.append(weight[cut_off])
        if self.cut_off_test is None and cut_off.any():
            self.cut_off_test = block.first_episode + int(cut_off.argmax())
        for speed, state in self._above.items():
            state.add(block if speed == self._first else block.harder_than(speed))

    def result(self, confidence: float) -> Severity | None:
        """Of the episodes so far; None without a crash."""
        impact, weight = (np.concatenate(column) for column in zip(*self._crashes, strict=True))
        if not impact.size:
            return None
        every = self._above[self._first]
        limits: list[tuple[float, float] | None] = [None, None]
        if isinstance(every, SeenShells):
            level, per_crash = Level.two_sided(confidence), every.weight_of_a_crash()
            weight = per_crash[weight.astype(np.int64)]
            for k, (speed, softer) in enumerate(((TOUCH_MPS, True), (HARD_MPS, False))):
                if isinstance(harder := self._above.get(speed), SeenShells):
                    limits[k] = share_of_crashes(every.design, every.tally, harder.tally, level, of_the_others=softer)
        if not weight.any():  # too small for a number
            return None
        total, median, high = float(weight.sum()), *weighted_quantiles(impact, weight, (0.5, 0.95))
        below, above = (float(weight[rows].sum()) / total for rows in (impact <= TOUCH_MPS, impact > HARD_MPS))
        rows = tuple(_exceedance(speed, state, confidence) for speed, state in self._above.items())
        return Severity(median, high, below, above, rows, limits[0], limits[1])

    def cut_off(self) -> float:
        """Rate of tests that ended with the AV about to crash (`Block`), whether or not any has crashed."""
        every, weight = self._above[self._first], np.concatenate(self._cut_off)
        if isinstance(every, SeenShells):
            return float(every.weight_of_a_crash()[weight.astype(np.int64)].sum())
        return float(weight.sum()) / self._n


def _exceedance(speed: float, state: Accumulator, confidence: float) -> Exceedance:
    if not isinstance(state, SeenShells):
        mean = state.result(confidence)
        return Exceedance(speed, mean.crash_rate, mean.ci_low, mean.ci_high, mean.upper_bound, mean.n_crashes)
    n, n_crashes, _ = state.tally.totals
    limits = state.limits(Level.two_sided(confidence))
    bound = state.limits(Level.of_bound(confidence, n)).high
    return Exceedance(speed, limits.rate, limits.low, limits.high, bound, n_crashes)


def weighted_quantiles(values: FloatArray, weights: FloatArray, quantiles: tuple[float, ...]) -> list[float]:
    """Values up to which these shares of the weight lie; NaN without weight."""
    if not weights.any():
        return [math.nan] * len(quantiles)
    places: list[float] = np.quantile(values, quantiles, method="inverted_cdf", weights=weights).tolist()
    return places
