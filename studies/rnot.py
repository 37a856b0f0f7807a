"""The required number of tests (RNoT) as published, and what `python -m studies rnot` prints of it for stored runs.

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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from harness.campaign.files import load_campaign
from harness.errors import HarnessError
from harness.estimators.block import Block, joined
from harness.estimators.estimate import FailureBounds, finite_json
from harness.estimators.likelihood import Level
from harness.estimators.one_pass import refusal
from harness.estimators.scv import Scv
from harness.progress import Progress
from harness.report.notes import note_words
from harness.runner.stored import stored_blocks
from harness.vocabulary import CRASH, FAILED, BoolArray, FloatArray, Int8Array, IntArray

RnotEstimator = Literal["nde", "nade", "scv"]
SHOWN = ("run", "estimator", "n_episodes", "grid", "mean", "low_5", "high_95", "never_reached", "aar", "aar_is")
"""What a terminal shows of a row."""
SCV_REMARK = (
    "rests on the variance that scv claims, which is too small (docs/scv-defect.md): this is the number that the "
    "published procedure reports, not the number of tests that is needed"
)


@dataclass(frozen=True)
class Procedure:
    """What the paper leaves to be chosen, and what it chose: defaults of threshold, level and number of shuffles.

    ``first`` is the smallest prefix that is looked at, at least 2, ``ratio`` how much larger each next one is, above 1,
    ``total`` the largest one; None, or more than there are tests, for all tests.
    """

    rhw: float = 0.3
    confidence: float = 0.9
    n_shuffles: int = 200
    seed: int = 1
    first: int = 10
    ratio: float = 1.05
    total: int | None = None

    def grid(self, n_tests: int) -> IntArray:
        """Prefixes to look at, shape (g,): rising, the last one being the total."""
        total, sizes, n = min(self.total or n_tests, n_tests), list[int](), self.first
        while n < total:
            sizes.append(n)
            n = max(n + 1, int(n * self.ratio))
        return np.array([*sizes, total], dtype=np.int64)

    @property
    def z(self) -> float:
        """Quantile of the normal interval."""
        return Level.two_sided(self.confidence).z


class Tests(NamedTuple):
    """So many tests ``n`` from a first one on, and (k,) rows in index order of those that crashed or failed.

    ``sum_of_weights`` is that of all.
    """

    n: int
    sum_of_weights: float
    episode: IntArray
    weight: FloatArray
    failed: BoolArray

    @classmethod
    def of(cls, first: int, outcome: Int8Array, log_weight: FloatArray) -> Tests:
        """Those of consecutive rows (n,) of records."""
        at = np.flatnonzero((outcome == CRASH) | (outcome == FAILED))
        weight = np.exp(np.where(np.isfinite(log_weight[at]), log_weight[at], 0.0))
        with np.errstate(over="ignore"):
            return cls(len(outcome), float(np.exp(log_weight).sum()), first + at, weight, outcome[at] == FAILED)

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
        return Tests(n, math.nan, self.episode[kept], self.weight[kept], self.failed[kept])

    @property
    def y(self) -> FloatArray:
        """Weighted crashes (k,); a failed test counts as none."""
        return np.where(self.failed, 0.0, self.weight)


def read_run(folder: Path, *, with_ratios: bool = False) -> tuple[Tests, Block]:
    """Tests of a stored run, and all of them as one block where ratios are asked for, else some of them.

    Raises `HarnessError`: the folder is not a run, its records are damaged or incomplete, or its tests were drawn from
    shells.
    """
    if load_campaign(folder / "campaign.yaml", check_files=False).testing.method == "shells":
        found = "tests drawn from shells, of which each has its own probability"
        expected = "tests that can change places: drawn by nde, forced, step_mixture or episode_mixture"
        mend = "For shells the number of tests is what the run itself needed: see docs/shells.md."
        raise HarnessError(str(folder), found, expected, mend)
    parts, kept = list[Tests](), list[Block]()
    for block in stored_blocks(folder, moments=with_ratios):
        parts.append(Tests.of(block.first_episode, block.outcome, block.log_weight))
        kept = [*kept, block] if with_ratios else [block]
    return Tests.joined(parts), joined(kept)


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
    """RNoT ``n`` of every shuffle (s,), the total where the threshold is never reached.

    Shuffles ``never_reached`` (s,) are above it at the total. Those ``never_above`` (s,) it have the n of the largest
    RHW, the smaller one of equals.
    """

    n: IntArray
    never_reached: BoolArray
    never_above: BoolArray

    @property
    def mean(self) -> float:
        """Average RNoT."""
        return float(np.mean(self.n))

    @property
    def is_lower_limit(self) -> bool:
        """Whether some shuffle would have needed more tests than the total, and the mean is a lower limit."""
        return bool(self.never_reached.any())

    def quantile(self, share: float) -> int:
        """Smallest RNoT that at least this share of the shuffles does not exceed."""
        return int(np.quantile(self.n, share, method="inverted_cdf"))


def required_tests(rhw: FloatArray, grid: IntArray, threshold: float) -> RequiredTests:
    """Read the RNoT off the RHW (s, g) of every shuffle and prefix of the grid (g,).

    It is infinite where nothing can be said; NaN counts as above any threshold.
    """
    above = ~(rhw <= threshold)
    never_above = np.asarray(~above.any(axis=1))
    settled = np.minimum(above.shape[1] - np.argmax(above[:, ::-1], axis=1), above.shape[1] - 1)
    at = np.where(never_above, np.argmax(rhw, axis=1), settled)
    return RequiredTests(grid[at], above[:, -1], never_above)


def acceleration(reference: RequiredTests, other: RequiredTests) -> tuple[float, str]:
    """AAR of `other` over `reference`, and which side of the truth it is on ("unknown": both are lower limits)."""
    words = {(False, False): "equal", (True, False): "at least", (False, True): "at most", (True, True): "unknown"}
    return reference.mean / other.mean, words[reference.is_lower_limit, other.is_lower_limit]


def plain_rhw(
    weights: FloatArray,
    n_tests: int,
    procedure: Procedure,
    done: Callable[[], None] = lambda: None,
    failed: BoolArray | bool = False,
) -> FloatArray:
    """RHW of the mean of Y on prefixes of shuffled tests, shape (s, g); infinite before the first crash.

    Tests without a crash only take up places, so that the places of the crashes are all that a shuffle has to draw: a
    hundred million naturalistic tests cost no more than their crashes. Failed tests count as no crash in the lower
    limit and as crashes in the upper one.

    ``weights`` (k,) are those of the tests that crashed or ``failed`` (k,), in the order of the records; ``done`` is
    called after each shuffle.
    """
    grid, z = procedure.grid(n_tests), procedure.z
    # A unit that makes equal weights 1, whose sums are exact; the smallest squares would underflow besides.
    worst = weights / np.max(weights, initial=0.0)
    y = np.where(failed, 0.0, worst) if np.any(failed) else worst
    rhw = np.empty((procedure.n_shuffles, len(grid)))
    for shuffle in range(procedure.n_shuffles):
        _, places = _crash_places(procedure.seed, shuffle, n_tests, len(y))
        order = np.argsort(places)
        n_placed = np.searchsorted(places[order], grid)
        total, below = total_and_half_width(y[order], n_placed, grid, z)
        most, above = (total, below) if y is worst else total_and_half_width(worst[order], n_placed, grid, z)
        rhw[shuffle] = ((most - total) + above + below) / 2.0 / total
        done()
    return rhw


def total_and_half_width(y: FloatArray, k: IntArray, n: IntArray, z: float) -> tuple[FloatArray, FloatArray]:
    """ΣY of the first ``k`` values among ``n`` tests, and z times its standard error; infinite if nothing is known."""
    total, squares = (np.concatenate([[0.0], np.cumsum(power)])[k] for power in (y, y * y))
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.maximum(0.0, squares - total * total / n) / (n - 1)
        half_width: FloatArray = z * np.sqrt(n * variance)
    half_width[(total == 0.0) | (n < 2)] = np.inf
    return total, half_width


def scv_rhw(tests: Block, procedure: Procedure, done: Callable[[], None] = lambda: None) -> FloatArray:
    """RHW that the published `scv` claims on prefixes of shuffled tests, shape (s, g): Algorithm 1 on each anew.

    ``tests`` are all tests of a run in index order, with ``first_ratios``; ``done`` is called after each shuffle.
    """
    grid = procedure.grid(len(tests))
    rhw = np.empty((procedure.n_shuffles, len(grid)))
    for shuffle in range(procedure.n_shuffles):
        state = FailureBounds(Scv())
        order = shuffled(procedure.seed, shuffle, tests.crash | tests.failed)
        for at, (start, stop) in enumerate(pairwise([0, *grid.tolist()])):
            state.add(tests.chosen(order[start:stop]))
            rhw[shuffle, at] = state.result(procedure.confidence).rhw
        done()
    return rhw


def over_shuffles(
    tests: Tests, procedure: Procedure, done: Callable[[], None] = lambda: None, *, scv_of: Block | None = None
) -> RequiredTests:
    """RNoT of the mean of Y of tests; or, of a block of the same tests, of what `scv` claims."""
    if scv_of is None:
        rhw = plain_rhw(tests.weight, tests.n, procedure, done, tests.failed)
    else:
        rhw = scv_rhw(scv_of, procedure, done)
    return required_tests(rhw, procedure.grid(tests.n), procedure.rhw)


def _crash_places(seed: int, shuffle: int, n_tests: int, n_crashes: int) -> tuple[np.random.Generator, IntArray]:
    """Place of every crash in a shuffle, shape (k,), and the generator to go on with."""
    generator = np.random.default_rng([seed, shuffle])
    return generator, generator.choice(n_tests, size=n_crashes, replace=False)


def shuffled(seed: int, shuffle: int, placed: BoolArray) -> IntArray:
    """Rows in the order of a shuffle, shape (n,): crashed and failed ones in their places, the others between them."""
    n = len(placed)
    generator, places = _crash_places(seed, shuffle, n, int(np.count_nonzero(placed)))
    order = np.full(n, -1, dtype=np.int64)
    order[places] = np.flatnonzero(placed)
    order[order < 0] = generator.permutation(np.flatnonzero(~placed))
    return order


def required_tests_of_runs(
    folders: Sequence[Path],
    procedure: Procedure,
    *,
    estimators: Sequence[RnotEstimator] = (),
    progress: Progress | None = None,
) -> dict[str, Any]:
    """RNoT of every run and estimator, and its AAR over the first of them, as JSON content.

    The default estimator is the plain one of each run: ``nde`` for naturalistic tests, ``nade`` for weighted ones.
    Raises `HarnessError`, see `read_run`.
    """
    told, rows = progress or Progress(), []
    reference: RequiredTests | None = None
    for folder in folders:
        tests, block = read_run(folder, with_ratios="scv" in estimators)
        plain: RnotEstimator = "nde" if block.drawn.method == "nde" else "nade"
        grid, n_crashes = procedure.grid(tests.n), int(np.count_nonzero(~tests.failed))
        for name in dict.fromkeys(estimators or [plain]):
            rows.append(row := {"run": str(folder), "estimator": name, "n_episodes": tests.n, "n_crashes": n_crashes})
            if why := refusal(block, name):
                row |= {"mean": None, "reason": note_words(why)}
                continue
            told.stage(f"{folder.name} {name}", procedure.n_shuffles)
            found = over_shuffles(tests, procedure, lambda: told.advance(1), scv_of=block if name == "scv" else None)
            reference = reference or found
            aar, side = acceleration(reference, found)
            row |= {
                "grid": f"{grid[0]:,} to {grid[-1]:,} by {procedure.ratio - 1.0:.3g} n ({len(grid)} looks)",
                "mean": found.mean,
                "mean_is_lower_limit": found.is_lower_limit,
                "low_5": found.quantile(0.05),
                "high_95": found.quantile(0.95),
                "never_reached": int(np.count_nonzero(found.never_reached)),
                "never_above": int(np.count_nonzero(found.never_above)),
                "aar": None if side == "unknown" else aar,
                "aar_is": side,
                "remarks": _remarks(tests, name, found, int(grid[-1]), procedure.rhw),
            }
    return finite_json({**asdict(procedure), "rows": rows})


def _remarks(tests: Tests, name: str, found: RequiredTests, total: int, rhw: float) -> list[str]:
    """What limits a required number of tests."""
    many, above, n_failed = (np.count_nonzero(x) for x in (found.never_reached, found.never_above, tests.failed))
    shuffles = f"of {len(found.n)} shuffles are"
    remarks = {
        SCV_REMARK: name == "scv",
        f"{n_failed} tests failed: the lower limit counts them as no crash, the upper one as crashes": n_failed,
        f"{many} {shuffles} above RHW {rhw:g} at {total:,} tests and count as so many: the mean is a lower limit": many,
        f"above half of the {tests.n:,} tests on record shuffles of the same tests hardly differ: ask a longer run": (
            not many and found.quantile(0.95) > tests.n / 2
        ),
        f"{above} {shuffles} nowhere above RHW {rhw:g}: each has the n of its largest RHW, as in the paper": above,
    }
    return [remark for remark, holds in remarks.items() if holds]
