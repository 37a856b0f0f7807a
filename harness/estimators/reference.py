"""How a vehicle compares with a reference driver in the same traffic, from tests of the vehicle alone.

Ratio x = μ/μ_R and preventable share y are tested as the contrasts of docs/estimators.md; each limit is a root of
`harness.estimators.stratified.ratio_limits`. Of the pool's part of their variance:

- with X and R a path's probabilities that the vehicle and the reference crash, `mean_square` bounds E[X²], the pool
  knows E[R²], and E[XR] follows from the crashed tests: one of stratum s is a draw in proportion to X there, so that
  Σ p_s/n_s times the sum of R over them has that mean;
- paths may carry preventable and unavoidable crashes, of rates P and U, which makes the contrast's variance smaller;
  how many do is not known, so that E[PU] is taken for its least value, 0.

Given how many tests fell into each cell of a stratum, those of each cell are independent binomials, so that cells take
the place of strata. Tests that failed count as whatever makes an interval wider.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from harness.estimators.limit_search import Level
from harness.estimators.stratified import CRASH, Tally, mean_square, pool_variance, ratio_limits
from harness.strata import ShellDesign
from harness.vocabulary import BoolArray, FloatArray


@dataclass(frozen=True)
class Comparison:
    """A vehicle beside a reference driver.

    ``crash_rate`` is the reference's, with its standard error. ``ratio`` is the vehicle's crash rate over it, and
    ``preventable`` the share of the vehicle's crashes that the reference would have avoided; NaN where it is not
    defined. ``delay_s`` (s) is when the reference begins to brake after the cut-in, None if it has no delay of its own.
    """

    reference: str
    described: str
    delay_s: float | None
    crash_rate: float
    std_error: float
    ratio: float
    ratio_low: float
    ratio_high: float
    preventable: float
    preventable_low: float
    preventable_high: float


def compared(design: ShellDesign, cells: Tally, level: Level) -> tuple[Comparison, ...]:
    """The vehicle beside each reference of a design; ``cells`` are its tests by the design's cells."""
    found = []
    for r, reference in enumerate(design.references):
        crashes_too = ((np.array(design.cell_references) >> r) & 1).astype(np.bool_)
        rate, square = float(design.reference_rate[r]), float(design.reference_square[r])
        ratio = _ratio(design, cells, crashes_too, (rate, square), level)
        preventable = preventable_share(design.cell_p, cells, ~crashes_too, design.n_paths, level)
        error = math.sqrt(max(square - rate * rate, 0.0) / design.n_paths)
        who = reference.name, reference.described, reference.delay_s
        found.append(Comparison(*who, rate, error, *ratio, *preventable))
    return tuple(found)


def _ratio(
    design: ShellDesign, cells: Tally, crashes_too: BoolArray, moments: tuple[float, float], level: Level
) -> tuple[float, float, float]:
    """Ratio with its limits."""

    def limits(found: Tally) -> tuple[float, float]:
        strata = found.joined(design.joined)
        with_reference = design.joined.T @ (found.crash_mass @ crashes_too)
        return rate_ratio_limits(design.p, strata, with_reference, moments, design.n_paths, level)

    rate = float(design.p @ cells.joined(design.joined).share)
    low, high = limits(cells)[0], limits(cells.failed_as_crashes())[1]
    return rate / moments[0] if moments[0] > 0.0 else math.nan, low, high


def rate_ratio_limits(
    p: FloatArray,
    tally: Tally,
    with_reference: FloatArray,
    moments: tuple[float, float],
    n_paths: int,
    level: Level,
) -> tuple[float, float]:
    """Limits of Σ p_s θ_s over the crash rate of a reference.

    Parameters
    ----------
    p : ndarray, shape (S,)
        Probabilities of the strata, from ``n_paths`` paths.
    with_reference : ndarray, shape (S,)
        Over the crashed tests of each stratum, the sum of their paths' probability that the reference crashes.
    moments : (float, float)
        Crash rate of the reference, and mean square of a path's probability that it crashes.
    """
    rate, square = moments
    own, of_paths = float(p @ tally.share), pool_variance(p, tally, n_paths)
    product = float((p / tally.at_least_one) @ with_reference)
    covariance, of_reference = (product - own * rate) / n_paths, (square - rate * rate) / n_paths

    def variance(x: float) -> float:
        return max(of_paths - 2.0 * x * covariance + x * x * of_reference, 0.0)

    # A constant as a sum over strata: the same for either outcome.
    below = np.full((p.size, 2), rate / p.size)
    return ratio_limits(np.outer(p, CRASH), below, tally.outcomes, level, variance)


def preventable_share(
    p: FloatArray, cells: Tally, prevented: BoolArray, n_paths: int, level: Level
) -> tuple[float, float, float]:
    """Share of Σ p_c θ_c that lies in some cells, with its limits; NaN without a crash.

    Parameters
    ----------
    p : ndarray, shape (C,)
        Probabilities of the cells, from ``n_paths`` paths.
    cells : Tally
    prevented : ndarray of bool, shape (C,)
    """
    contributions = p * cells.share
    total = float(contributions.sum())
    share = float(contributions[prevented].sum()) / total if total > 0.0 else math.nan
    low = _share_limits(p, cells.failed_as_crashes(~prevented), prevented, n_paths, level)[0]
    high = _share_limits(p, cells.failed_as_crashes(prevented), prevented, n_paths, level)[1]
    return share, min(low, 1.0), min(high, 1.0)


def _share_limits(p: FloatArray, cells: Tally, prevented: BoolArray, n_paths: int, level: Level) -> tuple[float, float]:
    scale = p / cells.at_least_one
    first, second = (mean_square(scale * part, cells.crash_mass) for part in (prevented, ~prevented))
    rates = p * cells.share
    of_prevented, of_others = float(rates[prevented].sum()), float(rates[~prevented].sum())

    def variance(y: float) -> float:
        rest = 1.0 - y
        mean = rest * of_prevented - y * of_others
        return max(rest * rest * first + y * y * second - mean * mean, 0.0) / n_paths

    above, below = np.outer(p * prevented, CRASH), np.outer(p, CRASH)
    return ratio_limits(above, below, cells.outcomes, level, variance)
