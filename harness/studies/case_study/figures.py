"""A result with the interval that it is sure of, and how that answers a number of the paper."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from scipy.stats import norm

from harness.arrays import FloatArray

Verdict = Literal["reproduced", "not reproduced", "cannot be told"]


def figure(value: float | None, low: float | None = None, high: float | None = None) -> dict[str, Any]:
    """A number for the page; None where nothing is known, or on the side on which nothing bounds it."""
    known = [None if x is None or not math.isfinite(x) else float(x) for x in (value, low, high)]
    return dict(zip(("value", "low", "high"), known, strict=True))


def exactly(value: float) -> dict[str, Any]:
    """A number without any error of sampling."""
    return figure(value, value, value)


def verdict(paper: float, found: dict[str, Any], *, within: float, tolerance: float | None, at_most: bool) -> Verdict:
    """Whether the whole interval of our number agrees with the paper's, or all of it differs.

    An interval that does neither leaves it open, as does a number that is not known.

    Parameters
    ----------
    paper : float
    found : dict
        As `figure` gives it; an end that is None is open.
    within : float
        Factor up to which numbers agree.
    tolerance : float or None
        Distance up to which they agree, instead: where the paper's number is 0.
    at_most : bool
        Whether the paper's number is a limit that ours is not to exceed, whatever the factor.
    """
    if found["value"] is None and found["low"] is None:
        return "cannot be told"
    low = -math.inf if found["low"] is None else found["low"]
    high = math.inf if found["high"] is None else found["high"]
    least, most = sorted((paper / within, paper * within))
    if tolerance is not None:
        least, most = paper - tolerance, paper + tolerance
    if at_most:
        least = -math.inf
        most = paper
    if least <= low and high <= most:
        return "reproduced"
    return "not reproduced" if high < least or low > most else "cannot be told"


def z_of(confidence: float) -> float:
    """Quantile of the two-sided normal interval."""
    return float(norm.isf((1.0 - confidence) / 2.0))


def tests_for(relvar: float, rhw: float, confidence: float) -> float:
    """Tests after which a mean of this relative variance per test has the relative half-width."""
    return relvar * (z_of(confidence) / rhw) ** 2


def quantiles(values: FloatArray, confidence: float) -> tuple[float, float]:
    """The range that holds this share of the values, as much beyond either end."""
    beyond = (1.0 - confidence) / 2.0
    low, high = np.quantile(values, [beyond, 1.0 - beyond])
    return float(low), float(high)
