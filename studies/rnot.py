"""The required number of tests (RNoT) as published.

[paper] section VI-E. For one ordering of the tests the RNoT is the first n after which the relative half-width
RHW = z·sqrt(var/n)/estimate stays at or below a threshold; it is averaged over shuffles of the tests of one run. Where
a shuffle is never above the threshold, the paper takes the n at which RHW is largest. The average acceleration ratio
(AAR) of one method over another is the ratio of two averages.

The RHW is looked at on a grid, up to a total; both belong to the answer, for "stays" can only mean "up to the total". A
shuffle that is still above the threshold at the total counts as the total, which makes the average a lower limit.

A shuffle is decided by the seed, its number, how many tests there are and which of them crashed: not by how they lie
in shards, and not by the estimator, so that two estimators of one run see the same orderings.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from harness.errors import HarnessError
from harness.estimators.block import Block, joined
from harness.estimators.likelihood import Level
from harness.estimators.scv import Scv
from harness.runner.stored import stored_blocks
from harness.vocabulary import BoolArray, FloatArray, IntArray
from studies.case_study.figures import figure, marked, mean_of, ratio_of_means


@dataclass(frozen=True)
class Procedure:
    """What the paper leaves to be chosen, and what it chose: defaults of threshold, level and number of shuffles.

    ``first`` is the smallest prefix that is looked at, at least 2, ``ratio`` how much larger each next one is, above 1.
    """

    rhw: float = 0.3
    confidence: float = 0.9
    n_shuffles: int = 200
    seed: int = 1
    first: int = 10
    ratio: float = 1.05

    def grid(self, n_tests: int) -> IntArray:
        """Prefixes to look at, shape (g,): rising, the last one being all tests."""
        sizes, n = list[int](), self.first
        while n < n_tests:
            sizes.append(n)
            n = max(n + 1, int(n * self.ratio))
        return np.array([*sizes, n_tests], dtype=np.int64)

    @property
    def z(self) -> float:
        """Quantile of the normal interval."""
        return Level.two_sided(self.confidence).z


class Tests(NamedTuple):
    """So many tests ``n`` from a first one on, and (k,) indices and weights, in index order, of those that crashed.

    ``sum_of_weights`` is that of all.
    """

    n: int
    sum_of_weights: float
    episode: IntArray
    y: FloatArray

    @classmethod
    def of_block(cls, block: Block) -> Tests:
        """Those of a block.

        Raises `HarnessError`: some failed, of which the paper's counts know nothing.
        """
        if n_failed := np.count_nonzero(block.failed):
            mend = "Mend the vehicle, or estimate its crash rate by `harness run`, which bounds what failed tests hide."
            raise HarnessError(f"tests from {block.first_episode:,} on", f"{n_failed:,} failed", "none", mend)
        at = np.flatnonzero(block.crash)
        return cls(len(block), float(block.weights().sum()), block.first_episode + at, block.weighted_crashes()[at])

    @classmethod
    def joined(cls, parts: Iterable[Tests]) -> Tests:
        """All in one."""
        n, weights, *rows = zip(*parts, strict=True)
        return cls(sum(n), math.fsum(weights), *(np.concatenate(each) for each in rows))

    def first(self, n: int | None) -> Tests:
        """The first n of them, but for the sum of weights, or all."""
        if n is None or n >= self.n:
            return self
        kept = self.episode < n
        return Tests(n, math.nan, self.episode[kept], self.y[kept])


def first_block(folder: Path, n: int) -> Block:
    """The first n tests of a stored run, with ratios of control steps."""
    return joined(list(cut_at(stored_blocks(folder, moments=True), [n])))


def cut_at(blocks: Iterator[Block], ends: Sequence[int]) -> Iterator[Block]:
    """The same tests up to the last of some rising ends, in blocks that end at each of these, too."""
    for block in blocks if ends else ():
        first, stop = block.first_episode, block.first_episode + len(block)
        cuts = [0, *(end - first for end in ends[:-1] if first < end < stop), min(len(block), ends[-1] - first)]
        for start, end in pairwise(cuts):
            yield block.take(slice(start, end))
        if stop >= ends[-1]:
            return


@dataclass(frozen=True, eq=False)
class RequiredTests:
    """RNoT ``n`` of every shuffle (s,), all tests where the threshold is never reached: above it at the last look.

    ``settled`` says whether the weights of the tests have come in.
    """

    n: IntArray
    never_reached: BoolArray
    settled: bool = True

    @property
    def is_lower_limit(self) -> bool:
        """Whether some shuffle would have needed more tests than the total, and the mean is a lower limit."""
        return bool(self.never_reached.any())

    def figure(self, confidence: float) -> dict[str, Any]:
        """Mean over shuffles with its interval; a lower limit where some needed more tests than there were."""
        mean = mean_of(self.n.tolist(), confidence)
        if self.is_lower_limit:
            mean = figure(None if self.never_reached.all() else mean["value"], mean["low"] or mean["value"])
        return marked(mean, settled=self.settled)

    def over(self, other: RequiredTests, confidence: float) -> dict[str, Any]:
        """AAR of the other one: ratio of the means, open where one of them is a lower limit."""
        value, low, high = ratio_of_means(self.n, other.n, confidence).values()
        if self.is_lower_limit:
            low, high = low or value, None
        if other.is_lower_limit:
            low, high = None, None if self.is_lower_limit else high or value
        nothing = self.is_lower_limit and other.is_lower_limit
        return marked(figure(None if nothing else value, low, high), settled=self.settled and other.settled)


def required_tests(rhw: FloatArray, grid: IntArray, threshold: float) -> RequiredTests:
    """Read the RNoT off the RHW (s, g) of every shuffle and prefix of the grid (g,); NaN is above any threshold.

    Shuffles that are nowhere above it have the n of the largest RHW, the smaller one of equals.
    """
    above = ~(rhw <= threshold)
    never_above = np.asarray(~above.any(axis=1))
    settled = np.minimum(above.shape[1] - np.argmax(above[:, ::-1], axis=1), above.shape[1] - 1)
    at = np.where(never_above, np.argmax(rhw, axis=1), settled)
    return RequiredTests(grid[at], above[:, -1])


def plain_rhw(weights: FloatArray, n_tests: int, procedure: Procedure) -> FloatArray:
    """RHW of the mean of Y on prefixes of shuffled tests, shape (s, g); infinite before the first crash.

    Tests without a crash only take up places, so that the places of the crashes are all that a shuffle has to draw: a
    hundred million naturalistic tests cost no more than their crashes.

    ``weights`` (k,) are those of the tests that crashed, in the order of the records.
    """
    grid = procedure.grid(n_tests)
    # A unit that makes equal weights 1, whose sums are exact; the smallest squares would underflow besides.
    y = weights / np.max(weights, initial=0.0)
    rhw = np.empty((procedure.n_shuffles, len(grid)))
    for shuffle in range(procedure.n_shuffles):
        _, places = _crash_places(procedure.seed, shuffle, n_tests, len(y))
        order = np.argsort(places)
        n_placed = np.searchsorted(places[order], grid)
        total, half_width = total_and_half_width(y[order], n_placed, grid, procedure.z)
        rhw[shuffle] = half_width / total
    return rhw


def total_and_half_width(y: FloatArray, k: IntArray, n: IntArray, z: float) -> tuple[FloatArray, FloatArray]:
    """ΣY of the first ``k`` values among ``n`` tests, and z times its standard error; infinite if nothing is known."""
    total, squares = (np.concatenate([[0.0], np.cumsum(power)])[k] for power in (y, y * y))
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.maximum(0.0, squares - total * total / n) / (n - 1)
        half_width: FloatArray = z * np.sqrt(n * variance)
    half_width[(total == 0.0) | (n < 2)] = np.inf
    return total, half_width


def scv_rhw(tests: Block, procedure: Procedure) -> FloatArray:
    """RHW that the published `scv` claims on prefixes of shuffled tests, shape (s, g): Algorithm 1 on each anew.

    ``tests`` are all tests of a run in index order, with ``first_ratios``.
    """
    grid = procedure.grid(len(tests))
    rhw = np.empty((procedure.n_shuffles, len(grid)))
    for shuffle in range(procedure.n_shuffles):
        state, order = Scv(), shuffled(procedure.seed, shuffle, tests.crash)
        for at, (start, stop) in enumerate(pairwise([0, *grid.tolist()])):
            state.add(tests.chosen(order[start:stop]))
            rhw[shuffle, at] = state.result(procedure.confidence).rhw
    return rhw


def over_shuffles(tests: Tests, procedure: Procedure, *, settled: bool, scv_of: Block | None = None) -> RequiredTests:
    """RNoT of the mean of Y of tests; or, of a block of the same tests, of what `scv` claims."""
    rhw = plain_rhw(tests.y, tests.n, procedure) if scv_of is None else scv_rhw(scv_of, procedure)
    return replace(required_tests(rhw, procedure.grid(tests.n), procedure.rhw), settled=settled)


def _crash_places(seed: int, shuffle: int, n_tests: int, n_crashes: int) -> tuple[np.random.Generator, IntArray]:
    """Place of every crash in a shuffle, shape (k,), and the generator to go on with."""
    generator = np.random.default_rng([seed, shuffle])
    return generator, generator.choice(n_tests, size=n_crashes, replace=False)


def shuffled(seed: int, shuffle: int, placed: BoolArray) -> IntArray:
    """Rows in the order of a shuffle, shape (n,): crashed ones in their places, the others between them."""
    n = len(placed)
    generator, places = _crash_places(seed, shuffle, n, int(np.count_nonzero(placed)))
    order = np.full(n, -1, dtype=np.int64)
    order[places] = np.flatnonzero(placed)
    order[order < 0] = generator.permutation(np.flatnonzero(~placed))
    return order
