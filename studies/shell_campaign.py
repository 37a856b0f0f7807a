"""Shells campaigns and comparisons on drawn pools: allocation, rounds, stop rule and estimator are those of real ones.

Given the pool, the tests of a stratum are independent draws, so that the world is replaced by a few random numbers per
stratum and round: how many tests fall into each of its cells, and how many of those crash; of two vehicles, how many
pairs end in which way. A real campaign draws from a systematic sample of the pool's cut-ins without replacement, which
scatters no more than that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.sections import Accept
from harness.drawing.shells import PairRounds, ShellRounds
from harness.estimators.block import Block, Drawn
from harness.estimators.estimate import Estimate
from harness.estimators.likelihood import Level
from harness.estimators.pairs import CRASH, NO_CRASH, PairCounts, no_pairs
from harness.estimators.shells import Shells
from harness.estimators.stopping import PairRule, RoundRule
from harness.strata import LIBRARY_STATEMENT, ShellDesign
from harness.vocabulary import CRASH as CRASHED
from harness.vocabulary import FAILED, TIMEOUT, FloatArray, IntArray
from studies.experiment import Fault
from studies.judgement import Row, estimate_row
from studies.truths import CONDITIONAL_DIFFERENCE, DIFFERENCE, preventable_by, ratio_to

FREE = "shells"
_CRASHING = ((CRASH, CRASH), (CRASH, NO_CRASH), (NO_CRASH, CRASH))
"""How A and B end: both crash, only A, only B."""
_STATEMENT = ("testing", "shells", "statement")


def limit_at(factor: float) -> str:
    """Name of the decision about a limit, a multiple of the crash rate."""
    return f"limit {factor:g} x rate"


def result_of(statement: str) -> str:
    """Name of a statement's rows among results."""
    return f"{FREE}, {statement}"


