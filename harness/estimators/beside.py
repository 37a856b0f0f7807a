"""A vehicle beside others in the same traffic: the ratio of its rate to theirs, and shares of its crashes, with limits.

Ratio x = μ/μ_R and preventable share y are tested as the contrasts of docs/estimators.md; each limit is a root of
`harness.estimators.likelihood.ratio_limits`. Of the pool's part of their variance:

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
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.estimators.estimate import Number
from harness.estimators.likelihood import CRASH, Counts, Level, ratio_limits
from harness.estimators.tally import FEWEST_PATHS, Tally, crash_square, paths_that_count, pool_variance
from harness.strata import ShellDesign, weight_of_a_test
from harness.vocabulary import BoolArray, FloatArray


@dataclass(frozen=True)
class BesideReference:
    """A vehicle beside a reference driver.

    ``crash_rate`` and ``std_error`` are the reference's. ``ratio`` is the vehicle's crash rate over it, ``preventable``
    the share of the vehicle's crashes that the reference would have avoided; NaN where not defined. ``delay_s`` (s) is
    when the reference begins to brake after the event, None if it has no delay of its own.
    """

    reference: str
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
    """The vehicle beside each reference that crashes at all; ``cells`` are its tests by the design's cells."""
    rows = []
    rate_of_vehicle = float(design.p @ cells.joined(design.joined).share)
    for r, reference in enumerate(design.references):
        if (rate := float(design.reference_rate[r])) == 0.0:
            continue
        ratio = rate_of_vehicle / rate if rate > 0.0 else math.nan, *beside(design, cells, r, design.p.size, level)
        prevented = ~design.crashes_too(r)
        preventable = preventable_share(design.cell_p, cells, prevented, design.n_independent, level)
        error = design.reference_error(r)
        rows.append(BesideReference(reference.name, reference.delay_s, rate, error, *ratio, *preventable))
    return tuple(rows)


def beside(design: ShellDesign, cells: Tally, r: int, n_strata: int, level: Level) -> tuple[float, float]:
    """Limits of the rate of the first strata over a reference's; 0 and infinity where crashes lie on too few paths."""
    p, strata = design.p[:n_strata], slice(0, n_strata)

    def limits(tests: Tally) -> tuple[float, float]:
        tally = tests.joined(design.joined).part(strata)
        errors = path_errors(design, tests, r, n_strata)
        if paths_that_count(p, tally) < FEWEST_PATHS:
            return 0.0, math.inf
        return limits_over(float(design.reference_rate[r]), p, tally.outcomes, errors, level)

    low, high = limits(cells)
    return low, high if (worst := cells.failed_as_crashes()) is cells else max(high, limits(worst)[1])


def limits_over(
    rate: float, p: FloatArray, outcomes: Counts, errors: Sequence[float], level: Level
) -> tuple[float, float]:
    """Limits of Σ p_s θ_s over a reference's ``rate``; ``errors`` see `path_errors`."""
    of_paths, covariance, of_reference = errors

    def variance(x: float) -> float:
        return max(of_paths - 2.0 * x * covariance + x * x * of_reference, 0.0)

    # A constant as a sum over strata: the same for either outcome.
    below = np.full((p.size, 2), rate / p.size)
    return ratio_limits(np.outer(p, CRASH), below, outcomes, level, variance)


def path_errors(
    design: ShellDesign, cells: Tally, r: int | None, n_strata: int | None = None
) -> tuple[float, float, float]:
    """What few paths leave open of Σ p_s c_s over the first strata, by default all, beside the rate of a reference.

    Variance of the sum, its covariance with that rate, and the variance of the rate; of no reference the first alone.
    """
    n_paths, p, strata = design.n_independent, design.p[:n_strata], slice(0, n_strata)
    tally = cells.joined(design.joined).part(strata)
    own = pool_variance(p, tally, n_paths)
    if r is None:
        return own, 0.0, 0.0
    rate, square = float(design.reference_rate[r]), float(design.reference_square[r])
    with_reference = (design.joined.T @ (cells.crash_mass @ design.crashes_too(r)))[strata]
    product = float(weight_of_a_test(p, tally.tests) @ with_reference)
    return own, (product - float(p @ tally.share) * rate) / n_paths, (square - rate * rate) / n_paths


def preventable_share(
    p: FloatArray, cells: Tally, prevented: BoolArray, n_paths: float, level: Level
) -> tuple[float, float, float]:
    """Share of Σ p_c θ_c that lies in the ``prevented`` ones of all cells (C,), with limits; NaN without a crash."""

    def limits(tests: Tally) -> tuple[float, float]:
        scale, rates = weight_of_a_test(p, tests.tests), p * tests.share
        first, second = (crash_square(scale * part, tests) for part in (prevented, ~prevented))
        of_prevented, of_others = float(rates[prevented].sum()), float(rates[~prevented].sum())

        def variance(y: float) -> float:
            rest = 1.0 - y
            mean = rest * of_prevented - y * of_others
            return max(rest * rest * first + y * y * second - mean * mean, 0.0) / n_paths

        return ratio_limits(np.outer(p * prevented, CRASH), np.outer(p, CRASH), tests.outcomes, level, variance)

    contributions = p * cells.share
    total = float(contributions.sum())
    share = float(contributions[prevented].sum()) / total if total > 0.0 else math.nan
    low, high = limits(cells.failed_as_crashes(~prevented))[0], limits(cells.failed_as_crashes(prevented))[1]
    return share, min(low, 1.0), min(high, 1.0)


def share_of_crashes(
    design: ShellDesign, every: Tally, some: Tally, level: Level, *, of_the_others: bool
) -> tuple[float, float]:
    """Limits of the share of the rate that is of ``some`` of its crashes, or of the others, of the same tests.

    A path's parts in both are taken to exclude each other, which makes the variance no smaller.
    """
    p, n_paths = design.p, design.n_independent
    others = every._replace(crashes=every.crashes - some.crashes, crash_mass=every.crash_mass - some.crash_mass)
    first, second = (others, some) if of_the_others else (some, others)
    rates = [float(p @ tally.share) for tally in (first, second)]
    of_paths = [pool_variance(p, tally, n_paths) for tally in (first, second)]

    def variance(x: float) -> float:
        both = 2.0 * x * (1.0 - x) * rates[0] * rates[1] / n_paths
        return max((1.0 - x) ** 2 * of_paths[0] + x * x * of_paths[1] + both, 0.0)

    def limits(failed_first: int) -> tuple[float, float]:
        """Failed tests may have been crashes of either kind."""
        a, b = first.crashes + failed_first * every.failed, second.crashes + (1 - failed_first) * every.failed
        counts = np.stack((a, b, every.tests - a - b), axis=1)
        return ratio_limits(np.outer(p, (1.0, 0.0, 0.0)), np.outer(p, (1.0, 1.0, 0.0)), counts, level, variance)

    return min(limits(0)[0], 1.0), min(limits(1)[1], 1.0)
