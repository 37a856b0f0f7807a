"""A result with the interval that it is sure of, and how that answers a number of the paper."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

from harness.estimators.likelihood import Level
from harness.vocabulary import FloatArray, Method

LOW_MEAN_WEIGHT = 0.5
Verdict = Literal["reproduced", "not reproduced", "cannot be told", "ours to choose"]


def figure(value: float | None, low: float | None = None, high: float | None = None) -> dict[str, Any]:
    """A number for the page; None where nothing is known, or on the side on which nothing bounds it."""
    known = [None if x is None or not math.isfinite(x) else float(x) for x in (value, low, high)]
    return dict(zip(("value", "low", "high"), known, strict=True))


def exactly(value: float) -> dict[str, Any]:
    """A number without any error of sampling."""
    return figure(value, value, value)


def marked(found: dict[str, Any], *, settled: bool) -> dict[str, Any]:
    """The number, marked where it is of tests whose weights have not come in yet: it means nothing then."""
    return found if settled else {**found, "settled": False}


def is_settled(*found: dict[str, Any]) -> bool:
    """Whether none of them is marked."""
    return all(each.get("settled", True) for each in found)


def weights_are_in(method: Method, mean_weight: float) -> bool:
    """Whether the large weights of the step mixture, which nothing bounds, have come in: their mean is 1 if so."""
    return method != "step_mixture" or mean_weight >= LOW_MEAN_WEIGHT


def mean_of(values: Iterable[float | None], confidence: float) -> dict[str, Any]:
    """Mean of repetitions of something positive with its t interval; one of them alone has none."""
    known = np.array([x for x in values if x is not None and math.isfinite(x)])
    if len(known) < 2:
        return figure(known[0] if len(known) else None)
    half = _t_half_width(known, confidence)
    return figure(known.mean(), max(known.mean() - half, 0.0), known.mean() + half)


def covered(rates: Sequence[dict[str, Any]], truth: float | None) -> float:
    """Share of rates whose interval holds the truth; that of no crash holds nothing."""
    holds = [rate["value"] is not None and rate["low"] <= (truth or 0.0) <= rate["high"] for rate in rates]
    return float(np.mean(holds))


def range_of(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The first number between the least and the most of all; a limit stands for a number that is not known."""
    known = [x for each in found if (x := each["value"] or each["low"] or each["high"])]
    return figure(found[0]["value"] if found else None, min(known, default=None), max(known, default=None))


def ratio_of_means(above: ArrayLike, below: ArrayLike, confidence: float) -> dict[str, Any]:
    """Ratio of the means of paired repetitions, with the t interval of its logarithm, to the first order."""
    pairs = np.array([above, below], np.float64)
    pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
    if not (pairs.size and np.all(means := pairs.mean(axis=1))):
        return figure(None)
    value, apart = means[0] / means[1], pairs[0] / means[0] - pairs[1] / means[1]
    if apart.size < 2:
        return figure(value)
    half = _t_half_width(apart, confidence)
    return figure(value, value * math.exp(-half), value * math.exp(half))


def _t_half_width(values: FloatArray, confidence: float) -> float:
    n = len(values)
    return float(student.isf((1.0 - confidence) / 2.0, n - 1) * values.std(ddof=1)) / math.sqrt(n)


def ratio_of_variances(above: ArrayLike, below: ArrayLike, confidence: float) -> dict[str, Any]:
    """Ratio of the variances of two estimates of the same tests; limits from leaving out one repetition at a time."""
    pairs = np.array([above, below], np.float64)
    n = pairs.shape[1]
    if n < 3 or not np.all(pairs.var(axis=1)):
        return figure(None)
    left = np.array([np.divide(*np.delete(pairs, k, axis=1).var(axis=1)) for k in range(n)])
    value = float(np.divide(*pairs.var(axis=1)))
    half = student.isf((1.0 - confidence) / 2.0, n - 1) * left.std() * math.sqrt(n - 1)
    return figure(value, max(value - half, 0.0), value + half)


def ratio(above: dict[str, Any], below: dict[str, Any]) -> dict[str, Any]:
    """Ratio of two independent results, its limits from theirs on the logarithmic scale (Zou and Donner's MOVER)."""
    if not above["value"] or not below["value"]:
        return figure(None)
    value = above["value"] / below["value"]
    if not (above["low"] and below["low"]):
        return figure(value)
    down = math.hypot(math.log(above["value"] / above["low"]), math.log(below["high"] / below["value"]))
    up = math.hypot(math.log(above["high"] / above["value"]), math.log(below["value"] / below["low"]))
    return marked(figure(value, value * math.exp(-down), value * math.exp(up)), settled=is_settled(above, below))


def verdict(paper: float, found: dict[str, Any], *, within: float, tolerance: float | None, at_most: bool) -> Verdict:
    """Whether the whole interval of our number agrees with the paper's, or all of it differs.

    An interval that does neither leaves it open, as does a number that is not known, or is marked as not settled.
    Numbers agree up to the factor ``within``, or up to the distance ``tolerance``, where the paper's is 0; with
    ``at_most`` the paper's is a limit that ours is not to exceed.
    """
    if not is_settled(found) or (found["value"] is None and found["low"] is None):
        return "cannot be told"
    low = -math.inf if found["low"] is None else found["low"]
    high = math.inf if found["high"] is None else found["high"]
    least, most = sorted((paper / within, paper * within))
    if tolerance is not None:
        least, most = paper - tolerance, paper + tolerance
    if at_most:
        least, most = -math.inf, paper
    if least <= low and high <= most:
        return "reproduced"
    return "not reproduced" if high < least or low > most else "cannot be told"


def tests_for(relvar: float, rhw: float, confidence: float) -> float:
    """Tests after which a mean of this relative variance per test has the relative half-width."""
    return relvar * (Level.two_sided(confidence).z / rhw) ** 2
