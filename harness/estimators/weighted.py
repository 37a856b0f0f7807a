"""Means of weighted crashes: `nade` ([paper] section II-B), and `nde`, the share of crashes (II-A).

`Nade` is also the part that all estimators of a mean of Y = 1{crash}·weight have in common. It holds what decides
whether one can be trusted: how many crashes carry it, how unevenly, and which cap their weights have by design.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import CapKind, Estimate, Note, note
from harness.estimators.limits import capped_mean_upper, clopper_pearson, skewed_distances
from harness.vocabulary import FloatArray

FEW_CRASHES = 50
FEW_EFFECTIVE = 30.0
FEW_FOR_RESIDUALS = 300.0
"""Effective crashes below which residuals of a regression claim too little; the interval is then as wide as that of the
plain mean. Overtaking in the twin, 90 %: `mixture_cv` covers 0.88 at 140 of them, 0.85 at 40 (3,000 replications)."""
LARGE_SHARE = 0.1
OVERTURNS = 1.0
"""One more crash of the largest known weight, over all those seen, above which an interval is not to be trusted: a
single test could double the rate. Default IDM under forced events, nominal 0.90: where nearly all campaigns are above
(500 and 2,000 tests) intervals cover 0.73 and 0.87, where nearly all are below (25,000) 0.91 (docs/estimators.md)."""
LARGEST_LOG = 700.0
"""Of a number that is still one, and not infinite."""


@dataclass(frozen=True)
class Moments:
    """Number of values, Σx (exact for counts), Σ(x - x̄)² and Σ(x - x̄)³; of numbers that come in blocks, by adding up.

    Moments are joined without the cancellation of Σx² - (Σx)²/n (T. F. Chan, G. H. Golub and R. J. LeVeque, The
    American Statistician 37, 1983, 242; third moments: P. Pébay, Sandia report SAND2008-6212); how numbers are cut into
    blocks shows in the last digits. Where a larger n is asked for, what was never added counts as zeros.
    """

    n: int = 0
    total: float = 0.0
    second: float = 0.0
    third: float = 0.0

    @classmethod
    def of(cls, values: FloatArray) -> Moments:
        """Those of one block; what rounding the mean has left in the distances from it is taken out again."""
        if not len(values):
            return cls()
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            total = float(np.sum(values))
            if not math.isfinite(total):
                return cls(len(values), total, math.nan, math.nan)
            away = values - total / len(values)
            away -= np.mean(away)
            squares = away * away  # summed by numpy alone: how BLAS adds depends on the number of its threads
            return cls(len(values), total, float(np.sum(squares)), float(np.sum(squares * away)))

    def __add__(self, other: Moments) -> Moments:
        if not self.n or not other.n:
            return self if self.n else other
        n, total = self.n + other.n, self.total + other.total
        distance = other.total / other.n - self.total / self.n
        if not math.isfinite(distance):
            return Moments(n, total, math.nan, math.nan)
        spread = distance * distance * self.n * (other.n / n)
        third = self.third + other.third + spread * distance * ((self.n - other.n) / n)
        third += 3.0 * distance * (self.n * other.second - other.n * self.second) / n
        return Moments(n, total, self.second + other.second + spread, third)

    @property
    def squares(self) -> float:
        """Σx²."""
        return self.second + self.total * (self.total / self.n) if self.n else 0.0

    @property
    def n_effective(self) -> float:
        """(Σx)²/Σx², 0 where all numbers are."""
        return self.total**2 / self.squares if self.squares > 0.0 else 0.0

    def mean(self, n: int) -> float:
        """Σx/n."""
        return self.total / n

    def variance(self, n: int) -> float:
        """Sample variance; infinite for n < 2, and where a number or its square is."""
        second = (self + Moments(n - self.n)).second
        return second / (n - 1) if n > 1 and math.isfinite(second) else math.inf

    def std_error(self, n: int) -> float:
        """Of the mean."""
        return math.sqrt(self.variance(n) / n)

    def third_moment(self, n: int) -> float:
        """Third central moment of the mean, Σ(x - x̄)³/n³; 0 where it is not finite."""
        third = (self + Moments(n - self.n)).third / n**3 if n else 0.0
        return third if math.isfinite(third) else 0.0


class Nade:
    """Mean of Y = 1{crash}·weight. Unbiased for every method of drawing; without control it is the crash share.

    One pass keeps running moments ``y`` of Y, numbers of episodes and crashes, and the largest weights.
    """

    def __init__(self) -> None:
        self.n = self.n_crashes = 0
        self.y = Moments()
        self._largest_y = self._design_cap = self._log_cap = -math.inf

    def add(self, block: Block) -> None:
        weights = np.exp(block.log_weight[block.crash])
        self.n += len(block)
        self.n_crashes += len(weights)
        self.y += Moments.of(weights)
        self._largest_y = float(np.max(weights, initial=self._largest_y))
        self._design_cap = max(self._design_cap, math.inf if (cap := block.drawn.weight_cap) is None else cap)
        self._log_cap = max(self._log_cap, block.log_cap())

    def largest_share(self) -> float:
        """Largest Y as a share of ΣY, 0 without a crash."""
        return self._largest_y / self.y.total if self.y.total > 0.0 else 0.0

    def cap(self) -> tuple[float, CapKind]:
        """Largest Y that the tests could have had, whatever the AV does, and what that rests on: else infinite.

        Where the design has none it is that of all tests driven (`Block.log_cap`), with a crash or without.
        """
        if math.isfinite(self._design_cap):
            return max(self._design_cap, self._largest_y), "design"
        if self._log_cap < LARGEST_LOG:
            return max(math.exp(self._log_cap), self._largest_y), "tests"
        return math.inf, "none"

    def is_settled(self) -> bool:
        """Whether there are enough crashes for limits from moments to mean what they say."""
        return self.n_crashes >= FEW_CRASHES and self.y.n_effective >= FEW_EFFECTIVE

    def _few_crashes(self) -> list[Note]:
        return [note("few_crashes", n=self.n_crashes, least=FEW_CRASHES)] if self.n_crashes < FEW_CRASHES else []

    def cautions(self) -> list[Note]:
        """Why an interval around a mean of these Y may be wrong."""
        notes = []
        if math.isfinite(self._design_cap) and self._largest_y > self._design_cap * (1.0 + 1e-9):
            notes.append(note("contradicts_design", weight=self._largest_y, cap=self._design_cap))
        cap, _ = self.cap()
        if not math.isfinite(cap):
            notes.append(note("unbounded"))
        elif self.n_crashes and (times := cap / self.y.total) > OVERTURNS:
            more = note("one_may_weigh", cap=cap, seen=self.y.total), note("one_more_adds", times=times)
            notes.append(more[0] if cap > 1.0 else more[1])
        return notes

    def warnings(self, half_width: float) -> list[Note]:
        """What else a reader of a mean of these Y should know, beside an interval of this half-width."""
        notes, effective, (cap, origin) = self._few_crashes(), self.y.n_effective, self.cap()
        if 0.0 < effective < FEW_EFFECTIVE:
            notes.append(note("few_effective", n=effective, least=FEW_EFFECTIVE))
        if self.largest_share() > LARGE_SHARE:
            notes.append(note("one_carries", share=self.largest_share()))
        if origin == "tests" and not self.is_settled():
            notes.append(note("bound_rests", cap=origin))
        if 0.0 < half_width < cap / self.n <= OVERTURNS * self.y.mean(self.n):  # beyond that there is a caution
            notes.append(note("one_more_moves", by=cap / self.n))
        return notes

    def result(self, confidence: float) -> Estimate:
        """Mean of Y with its interval."""
        errors = self.y.std_error(self.n), self.y.third_moment(self.n)
        return self.estimate(self.y.mean(self.n), *errors, confidence)

    def estimate(
        self,
        rate: float,
        std_error: float,
        third_moment: float | None,
        confidence: float,
        *,
        details: Mapping[str, Any] | None = None,
        warnings: Sequence[Note] = (),
        cautions: Sequence[Note] = (),
    ) -> Estimate:
        """Estimate with an interval around `rate` that is as skewed as its error, and a one-sided upper bound.

        The bound is the interval's own where crashes are many enough, else Hoeffding's for the mean of capped Y, which
        holds at every n. Without a crash the interval is [0, two-sided Hoeffding bound]. ``third_moment`` is that of
        the error of ``rate``; None for a plain normal interval.
        """
        cap, origin = self.cap()
        hoeffding = capped_mean_upper(self.y.mean(self.n), cap, self.n, confidence)
        tail = (1.0 - confidence) / 2.0
        below, above = skewed_distances(std_error, third_moment or 0.0, tail)
        if self.n_crashes == self.n:  # equal weights then show no spread
            below = max(below, rate * (1.0 - float(clopper_pearson(self.n, self.n, tail)[0])))
        low, high, half = min(max(0.0, rate - below), 1.0), min(max(0.0, rate + above), 1.0), (below + above) / 2.0
        if self.n_crashes == 0:
            low, high = 0.0, capped_mean_upper(0.0, cap, self.n, (1.0 + confidence) / 2.0)
        upper, settled = hoeffding, self.is_settled()
        if settled:
            upper = min(1.0, rate + skewed_distances(std_error, third_moment or 0.0, 1.0 - confidence)[1])
        negative = () if rate >= 0.0 else (note("negative"),)
        cautions = (*cautions, *negative, *self.cautions())
        return Estimate(
            crash_rate=min(rate, 1.0), std_error=std_error, ci_low=low, ci_high=high, upper_bound=upper,
            rhw=half / rate if rate > 0.0 else math.inf, n_episodes=self.n, n_crashes=self.n_crashes,
            confidence=confidence, n_effective=self.y.n_effective, largest_weight_share=self.largest_share(),
            interval="normal" if third_moment is None else "skewed", bound="one_sided" if settled else "hoeffding",
            cap=origin, weight_cap=cap, cautions=cautions,
            warnings=(*cautions, *self.warnings(half), *warnings),
            details={"upper_bound_hoeffding": hoeffding, **(details or {})},
        )  # fmt: skip


class Nde(Nade):
    """Share of crashes among naturalistic tests, with the Clopper-Pearson interval."""

    def result(self, confidence: float) -> Estimate:
        """Share of crashes; its relative half-width is half the interval's length over the rate."""
        rate = self.n_crashes / self.n
        low, high = map(float, clopper_pearson(self.n_crashes, self.n, (1.0 - confidence) / 2.0))
        return Estimate(
            crash_rate=rate, std_error=math.sqrt(rate * (1.0 - rate) / self.n), ci_low=low, ci_high=high,
            upper_bound=float(clopper_pearson(self.n_crashes, self.n, 1.0 - confidence)[1]), confidence=confidence,
            rhw=(high - low) / 2.0 / rate if rate > 0.0 else math.inf, n_episodes=self.n, n_crashes=self.n_crashes,
            n_effective=float(self.n_crashes), largest_weight_share=1.0 / self.n_crashes if self.n_crashes else 0.0,
            interval="clopper_pearson", bound="one_sided", cap="design", weight_cap=1.0,
            warnings=tuple(self._few_crashes()),
        )  # fmt: skip
