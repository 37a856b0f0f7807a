"""What an estimator answers: an `Estimate`, or the reason why the records do not allow one."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

WIDEST_RHW = 10.0
"""Relative half-widths above are not given as a number: next to nothing is known, and the digits would mean nothing."""


@dataclass(frozen=True)
class Estimate:
    """A crash rate per test, how sure it is, and what a reader must know to trust it.

    Attributes
    ----------
    crash_rate, std_error : float
        Crashes per test.
    ci_low, ci_high : float
        Two-sided interval at `confidence`.
    upper_bound : float
        One-sided bound at `confidence`; finite also when no crash was seen.
    rhw : float
        Half-width of the interval relative to the rate; infinite when the rate is 0.
    n_episodes, n_crashes : int
        Tests counted and crashes sampled among them.
    n_effective : float
        (ΣY)²/ΣY².
    largest_weight_share : float
        Largest single Y as a share of ΣY.
    weight_cap : float
        Largest weight that a crash can have by design; infinite where nothing is known to bound it.
    method : str
        How rate, interval and upper bound were made, in words.
    warnings : tuple of str
        What a reader must know, the cautions first; empty if nothing is known to be wrong.
    cautions : tuple of str
        Why the interval may be wrong. A statement begins with them, and no precision is claimed beside them.
    details : dict
        What only this estimator has to say.
    """

    crash_rate: float
    std_error: float
    ci_low: float
    ci_high: float
    upper_bound: float
    confidence: float
    rhw: float
    n_episodes: int
    n_crashes: int
    n_effective: float
    largest_weight_share: float
    method: str
    weight_cap: float = math.inf
    warnings: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def precision(self) -> float:
        """`rhw` as far as it says how precise the rate is: infinite where the interval may be wrong."""
        return math.inf if self.cautions else self.rhw

    def to_json(self) -> dict[str, Any]:
        """Plain JSON content; infinite and undefined numbers become null, as does an RHW that says nothing."""
        content: dict[str, Any] = finite_json({**asdict(self), "rhw": self.precision})
        return content


@dataclass(frozen=True)
class Unavailable:
    """An estimator that these records do not allow.

    Attributes
    ----------
    reason : str
        What is missing, and what would provide it.
    """

    reason: str

    def to_json(self) -> dict[str, Any]:
        """Plain JSON content: no value, and why."""
        return {"crash_rate": None, "reason": self.reason}


def finite_json(value: Any) -> Any:
    """Copy of nested content with tuples as lists and non-finite numbers as null, which JSON cannot write."""
    if isinstance(value, dict):
        return {key: finite_json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite_json(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
