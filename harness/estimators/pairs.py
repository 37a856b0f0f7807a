"""Pairs of tests of two vehicles on the same events, drawn within shells: counts, and limits of what they say.

A pair of tests has one of four outcomes: both crash, only A, only B, neither. The rates, their difference and their
ratio are weighted sums of the shares of these outcomes, and their limits those of the likelihood ratio
(`harness.estimators.likelihood`). Each limit takes the failed tests of A, or those of B, for crashes: the worse.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import finite_json
from harness.estimators.likelihood import Counts, Level, contrast_limit, ratio_limits, spread
from harness.estimators.shells import SeenShells
from harness.estimators.tally import Tally, mean_square
from harness.strata import ShellDesign, weight_of_a_test
from harness.vocabulary import FloatArray, IntArray

NO_CRASH, CRASH, FAILED = range(3)
"""How a test of a pair ended."""
A_CRASHES, B_CRASHES = np.array([1.0, 1.0, 0.0, 0.0]), np.array([1.0, 0.0, 1.0, 0.0])
"""Of the outcomes: both crash, only A, only B, neither."""
ONLY_A, ONLY_B = np.array([0.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 0.0])
DIFFERENCE = A_CRASHES - B_CRASHES
PairVerdict = Literal["proven", "refuted", "open"]


@cache
def _kinds(worse: float) -> IntArray:
    """Which ends of A and B belong to each of the four outcomes, shape (3, 3, 4); ``worse`` see `Pairs`."""
    a, b = np.meshgrid([False, True, worse > 0.0], [False, True, worse < 0.0], indexing="ij")
    return np.stack((a & b, a & ~b, ~a & b, ~a & ~b), axis=2).astype(np.int64)


@dataclass(frozen=True)
class PairDecision:
    """Whether B's rate is at most 1 + ``margin`` times A's: without a margin, who crashes less often.

    It holds with ``confidence``, whenever it was looked for; ``given_the_library`` it is about what lies inside.
    ``ratio`` are the ends of B/A by which a margin was decided. B does not keep a margin with ``n_milder`` tests of
    which its rate says too little (A's: ``n_milder_a``), nor with ``n_differing`` tests of either.
    """

    margin: float | None
    verdict: PairVerdict
    confidence: float
    given_the_library: bool
    n_milder: int = 0
    n_differing: int = 0
    n_milder_a: int | None = None
    ratio: tuple[float, float] | None = None

    def to_json(self) -> dict[str, Any]:
        """All that is known, as plain content; ``margin`` also if there is none."""
        return {name: value for name, value in asdict(self).items() if value is not None or name == "margin"}

    def doubted(self, of_a: int, of_b: int, n_differing: int) -> PairDecision:
        """The same after ``of_a`` and ``of_b`` milder crashes of A and B were seen, and tests that differed."""
        held = self.margin is not None and self.verdict == "proven" and (of_b or n_differing)
        verdict = "open" if held else self.verdict
        return replace(self, verdict=verdict, n_milder=of_b, n_milder_a=of_a or None, n_differing=n_differing)


class Interval(NamedTuple):
    """A number with its interval."""

    value: float
    ci_low: float
    ci_high: float

    @property
    def half_width(self) -> float:
        """Half of the interval's length."""
        return (self.ci_high - self.ci_low) / 2.0


class PairCounts(NamedTuple):
    """Pairs of one scenario, of strata that are the first of the design's.

    ``ends`` (S, 3, 3) is how often A ended in one way (second axis) and B in another (third): no crash, crash, failed.
    ``mass`` (S, 3, 3, S) is, over the same pairs, the sum of their paths' probability of an event of every stratum.
    """

    design: ShellDesign
    ends: Counts
    mass: FloatArray

    def within(self, statement: str | None) -> PairCounts:
        """See `Pairs`."""
        n = self.design.n_inside if statement is None else self.design.n_within(statement)
        return PairCounts(self.design, self.ends[:n], self.mass[:n, :, :, :n])

    def tally(self, side: int) -> Tally:
        """Tests of A (0) or B (1) by themselves."""
        ends, mass = self.ends.sum(2 - side), self.mass.sum(2 - side)
        return Tally(self.ends.sum((1, 2)), ends[:, CRASH], ends[:, FAILED], mass[:, CRASH], mass[:, FAILED])

    def pool_variance(self, weights: FloatArray, worse: float) -> float:
        """See `Pairs`.

        The mean square of a path's part in it is at most that of its outcomes of positive weight and that of those of
        negative weight together, as the product of the two only lowers it.
        """
        scale = weight_of_a_test(self.design.p[: len(self.ends)], self.ends.sum((1, 2)))
        square, rate, kinds = 0.0, 0.0, _kinds(worse)
        outcomes = np.tensordot(self.ends, kinds)
        for sign in (1.0, -1.0):
            part = np.maximum(sign * weights, 0.0)
            mass = np.tensordot(self.mass, kinds @ part, ((1, 2), (0, 1)))
            square += float(part.max()) * mean_square(scale, mass)
            rate += sign * float(scale @ (outcomes @ part))
        return max(square - rate**2, 0.0) / self.design.n_paths


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of tests of some strata, and limits of what they say: of one scenario per test, or of several per hour.

    ``tests_per_hour`` are those that an hour of driving stands for, of each scenario; None of one alone, per test.
    ``worse`` says whose failed tests count as crashes: A's (1), B's (-1), or nobody's (0).
    """

    each: tuple[PairCounts, ...]
    tests_per_hour: tuple[float, ...] | None = None

    @property
    def p(self) -> FloatArray:
        """What the strata stand for, shape (S,): their probabilities per test; of several scenarios events per hour."""
        return np.concatenate([times * part.design.p[: len(part.ends)] for times, part in self._parts])

    @property
    def ends(self) -> Counts:
        """How pairs ended, of all strata, see `PairCounts`."""
        return np.concatenate([part.ends for part in self.each])

    @property
    def _parts(self) -> zip[tuple[float, PairCounts]]:
        return zip(self.tests_per_hour or (1.0,), self.each, strict=True)

    def within(self, statement: str | None = None) -> Pairs:
        """Those of the strata that a statement is about, by default those within the boundary."""
        return replace(self, each=tuple(part.within(statement) for part in self.each))

    def times(self, factor: float) -> Pairs:
        """So many times as many pairs of each stratum, ending as often."""
        parts = ((part, np.asarray(part.ends * factor, np.float64)) for part in self.each)
        return replace(self, each=tuple(PairCounts(part.design, ends, part.mass * factor) for part, ends in parts))

    def pool_variance(self, weights: FloatArray, worse: float = 0.0) -> float:
        """Variance of a weighted sum that comes from the pools' finite number of paths.

        Pools of several scenarios are independent, and none knows exactly how often a test has an event.
        """
        variances = []
        for times, part in self._parts:
            events = 0.0 if self.tests_per_hour is None else part.design.p_event_error * Pairs((part,)).rate(weights)
            variances.append(times**2 * (part.pool_variance(weights, worse) + events**2))
        return math.fsum(variances)

    @property
    def reference(self) -> tuple[float, float] | None:
        """Crash rate of the reference driver, and its standard error; None where none crashes.

        That is the first of the library that crashes; of several scenarios the first of each, if it crashes or not.
        """
        total, errors = 0.0, list[float]()
        for times, part in self._parts:
            crash = np.flatnonzero(part.design.reference_rate) if self.tests_per_hour is None else [0]
            if part.design.references and len(crash):
                rate = float(part.design.reference_rate[crash[0]])
                error = part.design.reference_error(int(crash[0]))
                events = 0.0 if self.tests_per_hour is None else part.design.p_event_error * rate
                total += times * rate
                errors.append(times * math.hypot(error, events))
        return (total, math.hypot(*errors)) if total else None

    @property
    def tests(self) -> IntArray:
        """Pairs of each stratum, shape (S,)."""
        return np.asarray(self.ends.sum((1, 2)))

    def outcomes(self, worse: float = 0.0) -> Counts:
        """How often both crash, only A, only B, neither, shape (S, 4)."""
        return np.tensordot(self.ends, _kinds(worse))

    @property
    def n_alone(self) -> tuple[int, int]:
        """Pairs of which A, or B, is known to have crashed, and the other not to have."""
        return int(self.ends[:, CRASH, NO_CRASH].sum()), int(self.ends[:, NO_CRASH, CRASH].sum())

    @property
    def n_crashes(self) -> int:
        """Crashes of both vehicles."""
        return int(self.ends[:, CRASH].sum() + self.ends[:, :, CRASH].sum())

    def rate(self, weights: FloatArray) -> float:
        """Weighted sum over outcomes (4,) and strata, as seen."""
        return float(weight_of_a_test(self.p, self.tests) @ (self.outcomes() @ weights))

    @property
    def larger_rate(self) -> float:
        """The rate of the vehicle that has crashed more often; infinite where neither has."""
        return max(self.rate(A_CRASHES), self.rate(B_CRASHES)) or math.inf

    def expected(self, rate: float) -> float:
        """Crashes that these tests of one vehicle would have brought at a rate, spread evenly over the strata."""
        return rate * int(self.tests.sum()) / float(self.p.sum())

    def limit(self, weights: FloatArray, level: Level, side: float) -> float:
        """One limit of a weighted sum that grows, or stays, where A crashes more often or B less."""
        variance = self.pool_variance(weights, side)
        return contrast_limit(self.p[:, None] * weights, self.outcomes(side), level, side, variance)

    def difference(self, level: Level) -> Interval:
        """A - B in crashes per test."""
        low, high = (self.limit(DIFFERENCE, level, side) for side in (-1.0, 1.0))
        return Interval(self.rate(DIFFERENCE), low, high)

    def alone(self, side: int, level: Level) -> Interval:
        """Rate of events on which A (0), or B (1), crashes and the other one does not."""
        sign, weights = ((1.0, ONLY_A), (-1.0, ONLY_B))[side]  # `limit` is of what does not fall where A crashes more
        low, high = sorted(sign * self.limit(sign * weights, level, end) for end in (-1.0, 1.0))
        return Interval(self.rate(weights), max(low, 0.0) + 0.0, min(high, max(float(self.p.sum()), 1.0)))

    def highest_rate(self, level: Level) -> float:
        """Upper limit of the crash rate of A or B, whichever is higher."""
        return max(self.limit(A_CRASHES, level, 1.0), -self.limit(-B_CRASHES, level, -1.0))

    def ratio(self, level: Level) -> Interval:
        """A over B; NaN where B has no crash, and open upwards where it may have none."""
        a, b, p = self.rate(A_CRASHES), self.rate(B_CRASHES), self.p[:, None]

        def limits(side: float) -> tuple[float, float]:
            def variance(ratio: float) -> float:
                return self.pool_variance(A_CRASHES - ratio * B_CRASHES, side)

            return ratio_limits(p * A_CRASHES, p * B_CRASHES, self.outcomes(side), level, variance)

        return Interval(a / b if b > 0.0 else math.nan, limits(-1.0)[0], limits(1.0)[1])

    def rhw(self, level: Level) -> float:
        """Half-width of the difference over the larger of the two rates; infinite where neither has crashed."""
        return self.difference(level).half_width / self.larger_rate if self.n_crashes else math.inf

    def rhw_from_pool(self, level: Level) -> float:
        """What the pool's own error alone would leave of `rhw`."""
        return level.z * math.sqrt(self.pool_variance(DIFFERENCE)) / self.larger_rate

    def spread(self, level: Level, size: int, most: IntArray) -> IntArray:
        """Divide further pairs among strata, (S,), at most so many each, to where they narrow the difference most."""
        return spread(self.p[:, None] * DIFFERENCE, self.outcomes(-1.0), self.outcomes(1.0), level, size, most)

    def verdict(self, margin: float, level: Level) -> PairVerdict:
        """Whether B's rate is at most 1 + margin times A's: proven, refuted, or open."""
        excess = (1.0 + margin) * A_CRASHES - B_CRASHES
        if self.limit(excess, level, -1.0) > 0.0:
            return "proven"
        return "refuted" if self.limit(excess, level, 1.0) < 0.0 else "open"


class PairedShells:
    """Tests of A and B as they come; the i-th of a stratum with A and the i-th with B are the same event."""

    def __init__(self, design: ShellDesign) -> None:
        n = len(design.strata)
        self._design = design
        self._ends = [[np.zeros(0, np.int64)] * n, [np.zeros(0, np.int64)] * n]
        self._mass = [np.zeros((0, n))] * n  # of A's tests; B's paths are the same

    def add(self, side: int, block: Block) -> None:
        """Tests of A (0) or of B (1), in the order of their draws."""
        ends = np.where(block.failed, FAILED, np.where(block.crash, CRASH, NO_CRASH))
        for s in np.unique(block.stratum).tolist():
            rows = block.stratum == s
            self._ends[side][s] = np.concatenate([self._ends[side][s], ends[rows]])
            if side == 0:
                self._mass[s] = np.concatenate([self._mass[s], block.cell_mass[rows] @ self._design.joined])

    def tests(self, side: int) -> IntArray:
        """Tests of A or B by stratum, shape (S,)."""
        return np.array([ends.size for ends in self._ends[side]], np.int64)

    def first(self, n_pairs: IntArray) -> Pairs:
        """The first pairs of each stratum, of which both tests must be there."""
        (counted,) = (pairs := no_pairs(self._design)).each
        for s, n in enumerate(n_pairs.tolist()):
            a, b = (of_side[s][:n] for of_side in self._ends)
            np.add.at(counted.ends[s], (a, b), 1)
            np.add.at(counted.mass[s], (a, b), self._mass[s][:n])
        return pairs


def no_pairs(design: ShellDesign) -> Pairs:
    """The pairs of no tests."""
    n = len(design.strata)
    return Pairs((PairCounts(design, np.zeros((n, 3, 3), np.int64), np.zeros((n, 3, 3, n))),))


def contrast(pairs: Pairs, level: Level) -> dict[str, Any]:
    """What lies between A and B in some strata, difference A - B and ratio A/B; rates are per test, or per hour.

    ``rhw`` is the half-width of the difference over the larger of the two rates, ``rhw_from_pool`` what the pool's own
    error alone would leave of it; ``only_a`` and ``only_b`` are rates of events on which only one of the two crashes.
    """
    return {
        **dict(zip(("difference", "ci_low", "ci_high"), pairs.difference(level), strict=True)),
        "rhw": pairs.rhw(level),
        "rhw_from_pool": pairs.rhw_from_pool(level),
        **dict(zip(("ratio", "ratio_low", "ratio_high"), pairs.ratio(level), strict=True)),
        "only_a": pairs.alone(0, level)._asdict(),
        "only_b": pairs.alone(1, level)._asdict(),
        "n_pairs": int(pairs.tests.sum()),
        **dict(zip(("n_only_a", "n_only_b"), pairs.n_alone, strict=True)),
    }


def paired_estimate(pairs: Pairs, confidence: float) -> dict[str, Any]:
    """Content of ``compare.json`` that comes from one scenario's pairs, at least one: each vehicle, and all shells.

    ``conditional`` is what lies between if neither crashes beyond the boundary, ``refuted`` once one has.
    """
    level, inside, (own,) = Level.two_sided(confidence), pairs.within(), pairs.each
    design, tallies = own.design, [own.tally(side) for side in (0, 1)]
    alone = design.without_references()  # counts by stratum say nothing about them
    a, b = (SeenShells.of(alone, tally).result(confidence).shown for tally in tallies)
    counts = "n_both", "n_only_a", "n_only_b", "n_neither"
    shells = [
        {
            "shell": design.strata[s],
            "inside": s < design.n_inside,
            "p": float(design.p[s]),
            "n_pairs": int(pairs.tests[s]),
            **dict(zip(counts, row.tolist(), strict=True)),
            "n_failed_tests": sum(int(tally.failed[s]) for tally in tallies),
        }
        for s, row in enumerate(pairs.outcomes())
    ]
    conditional = {
        **contrast(inside, level),
        "boundary": design.boundary,
        "n_pairs_outside": int(pairs.tests.sum() - inside.tests.sum()),
        "refuted": any(tally.crashes[design.n_inside :].any() for tally in tallies),
    }
    more = {"confidence": confidence, "conditional": conditional, "shells": shells}
    return finite_json({"a": a, "b": b, **contrast(pairs, level), **more})
