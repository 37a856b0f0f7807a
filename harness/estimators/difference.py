"""Two vehicles on common random numbers: their rates, the difference and the ratio, from pairs of weighted outcomes.

Episode i of both campaigns has the same random numbers: the pairs are independent of each other, the two of a pair are
not. The mean of D_i = Y_A,i - Y_B,i is unbiased for the difference of the rates whatever the dependence, and its
variance is the sample variance of D_i. The lower limit of A - B is that of a B whose failed tests have all crashed
while none of A's has, the upper limit the other way round (see `FailureBounds`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, FailureBounds, finite_json, require_episodes
from harness.estimators.limits import capped_mean_upper, normal_half_width, skewed_distances
from harness.estimators.statement import warned
from harness.estimators.weighted import FEW_EFFECTIVE, Moments, Nade, WeightedSums

FEW_PAIRS = 50


@dataclass(frozen=True)
class Difference:
    """Crash rates of A and B, and how far they are apart.

    Attributes
    ----------
    a, b : Estimate
        Mean of weighted crashes of each, with its own interval.
    difference, std_error, ci_low, ci_high : float
        A - B in crashes per test; the error is that of the paired differences.
    ratio, ratio_low, ratio_high : float
        A/B with its interval (normal on the logarithm, delta method); NaN where either rate is 0. The ends are NaN also
        where no pair differs: a sample variance of 0 says nothing.
    correlation : float
        Of the two outcomes of a pair; NaN where one of them never varies.
    variance_ratio : float
        Variance of the difference from independent runs over that from pairs. Infinite where no pair differs.
    n_pairs, n_differing : int
        Pairs of episodes, and those whose weighted outcomes differ.
    n_effective : float
        (Σ|D|)²/ΣD².
    warnings : tuple of str
        Why the interval of the difference may mislead.
    """

    a: Estimate
    b: Estimate
    difference: float
    std_error: float
    ci_low: float
    ci_high: float
    ratio: float
    ratio_low: float
    ratio_high: float
    confidence: float
    correlation: float
    variance_ratio: float
    n_pairs: int
    n_differing: int
    n_effective: float
    warnings: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON content; infinite and undefined numbers become null."""
        return finite_json(asdict(self))


def paired_difference(pairs: Iterable[tuple[Block, Block]], confidence: float) -> Difference:
    """Difference of two vehicles' crash rates from blocks of the same episodes.

    Parameters
    ----------
    pairs : iterable of (Block, Block)
        The same episodes with A and with B, in any order of blocks.
    confidence : float
        Level of all intervals.

    Raises
    ------
    ValueError
        There is no pair, or blocks do not hold the same episodes.
    """
    each, seen, lowest, highest = _summed(pairs)
    require_episodes(seen.n)
    a, b = (one.result(confidence) for one in each)
    at, low, high = (sums.limits(confidence) for sums in (seen, lowest, highest))
    variance, variance_a, variance_b, covariance = seen.variances()
    spread = math.sqrt(variance_a * variance_b)
    own = (f"{name}: {text}" for name, of in (("A", a), ("B", b)) for text in of.warnings)
    return Difference(
        a=a,
        b=b,
        difference=seen.difference.mean(seen.n),
        std_error=seen.difference.std_error(seen.n),
        ci_low=min(at[0], low[0]),
        ci_high=max(at[1], high[1]),
        ratio=seen.ratio(),
        ratio_low=low[2],
        ratio_high=high[3],
        confidence=confidence,
        correlation=covariance / spread if spread > 0.0 else math.nan,
        variance_ratio=(variance_a + variance_b) / variance if variance > 0.0 else math.inf,
        n_pairs=seen.n,
        n_differing=seen.n_differing,
        n_effective=seen.distance.n_effective,
        warnings=(*own, *seen.warnings()),
    )


def _summed(pairs: Iterable[tuple[Block, Block]]) -> tuple[tuple[FailureBounds, FailureBounds], _Pairs, _Pairs, _Pairs]:
    """Estimators of A and B, and pairs as seen, with A - B as low and as high as failed tests may have made it."""
    each = FailureBounds(Nade()), FailureBounds(Nade())
    seen = lowest = highest = _Pairs()  # one and the same until a test fails
    for a, b in pairs:
        if (a.first_episode, len(a)) != (b.first_episode, len(b)):
            raise ValueError(f"episodes {a.first_episode}+{len(a)} and {b.first_episode}+{len(b)} are no pairs")
        if lowest is seen and (a.failed.any() or b.failed.any()):
            lowest, highest = deepcopy(seen), deepcopy(seen)
        seen.add(a, b)
        if lowest is not seen:
            lowest.add(a, b.failed_as_crashes())
            highest.add(a.failed_as_crashes(), b)
        each[0].add(a)
        each[1].add(b)
    return each, seen, lowest, highest


