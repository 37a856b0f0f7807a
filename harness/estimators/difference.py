"""Two vehicles on common random numbers: their rates, the difference and the ratio, from pairs of weighted outcomes.

Episode i of both campaigns has the same random numbers, so Y_A,i and Y_B,i go together: the pairs are independent of
each other, the two of a pair are not. The mean of D_i = Y_A,i - Y_B,i is unbiased for the difference of the rates
whatever the dependence, and its variance is the sample variance of D_i: Var(Y_A) + Var(Y_B) - 2 Cov(Y_A, Y_B). What
the covariance takes away is what pairing saves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from harness.estimators.accumulator import require_episodes
from harness.estimators.block import Block
from harness.estimators.both_ways import BothWays
from harness.estimators.estimate import Estimate, finite_json
from harness.estimators.intervals import capped_mean_upper, normal_half_width, skewed_distances
from harness.estimators.moments import Moments
from harness.estimators.nade import Nade
from harness.estimators.statement import warned

FEW_PAIRS = 50
FEW_EFFECTIVE = 30.0


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
        Variance of the difference from independent runs over that from pairs: so many times as many tests would
        independent runs need. Infinite where no pair differs.
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
        content: dict[str, Any] = finite_json(asdict(self))
        return content


class _Pairs:
    """Sums over pairs of episodes; one pass, of bounded size."""

    def __init__(self) -> None:
        self.n = 0
        self.n_differing = 0
        self._each = (Nade(), Nade())
        self._difference = Moments()
        self._distance = Moments()

    def add(self, a: Block, b: Block) -> None:
        """Add pairs of episodes.

        Raises
        ------
        ValueError
            The blocks do not hold the same episodes.
        """
        if (a.first_episode, len(a)) != (b.first_episode, len(b)):
            raise ValueError(f"episodes {a.first_episode}+{len(a)} and {b.first_episode}+{len(b)} are no pairs")
        self._each[0].add(a)
        self._each[1].add(b)
        apart = a.weighted_crashes() - b.weighted_crashes()
        self.n += len(a)
        self.n_differing += int(np.count_nonzero(apart))
        self._difference.add(apart)
        self._distance.add(np.abs(apart))

    def result(self, confidence: float) -> Difference:
        """Rates, difference and ratio of the pairs so far.

        Raises
        ------
        ValueError
            No pair was added.
        """
        require_episodes(self.n)
        a, b = (nade.result(confidence) for nade in self._each)
        variance_a, variance_b = (nade.sums.y.variance(self.n) for nade in self._each)
        variance = self._difference.variance(self.n)
        covariance = (variance_a + variance_b - variance) / 2.0
        difference = self._difference.mean(self.n)
        std_error = self._difference.std_error(self.n)
        below = above = self._half_without_difference(confidence)
        if self.n_differing:
            third_moment = self._difference.third_moment(self.n)
            below, above = skewed_distances(std_error, third_moment, (1.0 - confidence) / 2.0)
        relative = math.nan
        if self.n_differing:
            relative = _relative_error(a.crash_rate, b.crash_rate, variance_a, variance_b, covariance, self.n)
        ratio = a.crash_rate / b.crash_rate if a.crash_rate > 0.0 and b.crash_rate > 0.0 else math.nan
        factor = math.exp(normal_half_width(relative, confidence))
        spread = math.sqrt(variance_a * variance_b)
        return Difference(
            a=a,
            b=b,
            difference=difference,
            std_error=std_error,
            ci_low=difference - below,
            ci_high=difference + above,
            ratio=ratio,
            ratio_low=ratio / factor,
            ratio_high=ratio * factor,
            confidence=confidence,
            correlation=covariance / spread if spread > 0.0 else math.nan,
            variance_ratio=(variance_a + variance_b) / variance if variance > 0.0 else math.inf,
            n_pairs=self.n,
            n_differing=self.n_differing,
            n_effective=self._n_effective(),
            warnings=tuple(self._warnings()),
        )

    def _half_without_difference(self, confidence: float) -> float:
        """Half-width when no pair differs: then |D| ≤ cap in every pair, and each sign's mean has Hoeffding's bound."""
        cap = max(nade.sums.cap()[0] for nade in self._each)
        return capped_mean_upper(0.0, cap, self.n, (1.0 + confidence) / 2.0)

    def _n_effective(self) -> float:
        squares = self._distance.squares
        return self._distance.total**2 / squares if squares > 0.0 else 0.0

    def _warnings(self) -> list[str]:
        found = []
        if self.n_differing == 0:
            found.append("no pair of episodes differs: the interval is a bound, the vehicles may be equal")
        elif self.n_differing < FEW_PAIRS:
            found.append(f"only {self.n_differing} pairs differ (below {FEW_PAIRS}): the interval is rough")
        elif self._n_effective() < FEW_EFFECTIVE:
            found.append(f"few large weights carry the difference (effective number {self._n_effective():.3g})")
        return found


class PairedSums:
    """Pairs of episodes, and from the first failed one on also the two ways in which A and B may be farthest apart.

    The lower limit of A - B is that of a B whose failed tests have all crashed while none of A's has, the upper limit
    the other way round (see `BothWays`).
    """

    def __init__(self) -> None:
        self._each = (BothWays(Nade()), BothWays(Nade()))
        self._seen = _Pairs()
        self._farthest: tuple[_Pairs, _Pairs] | None = None

    def add(self, a: Block, b: Block) -> None:
        """Add pairs of episodes.

        Raises
        ------
        ValueError
            The blocks do not hold the same episodes.
        """
        if self._farthest is None and (a.failed.any() or b.failed.any()):
            self._farthest = deepcopy(self._seen), deepcopy(self._seen)
        self._seen.add(a, b)
        if self._farthest is not None:
            self._farthest[0].add(a, b.failed_as_crashes())
            self._farthest[1].add(a.failed_as_crashes(), b)
        for each, block in zip(self._each, (a, b), strict=True):
            each.add(block)

    def result(self, confidence: float) -> Difference:
        """Rates, difference and ratio of the pairs so far.

        Raises
        ------
        ValueError
            No pair was added.
        """
        found = self._seen.result(confidence)
        a, b = (each.result(confidence) for each in self._each)
        warnings = (*(f"{name}: {text}" for name, of in (("A", a), ("B", b)) for text in of.warnings), *found.warnings)
        found = replace(found, a=a, b=b, warnings=warnings)
        if self._farthest is None:
            return found
        low, high = (pairs.result(confidence) for pairs in self._farthest)
        return replace(
            found,
            ci_low=min(found.ci_low, low.ci_low),
            ci_high=max(found.ci_high, high.ci_high),
            ratio_low=low.ratio_low,
            ratio_high=high.ratio_high,
        )


def _relative_error(a: float, b: float, variance_a: float, variance_b: float, covariance: float, n: int) -> float:
    """Standard error of log(A/B), by the delta method; NaN where either rate is 0."""
    if a <= 0.0 or b <= 0.0:
        return math.nan
    spread = variance_a / a**2 + variance_b / b**2 - 2.0 * covariance / (a * b)
    return math.sqrt(max(spread, 0.0) / n)


def paired_difference(pairs: Iterable[tuple[Block, Block]], confidence: float) -> Difference:
    """Difference of two vehicles' crash rates from blocks of the same episodes.

    Parameters
    ----------
    pairs : iterable of (Block, Block)
        The same episodes with A and with B, in any order of blocks.
    confidence : float
        Level of all intervals.
    """
    sums = PairedSums()
    for a, b in pairs:
        sums.add(a, b)
    return sums.result(confidence)


def difference_statement(found: Difference, name_a: str, name_b: str) -> str:
    """The answer in one sentence, and what pairing was worth in a second."""
    level = f"{found.confidence:.0%} interval"
    rates = (
        f"A ({name_a}) crashes {found.a.crash_rate:.3g} times per test "
        f"({found.a.ci_low:.3g} to {found.a.ci_high:.3g}), "
        f"B ({name_b}) {found.b.crash_rate:.3g} times ({found.b.ci_low:.3g} to {found.b.ci_high:.3g})"
    )
    verdict = "the difference is not distinguishable from 0"
    if found.n_differing and found.ci_low > 0.0:
        verdict = "A crashes more often"
    elif found.n_differing and found.ci_high < 0.0:
        verdict = "A crashes less often"
    cautions = [f"{name}: {text}" for name, of in (("A", found.a), ("B", found.b)) for text in of.cautions]
    return warned(
        cautions,
        f"{rates}: {verdict}, A - B = {found.difference:.3g} ({level} {found.ci_low:.3g} to {found.ci_high:.3g})"
        f"{_ratio(found)}, from {found.n_pairs:,} pairs of tests{_saved(found)}.{_failed(found)}",
    )


def _failed(found: Difference) -> str:
    a, b = found.a.details["n_failed"], found.b.details["n_failed"]
    if not a and not b:
        return ""
    return (
        f" Of these tests A FAILED in {a:,} and B in {b:,}: each limit counts them as crashes or as none, whichever "
        "takes it farther."
    )


def _ratio(found: Difference) -> str:
    if not math.isfinite(found.ratio):
        return ""
    if not found.n_differing:
        return f", A/B = {found.ratio:.3g} (its interval is not known: no pair differs)"
    return f", A/B = {found.ratio:.3g} ({found.ratio_low:.3g} to {found.ratio_high:.3g})"


def _saved(found: Difference) -> str:
    if not math.isfinite(found.variance_ratio):
        return ""
    times = f"{found.variance_ratio:.3g}"
    return f"; independent runs would need {'as many' if times == '1' else f'{times} times as many'}"
