"""What an estimator is and answers: `Accumulator`, `Estimate`; and how failed tests count, both ways, for all of them.

What a failed test would have come to is not known. So an interval reaches from the lower limit had none crashed to the
upper limit had all: it covers wherever each of the two does.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from pydantic import BeforeValidator
from pydantic_core import from_json, to_json

from harness.estimators.block import Block

Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""What JSON has as null, because it was infinite or not defined, is read as NaN: not known."""
WIDE_RHW = 0.5
"""Relative half-width above which a rate says less than its limits; stopping at the first one below biases it."""


@dataclass(frozen=True)
class Note:
    """Something to be told, in the words that `harness.report.notes` has for its ``key``, with these numbers."""

    key: str
    numbers: dict[str, Any] = field(default_factory=dict)


def note(key: str, **numbers: Any) -> Note:
    """A note of some kind."""
    return Note(key, numbers)


IntervalKind = Literal["clopper_pearson", "normal", "skewed", "likelihood_ratio"]
BoundKind = Literal["one_sided", "two_sided", "hoeffding"]
"""An interval's own limit, one-sided or as its upper end is; or Hoeffding's, of a mean of capped values."""
CapKind = Literal["design", "tests", "none"]
"""What a cap rests on: the design, or the tests driven."""


@dataclass(frozen=True)
class Estimate:
    """A crash rate per test, how sure it is, and what a reader must know to trust it.

    ``crash_rate``, ``std_error``, the two-sided interval ``ci_low``, ``ci_high`` and the one-sided ``upper_bound``,
    both at ``confidence``, are in crashes per test; limits are finite also when no crash was seen. ``rhw`` is the
    interval's half-width relative to the rate, infinite when the rate is 0. ``n_effective`` is (ΣY)²/ΣY²,
    ``largest_weight_share`` the largest single Y as a share of ΣY, and ``weight_cap`` the largest weight that a crash
    can have by design, infinite where nothing is known to bound it. ``interval`` and ``bound`` say how these were made,
    ``cap`` what Hoeffding's bound rests on. ``warnings`` are what a reader must know, the ``cautions`` first: why the
    interval may be wrong, so that no precision is claimed. ``details`` are what only this estimator has to say.
    """

    crash_rate: float
    std_error: Number
    ci_low: Number
    ci_high: Number
    upper_bound: Number
    confidence: float
    rhw: Number
    n_episodes: int
    n_crashes: int
    n_effective: Number
    largest_weight_share: Number
    interval: IntervalKind
    bound: BoundKind
    cap: CapKind = "none"
    weight_cap: Number = math.inf
    warnings: tuple[Note, ...] = ()
    cautions: tuple[Note, ...] = ()
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def precision(self) -> float:
        """`rhw` as far as it says how precise the rate is: infinite where the interval may be wrong."""
        return math.inf if self.cautions else self.rhw

    @property
    def upper_limit(self) -> float:
        """The limit above: the interval's or, without a crash, the one-sided one."""
        return self.ci_high if self.n_crashes else self.upper_bound

    @property
    def is_wide(self) -> bool:
        """Whether the upper end of an interval from shells says more than the rate: without a crash, or with few."""
        return "shells" in self.details and not self.cautions and self.rhw > WIDE_RHW

    @property
    def untested(self) -> float:
        """Probability of shells without a test: it adds nothing to the rate, and all of it to the upper end."""
        return math.fsum(shell["p"] for shell in self.details.get("shells", ()) if not shell["n_episodes"])

    @property
    def is_open_above(self) -> bool:
        """Whether crashes were seen, and the upper end says hardly more than what has not been tested."""
        return self.n_crashes > 0 and self.untested > self.ci_high / 2.0

    @property
    def shown(self) -> Estimate:
        """What is written of it: without an RHW that says nothing."""
        return replace(self, rhw=self.precision)


@dataclass(frozen=True)
class Unavailable:
    """An estimator that these records do not allow, and why."""

    why: Note
    crash_rate: None = None


@dataclass(frozen=True)
class Point:
    """The headline estimate of the first ``n`` tests."""

    n: int
    crash_rate: Number
    ci_low: Number
    ci_high: Number
    rhw: Number
    n_crashes: int


def finite_json(content: Any) -> dict[str, Any]:
    """JSON content of a dataclass or mapping: tuples as lists, non-finite numbers, which JSON cannot write, as null."""
    plain: dict[str, Any] = from_json(to_json(content, inf_nan_mode="null"))
    return plain


class Accumulator(Protocol):
    """One estimator's running state, of bounded size."""

    def add(self, block: Block) -> None:
        """Add the episodes of one block."""

    def result(self, confidence: float) -> Estimate:
        """Estimate from the episodes so far, at least one; leaves the state as it is."""


class FailureBounds:
    """An empty estimator that is fed twice from the first failed test on: these as no crash, and as crashes."""

    def __init__(self, seen: Accumulator) -> None:
        self.seen, self._n_failed = seen, 0
        self._worst: Accumulator | None = None  # until a test fails it would be the same

    def add(self, block: Block) -> None:
        if self._worst is None and block.failed.any():
            self._worst = deepcopy(self.seen)
        self._n_failed += int(np.count_nonzero(block.failed))
        self.seen.add(block)
        if self._worst is not None:
            self._worst.add(block.failed_as_crashes())

    def result(self, confidence: float) -> Estimate:
        """Rate and lower limit of what was seen, upper limits of the worst that it may have been."""
        seen = self.seen.result(confidence)
        worst = seen if self._worst is None else self._worst.result(confidence)
        failures = {"n_failed": self._n_failed, "crash_rate_if_failed_had_crashed": worst.crash_rate}
        seen = replace(seen, details={**failures, **seen.details})
        if not self._n_failed:
            return seen
        high = max(seen.ci_high, worst.ci_high)
        return replace(
            seen,
            ci_high=high,
            upper_bound=max(seen.upper_bound, worst.upper_bound),
            rhw=(high - seen.ci_low) / 2.0 / seen.crash_rate if seen.crash_rate > 0.0 else math.inf,
            weight_cap=max(seen.weight_cap, worst.weight_cap),
            warnings=(*seen.warnings, note("failed", n=self._n_failed, of=seen.n_episodes)),
        )