class _Pairs:
    """Sums over pairs of episodes, with failed tests as no crash; one pass, of bounded size."""

    def __init__(self) -> None:
        self.n_differing = 0
        self.difference, self.distance = Moments(), Moments()
        self._a, self._b = WeightedSums(), WeightedSums()

    @property
    def n(self) -> int:
        return self._a.n

    def add(self, a: Block, b: Block) -> None:
        self._a.add(a)
        self._b.add(b)
        apart = a.weighted_crashes() - b.weighted_crashes()
        self.n_differing += int(np.count_nonzero(apart))
        self.difference.add(apart)
        self.distance.add(np.abs(apart))

    def variances(self) -> tuple[float, float, float, float]:
        """Sample variances of D, Y_A and Y_B, and the covariance of the latter two."""
        together, a, b = (moments.variance(self.n) for moments in (self.difference, self._a.y, self._b.y))
        return together, a, b, (a + b - together) / 2.0

    def ratio(self) -> float:
        a, b = self._a.mean(), self._b.mean()
        return a / b if a > 0.0 and b > 0.0 else math.nan

    def limits(self, confidence: float) -> tuple[float, float, float, float]:
        """Lower and upper limit of the difference, and of the ratio."""
        n, difference, ratio = self.n, self.difference.mean(self.n), self.ratio()
        if self.n_differing:
            third_moment, tail = self.difference.third_moment(n), (1.0 - confidence) / 2.0
            below, above = skewed_distances(self.difference.std_error(n), third_moment, tail)
            factor = math.exp(normal_half_width(self._relative_error(), confidence))
        else:  # |D| ≤ cap in every pair, and each sign's mean has Hoeffding's bound
            cap = max(self._a.cap()[0], self._b.cap()[0])
            below = above = capped_mean_upper(0.0, cap, n, (1.0 + confidence) / 2.0)
            factor = math.nan
        return difference - below, difference + above, ratio / factor, ratio * factor

    def _relative_error(self) -> float:
        """Standard error of log(A/B), by the delta method; NaN where either rate is 0."""
        if math.isnan(self.ratio()):
            return math.nan
        a, b = self._a.mean(), self._b.mean()
        _, variance_a, variance_b, covariance = self.variances()
        spread = variance_a / a**2 + variance_b / b**2 - 2.0 * covariance / (a * b)
        return math.sqrt(max(spread, 0.0) / self.n)

    def warnings(self) -> list[str]:
        if self.n_differing == 0:
            return ["no pair of episodes differs: the interval is a bound, the vehicles may be equal"]
        if self.n_differing < FEW_PAIRS:
            return [f"only {self.n_differing} pairs differ (below {FEW_PAIRS}): the interval is rough"]
        if (effective := self.distance.n_effective) < FEW_EFFECTIVE:
            return [f"few large weights carry the difference (effective number {effective:.3g})"]
        return []


def difference_statement(found: Difference, name_a: str, name_b: str) -> str:
    """The answer in one sentence, and what pairing was worth in a second."""
    differs = found.n_differing > 0
    return (
        f"{rates_statement(found.a, found.b, name_a, name_b)}: "
        f"{apart_statement(found.difference, found.ci_low, found.ci_high, found.confidence, differs=differs)}"
        f"{_ratio(found)}, from {found.n_pairs:,} pairs of tests{_saved(found)}."
        f"{failed_pairs_statement(found.a, found.b)}"
    )


def rates_statement(a: Estimate, b: Estimate, name_a: str, name_b: str) -> str:
    """Both rates with their intervals, after what may be wrong about them."""
    cautions = [f"{name}: {text}" for name, of in (("A", a), ("B", b)) for text in of.cautions]
    return warned(
        cautions,
        f"A ({name_a}) crashes {a.crash_rate:.3g} times per test ({a.ci_low:.3g} to {a.ci_high:.3g}), "
        f"B ({name_b}) {b.crash_rate:.3g} times ({b.ci_low:.3g} to {b.ci_high:.3g})",
    )


def apart_statement(difference: float, low: float, high: float, confidence: float, *, differs: bool) -> str:
    """Which of them crashes more often, and by how much."""
    verdict = "the difference is not distinguishable from 0"
    if differs and low > 0.0:
        verdict = "A crashes more often"
    elif differs and high < 0.0:
        verdict = "A crashes less often"
    return f"{verdict}, A - B = {difference:.3g} ({confidence:.0%} interval {low:.3g} to {high:.3g})"


def _ratio(found: Difference) -> str:
    if not math.isfinite(found.ratio):
        return ""
    if math.isnan(found.ratio_low) or math.isnan(found.ratio_high):
        return f", A/B = {found.ratio:.3g} (its interval is not known: no pair differs)"
    return f", A/B = {found.ratio:.3g} ({found.ratio_low:.3g} to {found.ratio_high:.3g})"


def _saved(found: Difference) -> str:
    if not math.isfinite(found.variance_ratio):
        return ""
    times = f"{found.variance_ratio:.3g}"
    return f"; independent runs would need {'as many' if times == '1' else f'{times} times as many'}"


def failed_pairs_statement(a: Estimate, b: Estimate) -> str:
    """How failed tests count; nothing where none has failed."""
    of_a, of_b = a.details["n_failed"], b.details["n_failed"]
    if not of_a and not of_b:
        return ""
    return (
        f" Of these tests A FAILED in {of_a:,} and B in {of_b:,}: each limit counts them as crashes or as none, "
        "whichever takes it farther."
    )