@dataclass(frozen=True, eq=False)
class DrawnPool:
    """A pool, and what a vehicle does on its paths.

    ``mass`` and ``crash_mass`` (n, C) are each path's probability of a cut-in of each cell of the design, and of a
    crash in it; ``failing`` is the share of crashes that end as failed tests.
    """

    design: ShellDesign
    mass: FloatArray
    crash_mass: FloatArray
    failing: float = 0.0

    @cached_property
    def share(self) -> FloatArray:
        """Share of crashes in each cell, shape (C,)."""
        p, crash_p = self.mass.sum(0), self.crash_mass.sum(0)
        share = np.divide(crash_p, p, out=np.zeros_like(p), where=p > 0.0)
        return np.asarray(np.clip(share, 0.0, 1.0))  # rounding may leave the unit interval

    @cached_property
    def _cumulative(self) -> FloatArray:
        return np.cumsum(self.crash_mass, axis=0)

    def tests_of_cells(self, added: IntArray, rng: np.random.Generator) -> IntArray:
        """How many of so many tests of each stratum (S,) are of each cell, shape (C,)."""
        if added.size == self.mass.shape[1]:
            return added
        within = (self.design.joined * self.mass.sum(0)[:, None]).T
        p = within / np.maximum(within.sum(1, keepdims=True), np.finfo(np.float64).tiny)
        found: IntArray = rng.multinomial(added, p).sum(0)
        return found

    def crashed_paths(self, cell: int, n: int, rng: np.random.Generator) -> FloatArray:
        """Mass (n, C) of the paths of n crashed tests of a cell."""
        cumulative = self._cumulative[:, cell]
        paths: FloatArray = self.mass[np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right")]
        return paths


Draw = Callable[[np.random.Generator], Sequence[DrawnPool]]
"""Draws a new pool: with the crashes of a vehicle, or without references where both of two crash, only A, only B."""


@dataclass(frozen=True, eq=False)
class _Redrawn:
    """A campaign to repeat, each time on a new pool."""

    campaign: Campaign
    draw: Draw
    seed: int
    fault: Fault | None = None

    def run(self, replications: range) -> list[Row]:
        """Rows of all results for each replication."""
        return [row for replication in replications for row in self.rows(replication)]

    def rows(self, replication: int) -> Iterator[Row]:
        """Those of one replication."""
        raise NotImplementedError

    def _begin(self, replication: int) -> tuple[np.random.Generator, list[DrawnPool], IntArray]:
        """Random numbers, the pool, and the most tests of each stratum."""
        rng = np.random.default_rng([self.seed, replication])
        drawn = [_with_fault(pool, self.fault) for pool in self.draw(rng)]
        return rng, drawn, np.full(drawn[0].design.p.size, self.campaign.pool.cut_ins_per_shell, np.int64)


@dataclass(frozen=True, eq=False)
class ShellCampaign(_Redrawn):
    """A shells campaign to replicate; its stop rule, statement and first tests are used.

    Judged are all statements and the comparisons with reference drivers. With ``limits``, by name, it is repeated until
    all of these are decided, as by ``accept``, and they are judged instead.
    """

    limits: Mapping[str, float] = field(default_factory=dict)

    def rows(self, replication: int) -> Iterator[Row]:
        """See `_Redrawn`."""
        rng, (drawn,), available = self._begin(replication)
        planner = ShellRounds(self.campaign, drawn.design, available)
        rounds = self._decide if self.limits else self._replicate
        return rounds(replication, rng, drawn, planner)

    def _decide(
        self, replication: int, rng: np.random.Generator, drawn: DrawnPool, planner: ShellRounds
    ) -> Iterator[Row]:
        """All limits from the same tests: what is tested next does not depend on any."""
        pending = {
            name: RoundRule(self.campaign.model_copy(update={"accept": Accept(crash_rate_below=limit)}))
            for name, limit in self.limits.items()
        }
        while pending and (added := planner.next_round()).any():
            planner.enough(campaign_block(drawn, added, int(planner.tally.tests.sum()), rng))
            for name in [name for name, rule in pending.items() if rule.observe(planner.seen)]:
                yield self._decision_row(planner.seen, name, replication, pending.pop(name))
        for name, rule in pending.items():
            yield self._decision_row(planner.seen, name, replication, rule)

    def _decision_row(self, seen: Shells, name: str, replication: int, rule: RoundRule) -> Row:
        """A decision is a one-sided interval: below the limit, or above."""
        verdict = "undecided" if rule.look.decision is None else rule.look.decision.verdict
        limit, tally = self.limits[name], seen.tally
        return Row(
            name,
            replication,
            n_tests=int(tally.tests.sum()),
            n_crashes=int(tally.crashes.sum()),
            crash_rate=seen.limits_of(self.campaign.testing.shells.statement, self.campaign.stop.confidence).rate,
            std_error=seen.std_error(),
            ci_low=limit if verdict == "rejected" else 0.0,
            ci_high=limit if verdict == "accepted" else math.inf,
            reached=verdict != "undecided",
        )

    def _replicate(
        self, replication: int, rng: np.random.Generator, drawn: DrawnPool, planner: ShellRounds
    ) -> Iterator[Row]:
        names = [each.name for each in drawn.design.statements]
        rules = {name: RoundRule(self.campaign.replaced(_STATEMENT, name)) for name in names}
        known: dict[str, Row] = {}
        enough = False
        while not enough and (added := planner.next_round()).any():
            enough = planner.enough(campaign_block(drawn, added, int(planner.tally.tests.sum()), rng))
            for name, rule in rules.items():
                pending = name not in known and planner.seen.tally.tests.size
                if pending and rule.observe(planner.seen) and rule.look.stopped:
                    known[name] = self._statement_row(planner.seen, name, replication, reached=True)
        estimate = planner.seen.result(self.campaign.stop.confidence)
        outside = int(estimate.details["statements"][0]["n_crashes_outside"])
        yield estimate_row(FREE, replication, estimate, reached=planner.rule.look.stopped, outside=outside)
        for name in names:
            yield known.get(name) or self._statement_row(planner.seen, name, replication, reached=False)
        for reference in drawn.design.references:
            yield from _reference_rows(estimate, reference.name, replication, reached=planner.rule.look.stopped)

    def _statement_row(self, seen: Shells, name: str, replication: int, *, reached: bool) -> Row:
        found = seen.within(name, self.campaign.stop.confidence)
        return Row(
            result_of(name),
            replication,
            n_tests=found.n_episodes,
            n_crashes=found.n_crashes,
            crash_rate=found.crash_rate,
            std_error=seen.std_error(found.n_shells),
            ci_low=found.ci_low,
            ci_high=found.ci_high,
            reached=reached,
            n_crashes_outside=found.n_crashes_outside,
            refused=math.isinf(found.rhw_from_pool),
        )


def _with_fault(drawn: DrawnPool, fault: Fault | None) -> DrawnPool:
    """The pool with probabilities that are not those of its paths."""
    if fault is None:
        return drawn
    factor = np.where(np.array(drawn.design.cell_stratum) == fault.shell, fault.factor, 1.0)
    return replace(drawn, design=replace(drawn.design, cell_p=drawn.design.cell_p * factor))


def campaign_block(drawn: DrawnPool, added: IntArray, first: int, rng: np.random.Generator) -> Block:
    """What the records of a round become: within a cell the crashes come first, which no estimator can see."""
    tests = drawn.tests_of_cells(added, rng)
    cell, crashes = np.repeat(np.arange(tests.size), tests), rng.binomial(tests, drawn.share)
    n = cell.size
    rank = np.arange(n) - np.repeat(np.cumsum(tests) - tests, tests)
    none, bad = np.zeros(n, np.bool_), rank < crashes[cell]
    failed = bad & (rank < rng.binomial(crashes, drawn.failing)[cell]) if drawn.failing else none
    mass = np.zeros((n, tests.size))
    for c in np.flatnonzero(crashes).tolist():
        mass[bad & (cell == c)] = drawn.crashed_paths(c, int(crashes[c]), rng)
    columns = {"cut_in": ~none, "stratum": np.array(drawn.design.cell_stratum)[cell], "cell": cell, "cell_mass": mass}
    outcome = np.select([failed, bad], [FAILED, CRASHED], TIMEOUT).astype(np.int8)
    return Block(first, outcome, np.zeros(n), columns, Drawn("shells", shells=drawn.design))


def _reference_rows(estimate: Estimate, reference: str, replication: int, *, reached: bool) -> Iterator[Row]:
    """Ratio to a reference driver, and the share of crashes that it would have avoided; open where nothing is said."""
    found = next((each for each in estimate.details["references"] if each["reference"] == reference), None)
    z = Level.two_sided(estimate.confidence).z
    for name, key, widest in (
        (ratio_to(reference), "ratio", (math.nan, 0.0, math.inf)),
        (preventable_by(reference), "preventable", (math.nan, 0.0, 1.0)),
    ):
        value, low, high = widest if found is None else (found[key], found[f"{key}_low"], found[f"{key}_high"])
        counts, error = (estimate.n_episodes, estimate.n_crashes), (high - low) / 2.0 / z
        yield Row(name, replication, *counts, value, error, low, high, reached, refused=found is None)


@dataclass(frozen=True, eq=False)
class PairedCampaign(_Redrawn):
    """A comparison of two vehicles to replicate, by both statements; ``campaign`` is that of either vehicle."""

    def rows(self, replication: int) -> Iterator[Row]:
        """See `_Redrawn`."""
        rng, drawn, available = self._begin(replication)
        planner = PairRounds(self.campaign, drawn[0].design, available, None)
        pairs, early = no_pairs(drawn[0].design), None
        inside, enough = PairRule(self.campaign.replaced(_STATEMENT, LIBRARY_STATEMENT), None), False
        while not enough and (added := planner.next_round(pairs)).any():
            pairs = _with_round(pairs, drawn, added, rng)
            enough = planner.rule.observe(pairs)
            if early is None:
                inside.observe(pairs)
                early = pairs.inside() if inside.look.stopped else None
        yield self._row(DIFFERENCE, replication, pairs, reached=planner.rule.look.stopped)
        yield self._row(CONDITIONAL_DIFFERENCE, replication, early or pairs.inside(), reached=early is not None)

    def _row(self, result: str, replication: int, pairs: PairCounts, *, reached: bool) -> Row:
        level = Level.two_sided(self.campaign.stop.confidence)
        found = pairs.difference(level)
        outside = pairs.ends[pairs.design.library.n_inside :]
        return Row(
            result,
            replication,
            n_tests=int(pairs.tests.sum()),
            n_crashes=pairs.n_differing,
            crash_rate=found.value,
            std_error=found.half_width / level.z,
            ci_low=found.ci_low,
            ci_high=found.ci_high,
            reached=reached,
            n_crashes_outside=int(outside.sum() - outside[:, NO_CRASH, NO_CRASH].sum()),
        )


def _with_round(pairs: PairCounts, drawn: Sequence[DrawnPool], added: IntArray, rng: np.random.Generator) -> PairCounts:
    """The pairs after a round of so many more of each stratum (S,), by a multinomial of each."""
    share = np.column_stack([pool.share for pool in drawn])
    share = np.column_stack([share, np.maximum(1.0 - share.sum(1), 0.0)])
    counts = rng.multinomial(added, share / share.sum(1, keepdims=True))
    ends, mass = pairs.ends.copy(), pairs.mass.copy()
    ends[:, NO_CRASH, NO_CRASH] += counts[:, -1]
    for kind, pool, of_kind in zip(_CRASHING, drawn, counts.T[:-1], strict=True):
        ends[:, *kind] += of_kind
        mass[:, *kind] += [pool.crashed_paths(s, k, rng).sum(0) for s, k in enumerate(of_kind.tolist())]
    return PairCounts(pairs.design, ends, mass)
