"""Shells campaigns and comparisons on pools drawn anew: allocation, rounds, rules and estimator are those of real ones.

Given the pool, the tests of a stratum are independent draws, so that the world is replaced by a few random numbers per
stratum and round: how many tests fall into each of its cells, and how many of those crash; of two vehicles, how many
pairs end in which way. A real campaign draws from a systematic sample of the pool's cut-ins without replacement, which
scatters no more than that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from harness.campaign.campaign import Campaign
from harness.campaign.sections import Accept, TimesReference
from harness.errors import CampaignError
from harness.estimators.estimate import Estimate
from harness.estimators.likelihood import Level, likelihood_limit
from harness.estimators.pairs import CRASH, NO_CRASH, PairCounts, Pairs, no_pairs
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import PairRule, RoundRule
from harness.estimators.tally import CrashedTests, Tally
from harness.pool.shells import (
    KeptEvents,
    Pool,
    boundary_shell,
    cells_in_strata,
    design_shells,
    shells_in_strata,
    shells_of,
)
from harness.sampling.shells import Allocation, PairRounds, ShellRounds
from harness.strata import LIBRARY_STATEMENT, ShellDesign
from harness.vehicles.library import Library
from harness.vocabulary import BoolArray, FloatArray, IntArray
from studies.replication.experiment import Adversary
from studies.replication.judgement import FORMER, Row, estimate_row
from studies.replication.populations import (
    CONDITIONAL_DIFFERENCE,
    DIFFERENCE,
    SuperPopulation,
    preventable_by,
    ratio_to,
)

FREE = "shells"
EQUAL_RATE = 0.02
"""A surrogate whose crash rate is this close to the vehicle's counts as its equal."""
_CRASHING = ((CRASH, CRASH), (CRASH, NO_CRASH), (NO_CRASH, CRASH))
"""How A and B end: both crash, only A, only B."""
_STATEMENT = ("testing", "shells", "statement")
BOUND = "shells, upper bound"
WITHIN, BOUND_OUTSIDE = f"{FREE}, {LIBRARY_STATEMENT}", f"{FREE}, upper bound beyond {LIBRARY_STATEMENT}"
"""Names of the statement's rows, and of the bound on the crash rate beyond its boundary."""


def limit_at(factor: float, budget: int) -> dict[str, str]:
    """Names of what is judged of decisions about a limit within a budget: how often a verdict that is wrong is given.

    The limit is a multiple of the crash rate. Where it is the truth, either verdict is wrong.
    """
    wrong = ["accepted"] * (factor <= 1.0) + ["rejected"] * (factor >= 1.0)
    return {f"limit {factor:g} x rate, {verdict} within {budget:,} tests": verdict for verdict in wrong}


class CrashingCutIns(NamedTuple):
    """Cut-ins of some paths on which a vehicle crashes, (m,) each, by ascending path.

    ``number`` tells them apart, and ``cell`` is that of the pool, or of a design. Each happens with the probability
    ``mass``, and with ``crash_mass`` the vehicle crashes besides.
    """

    path: IntArray
    number: IntArray
    cell: IntArray
    mass: FloatArray
    crash_mass: FloatArray

    def of_paths(self, rows: IntArray, cells: IntArray) -> CrashingCutIns:
        """Those of given paths (n,), which are numbered anew; ``cells`` (C,) are the cells that become of each."""
        first, end = (np.searchsorted(self.path, rows, side=side) for side in ("left", "right"))
        path = np.repeat(np.arange(rows.size), end - first)
        places = np.arange(path.size) - np.repeat(np.cumsum(end - first) - end, end - first)
        cell = cells[self.cell[places]]
        path, places, cell = path[cell >= 0], places[cell >= 0], cell[cell >= 0]
        return CrashingCutIns(path, self.number[places], cell, self.mass[places], self.crash_mass[places])


@dataclass(frozen=True, eq=False)
class DrawnPool:
    """A pool, and what a vehicle does on its paths.

    ``mass`` and ``crash_mass`` (n, C) are each path's probability of a cut-in of each cell of the design, and of a
    crash in it; ``failing`` is the share of crashes that end as failed tests, ``failing_tests`` that of all tests. Of
    paths that the vehicle has walked ``events`` are those on which it crashes, and tests fail on no others.
    """

    design: ShellDesign
    mass: FloatArray
    crash_mass: FloatArray
    failing: float = 0.0
    failing_tests: float = 0.0
    events: CrashingCutIns | None = None

    @cached_property
    def share(self) -> FloatArray:
        """Share of crashes in each cell, shape (C,)."""
        p, crash_p = self.mass.sum(0), self.crash_mass.sum(0)
        share = np.divide(crash_p, p, out=np.zeros_like(p), where=p > 0.0)
        return np.asarray(np.clip(share, 0.0, 1.0))  # rounding may leave the unit interval

    @cached_property
    def _of_stratum(self) -> FloatArray:
        """Shares of a stratum's tests that are of each cell, shape (S, C)."""
        within = (self.design.joined * self.mass.sum(0)[:, None]).T
        return np.asarray(within / np.maximum(within.sum(1, keepdims=True), np.finfo(np.float64).tiny))

    @cached_property
    def _cumulative(self) -> tuple[FloatArray, FloatArray]:
        """Sums of mass, and of crash mass, up to each path, by cell, shape (C, n)."""
        crash_mass = self.crash_mass
        if (known := self.events) is not None:
            crash_mass = np.where(known.cell[:, None] == np.arange(self.mass.shape[1]), known.crash_mass[:, None], 0.0)
        mass, crash_mass = (np.cumsum(np.ascontiguousarray(each.T), axis=1) for each in (self.mass, crash_mass))
        return mass, crash_mass

    def paths_of(self, n_by_cell: IntArray, rng: np.random.Generator, *, crashed: bool = True) -> list[IntArray]:
        """Paths of so many crashed tests of each cell (C,), or of any; of crashed ones places in ``events``."""
        return [
            np.searchsorted(up_to, rng.random(n) * up_to[-1:].sum(), side="right")
            for up_to, n in zip(self._cumulative[int(crashed)], n_by_cell.tolist(), strict=True)
        ]

    def tests_of(self, added: IntArray, rng: np.random.Generator) -> tuple[IntArray, list[IntArray], list[IntArray]]:
        """So many more tests of each stratum (S,): how many are of each cell (C,), paths of crashed and failed ones."""
        tests = added
        if added.size != self.mass.shape[1]:
            tests = rng.multinomial(added, self._of_stratum).sum(0)
        bad = rng.binomial(tests, self.share)
        n_failed = rng.binomial(bad, self.failing + self.failing_tests * (1.0 - self.failing)).tolist()
        paths = self.paths_of(bad, rng)
        others = self.paths_of(rng.binomial(tests - bad, self.failing_tests), rng, crashed=False)
        crashed = [rows[n:] for rows, n in zip(paths, n_failed, strict=True)]
        failed = [np.append(rows[:n], other) for rows, n, other in zip(paths, n_failed, others, strict=True)]
        return tests, crashed, failed

    def count(self, added: IntArray, seen: SeenShells, rng: np.random.Generator) -> None:
        """Draw so many more tests of each stratum (S,), and count what their records would say."""
        tests, *paths = self.tests_of(added, rng)
        known, on_runs = self.events, None
        if known is not None:
            place = np.repeat(np.arange(2 * tests.size), [rows.size for cells in paths for rows in cells])
            rows = np.concatenate([rows for cells in paths for rows in cells])
            on_runs = CrashedTests(known.path[rows], known.number[rows], known.mass[rows], place)
            paths = [[known.path[rows] for rows in cells] for cells in paths]
        (crashes, crash_mass), (failed, failed_mass) = (
            (np.array([rows.size for rows in cells]), np.array([self.mass[rows].sum(0) for rows in cells]))
            for cells in paths
        )
        seen.count(self.design, Tally(tests, crashes, failed, crash_mass, failed_mass), on_runs)

    def available(self, campaign: Campaign) -> IntArray:
        """The most tests of each stratum, shape (S,)."""
        return np.full(self.design.p.size, campaign.pool.events_per_shell, np.int64)


Draw = Callable[[np.random.Generator], Sequence[DrawnPool]]
"""Draws a new pool: with the crashes of a vehicle, or without references where both of two crash, only A, only B."""


def looks(
    campaign: Campaign, drawn: DrawnPool, rng: np.random.Generator, budgets: Sequence[int] = ()
) -> Iterator[tuple[SeenShells, ShellRounds, bool]]:
    """One campaign on a pool until nothing is left: all tests after each round, the planner, and its rule's answer.

    Its budget is raised from each of some smaller ones to the next. Such a budget ends in the midst of a round, with a
    smaller round in its place: that is a look, too. What both rounds have in common is tested once.
    """
    available = drawn.available(campaign)
    planner, seen = ShellRounds(campaign, drawn.design, available, RoundRule(campaign)), SeenShells(drawn.design)
    allocation = Allocation.of(campaign.testing.shells, drawn.design, available)
    while (added := planner.next_round(seen)[0]).any():
        before, left = seen.tally, added
        n = int(before.tests.sum())
        for budget in budgets:
            if n < budget < n + added.sum():
                last = np.maximum(allocation.next_round(before, budget - n) - (added - left), 0)
                drawn.count(np.minimum(last, left), seen, rng)
                drawn.count(np.maximum(last - left, 0), spent := deepcopy(seen), rng)
                left = np.maximum(left - last, 0)
                yield spent, planner, False
        drawn.count(left, seen, rng)
        yield seen, planner, planner.rule.observe(seen)


class FormerRule(RoundRule):
    """A sibling of the rule of decisions: limits of the interval, which allow for no look but one."""

    @staticmethod
    def level_at(_expected: float, confidence: float) -> Level:
        """That of the interval."""
        return Level.two_sided(confidence)


def former_bound(p: FloatArray, tally: Tally, confidence: float) -> float:
    """A sibling of bounds: it leaves out all of 1 - confidence above, and knows of no error of the pool."""
    worst, tail = tally.failed_as_crashes(), 1.0 - confidence
    level = Level(-math.log(tail), -float(ndtri(tail)))
    return min(likelihood_limit(p, worst.crashes, worst.tests, level, 1.0), float(p.sum()))


@dataclass(frozen=True, eq=False)
class _Drawn:
    """What is replicated, each time on a new pool; ``campaign`` is that of the vehicle, or of either of two."""

    campaign: Campaign
    draw: Draw
    seed: int

    def run(self, replications: range) -> list[Row]:
        """Rows of all results for each replication."""
        streams = ((each, np.random.default_rng([self.seed, each])) for each in replications)
        return [row for each, rng in streams for row in self._replicate(each, self.draw(rng), rng)]

    def _replicate(self, replication: int, drawn: Sequence[DrawnPool], rng: np.random.Generator) -> Iterator[Row]:
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class ShellCampaign(_Drawn):
    """A shells campaign to replicate; its stop rule, statement and first tests are used.

    Judged are both statements and the comparisons with reference drivers. With ``limits``, by their multiple of the
    crash rate, all of these are decided instead, as by ``accept``, and judged within each of the ``budgets``; what is
    tested next depends on neither. They may be multiples of the rate of a reference driver, ``beside``; with
    ``estimated`` intervals are judged besides. ``siblings`` see `FORMER`; and intervals of vehicles that act before the
    cut-in are made by pairs of tests alone, see `OnRuns`.
    """

    limits: Mapping[float, float] = field(default_factory=dict)
    budgets: Sequence[int] = ()
    siblings: bool = False
    beside: str | None = None
    estimated: bool = False

    def _replicate(self, replication: int, drawn: Sequence[DrawnPool], rng: np.random.Generator) -> Iterator[Row]:
        if self.limits:
            yield from self._decide(replication, drawn[0], rng)
        if self.estimated or not self.limits:
            yield from self._estimate(replication, drawn[0], rng)

    def _decide(self, replication: int, drawn: DrawnPool, rng: np.random.Generator) -> Iterator[Row]:
        rules: dict[tuple[float, str], RoundRule] = {}
        for factor, limit in self.limits.items():
            beside = self.beside and TimesReference(driver=self.beside, at_most=limit)
            accept = Accept(times_reference=beside) if beside else Accept(crash_rate_below=limit)
            asked = self.campaign.model_copy(update={"accept": accept})
            rules[factor, ""] = RoundRule(asked)
            if self.siblings and factor == 1.0:
                rules[factor, FORMER] = FormerRule(asked)
        known, left = dict[tuple[float, str], Row](), list(self.budgets)

        def judged(seen: SeenShells, budget: int) -> Iterator[Row]:
            for (factor, by), rule in rules.items():
                row = known.get((factor, by)) or self._decision(seen, replication, rule)
                for name, wrong in limit_at(factor, budget).items():
                    yield replace(row, result=name + by, ci_high=0.0 if row.result == wrong else math.inf)

        for seen, *_ in looks(self.campaign, drawn, rng, self.budgets):
            for which, rule in rules.items():
                if which not in known and rule.observe(seen):
                    known[which] = self._decision(seen, replication, rule)
            if seen.tally.tests.sum() == left[0]:
                yield from judged(seen, left.pop(0))
            if len(known) == len(rules):
                break
        for budget in left:  # everything is decided, or nothing left to test
            yield from judged(seen, budget)

    def _decision(self, seen: SeenShells, replication: int, rule: RoundRule) -> Row:
        """A verdict, for now with an interval that holds whatever is true."""
        verdict = "undecided" if rule.look.decision is None else rule.look.decision.verdict
        level, (n, n_crashes, _) = Level.two_sided(self.campaign.stop.confidence), seen.tally.totals
        rate = seen.limits(level, self.campaign.testing.shells.statement).rate
        decided = verdict != "undecided"
        return Row(verdict, replication, n, n_crashes, rate, seen.std_error(), 0.0, math.inf, decided)

    def _estimate(self, replication: int, drawn: DrawnPool, rng: np.random.Generator) -> Iterator[Row]:
        design = drawn.design
        rule, within = RoundRule(self.campaign.replaced(_STATEMENT, LIBRARY_STATEMENT)), None
        for seen, planner, enough in looks(self.campaign, drawn, rng):
            pending = within is None and seen.tally.tests.any()
            if pending and rule.observe(seen) and rule.look.stopped:
                within = self._statement_row(seen, replication, reached=True)
            reached = planner.rule.look.stopped
            if enough:
                break
        estimate = seen.result(self.campaign.stop.confidence)
        outside = int(estimate.details["within"]["n_crashes_outside"])
        row = estimate_row(FREE, replication, estimate, reached=reached, outside=outside)
        yield row
        found = estimate.details["within"]
        beyond_it = estimate.crash_rate - found["crash_rate"]  # whose error nobody claims to know
        for name, first, rate, error, bound in (
            (BOUND, 0, estimate.crash_rate, row.std_error, estimate.upper_bound),
            (BOUND_OUTSIDE, found["n_shells"], beyond_it, 0.0, found["upper_bound_outside"]),
        ):
            beyond = replace(row, result=name, crash_rate=rate, std_error=error, ci_low=0.0, ci_high=bound)
            yield beyond
            if self.siblings:
                part = seen.tally.part(slice(first, None))
                former = former_bound(design.p[first:], part, self.campaign.stop.confidence)
                yield replace(beyond, result=name + FORMER, ci_high=former)
        yield within or self._statement_row(seen, replication, reached=False)
        for reference in design.references:
            yield from _reference_rows(estimate, reference.name, replication, reached=reached)

    def _statement_row(self, seen: SeenShells, replication: int, *, reached: bool) -> Row:
        found = seen.within(self.campaign.stop.confidence)
        error, refused = seen.std_error(found.n_shells), math.isinf(found.rhw_from_pool)
        numbers = found.n_episodes, found.n_crashes, found.crash_rate, error, found.ci_low, found.ci_high
        return Row(WITHIN, replication, *numbers, reached, found.n_crashes_outside, refused)


def _reference_rows(estimate: Estimate, reference: str, replication: int, *, reached: bool) -> Iterator[Row]:
    """Ratio to a reference driver, and the share of crashes that it would have avoided; open where nothing is said."""
    found = next((each for each in estimate.details["references"] if each["reference"] == reference), None)
    z = Level.two_sided(estimate.confidence).z
    for name, key, open_ in (
        (ratio_to(reference), "ratio", (math.nan, 0.0, math.inf)),
        (preventable_by(reference), "preventable", (math.nan, 0.0, 1.0)),
    ):
        value, low, high = open_ if found is None else (found[key], found[f"{key}_low"], found[f"{key}_high"])
        counts, error = (estimate.n_episodes, estimate.n_crashes), (high - low) / 2.0 / z
        yield Row(name, replication, *counts, value, error, low, high, reached, refused=found is None)


class PairedCampaign(_Drawn):
    """A comparison of two vehicles to replicate, by both statements."""

    def _replicate(self, replication: int, drawn: Sequence[DrawnPool], rng: np.random.Generator) -> Iterator[Row]:
        rule, given = (
            PairRule(each, rhw=each.stop.rhw)
            for each in (self.campaign, self.campaign.replaced(_STATEMENT, LIBRARY_STATEMENT))
        )
        pairs, early, enough = no_pairs(drawn[0].design), None, False
        planner = PairRounds(self.campaign, pairs, [drawn[0].available(self.campaign)], rule)
        while not enough and (added := planner.next_round(pairs)[0]).any():
            pairs = _with_round(pairs, drawn, added, rng)
            enough = planner.rule.observe(pairs)
            if early is None:
                given.observe(pairs)
                early = pairs.within() if given.look.stopped else None
        yield self._row(DIFFERENCE, replication, pairs, reached=planner.rule.look.stopped)
        yield self._row(CONDITIONAL_DIFFERENCE, replication, early or pairs.within(), reached=early is not None)

    def _row(self, result: str, replication: int, pairs: Pairs, *, reached: bool) -> Row:
        level = Level.two_sided(self.campaign.stop.confidence)
        found, beyond = pairs.difference(level), pairs.ends[pairs.each[0].design.n_inside :]
        counts = int(pairs.tests.sum()), sum(pairs.n_alone)
        numbers = found.value, found.half_width / level.z, found.ci_low, found.ci_high
        outside = int(beyond.sum() - beyond[:, NO_CRASH, NO_CRASH].sum())
        return Row(result, replication, *counts, *numbers, reached, outside)


def _with_round(pairs: Pairs, drawn: Sequence[DrawnPool], added: IntArray, rng: np.random.Generator) -> Pairs:
    """The pairs after a round of so many more of each stratum (S,), by a multinomial of each."""
    share = np.column_stack([pool.share for pool in drawn])
    share = np.column_stack([share, np.maximum(1.0 - share.sum(1), 0.0)])
    counts = rng.multinomial(added, share / share.sum(1, keepdims=True))
    (own,) = pairs.each
    ends, mass = own.ends.copy(), own.mass.copy()
    ends[:, NO_CRASH, NO_CRASH] += counts[:, -1]
    for kind, pool, of_kind in zip(_CRASHING, drawn, counts.T[:-1], strict=True):
        ends[:, *kind] += of_kind
        mass[:, *kind] += [pool.mass[rows].sum(0) for rows in pool.paths_of(of_kind, rng)]
    return Pairs((PairCounts(own.design, ends, mass),))


@dataclass(frozen=True, eq=False)
class OvertakingShells:
    """Cells of a super-population's paths, of which pools of a vehicle, or of two, are drawn.

    The ``template`` is a pool without cut-ins, whose probabilities each draw replaces, and whose library has no equal
    of a vehicle; ``limit_mps2`` is the hardest acceleration of the vehicles, and ``mass`` (n, C) the probability of a
    cut-in of each cell, by path of the super-population. ``crashing`` are the parts of it on which the
    vehicle crashes, or both of two, only A, only B; ``failing``, ``failing_tests`` and ``events`` see `DrawnPool`.
    """

    template: Pool
    limit_mps2: float
    mass: FloatArray
    crashing: tuple[FloatArray, ...] = ()
    failing: float = 0.0
    failing_tests: float = 0.0
    events: CrashingCutIns | None = None

    @property
    def crash_rate(self) -> float:
        """That of the vehicle in the super-population."""
        return float(self.crashing[0].sum()) / len(self.mass)

    def reference_rate(self, name: str) -> float:
        """Crash rate of a reference driver in the super-population."""
        r = list(self.template.library.references).index(name)
        crashes = ((self.template.cell_references >> r) & 1).astype(np.bool_)
        return float(self.mass[:, crashes].sum()) / len(self.mass)

    def crashes_outside(self, crashing: FloatArray) -> float:
        """Share of a crash mass by cell (n, C) that lies beyond the boundary; 0 of no crash."""
        by_cell = crashing.sum(0)
        beyond = by_cell[self.template.cell_shell > boundary_shell(self.template)].sum()
        return float(beyond / (by_cell.sum() or 1.0))

    def draw(self, rng: np.random.Generator) -> list[DrawnPool]:
        """A new pool: its design, and what vehicles do on its paths by the design's cells; see `Draw`."""
        of, limit = self.template, self.limit_mps2
        rows = rng.integers(0, len(self.mass), of.n_paths)
        drawn = self.mass[rows]
        references = np.arange(len(of.library.references))
        by_reference = drawn @ np.asarray((of.cell_references[:, None] >> references) & 1, np.float64)
        pool = replace(
            of,
            cell_p=drawn.mean(0),
            p_event=float(drawn.sum(1).mean()),
            reference_rate=by_reference.mean(0),
            reference_square=(by_reference * by_reference).mean(0),
        )
        design = design_shells(pool, limit)
        cells = cells_in_strata(pool, shells_in_strata(pool, limit))[0]
        joined = np.eye(design.cell_p.size + 1)[cells, :-1]  # the last row is for what is not tested
        mass, failing = drawn @ joined, (self.failing, self.failing_tests)
        events = self.events and self.events.of_paths(rows, cells)
        return [DrawnPool(design, mass, each[rows] @ joined, *failing, events) for each in self.crashing]


class Division:
    """Cut-ins of a super-population, divided into cells by a library without the equals of some vehicles."""

    def __init__(
        self,
        library: Library,
        population: SuperPopulation,
        crashing: Sequence[FloatArray],
        pool_paths: int,
        *,
        limit_mps2: float,
        shadow_runs: bool = False,
    ) -> None:
        """Leave out the equals of vehicles that crash on these masses of cut-ins, (m,) each."""
        bit = {name: driver for driver, name in enumerate(library.surrogates)}
        rate = {name: float(population.mass[population.crashes(driver)].sum()) for name, driver in bit.items()}
        conservative_first = tuple(sorted(bit, key=rate.__getitem__))
        alike = set().union(*(equals(library, population, of_vehicle) for of_vehicle in crashing))
        reduced = leave_out(library, alike, conservative_first)
        names = tuple(name for name in conservative_first if name in reduced.surrogates)
        self._population = population
        order = np.array([bit[name] for name in names])
        self._shell = shells_of(population.bits, order).astype(np.int64)
        n_references = len(library.references)
        each_reference = (1 << n_references) - 1
        crash_too = (population.bits >> len(library.surrogates)) & each_reference
        nobody = len(names) << n_references
        kinds, cell = np.unique(np.append((self._shell << n_references) | crash_too, nobody), return_inverse=True)
        self._cell, self._n_cells = cell[:-1], kinds.size
        mass = self.by_cell(population.mass)
        mass[:, cell[-1]] += np.maximum(population.cut_in - mass.sum(1), 0.0)
        unknown: Any = np.zeros(0)
        content: dict[str, Any] = dict.fromkeys(Pool.__dataclass_fields__, unknown) | {
            "cell_shell": kinds >> n_references,
            "cell_references": kinds & each_reference,
            "cell_p": mass.mean(0),
            "p_event": float(mass.sum(1).mean()),
            "events": KeptEvents(
                **dict.fromkeys(KeptEvents.__dataclass_fields__, unknown) | {"motion": np.zeros(int(shadow_runs))}
            ),
            "p_after_failure": 0.0,
            "p_held": math.nan,
            "p_held_se": 0.0,
        }
        template = Pool(**content | {"key": "drawn", "library": reduced, "names": names, "n_paths": pool_paths})
        self._shells = OvertakingShells(template, limit_mps2, mass)

    def by_cell(self, mass: FloatArray) -> FloatArray:
        """A mass of cut-ins (m,) by path and cell, (n, C)."""
        place = self._population.path * self._n_cells + self._cell
        summed = np.bincount(place, mass, minlength=self._population.n_paths * self._n_cells)
        return np.asarray(summed, np.float64).reshape(-1, self._n_cells)

    def of_vehicle(self, crashing: FloatArray, made: Adversary | None = None) -> OvertakingShells:
        """Pools of a vehicle that crashes on this mass of cut-ins (m,), and fails as an adversary does."""
        failing, failing_tests = (0.0, 0.0) if made is None else (made.failing, made.failing_tests)
        found = replace(self._shells, crashing=(self.by_cell(crashing),), failing=failing, failing_tests=failing_tests)
        if not found.template.events.motion.size:
            return found
        on, population = np.flatnonzero(crashing > 0.0), self._population
        events = CrashingCutIns(population.path[on], on, self._cell[on], population.mass[on], crashing[on])
        return replace(found, events=events)

    def of_pair(self, a: FloatArray, b: FloatArray) -> OvertakingShells:
        """Pools of two vehicles that crash on these masses of cut-ins (m,).

        Where either crashes on a share of a cut-in's episodes, by inattention or by what an adversary is made of, the
        two do so independently.
        """
        mass = self._population.mass
        both = a * np.divide(b, mass, out=np.zeros_like(mass), where=mass > 0.0)
        kinds = both, np.maximum(a - both, 0.0), np.maximum(b - both, 0.0)
        return replace(self._shells, crashing=tuple(map(self.by_cell, kinds)))

    def as_adversary(self, made: Adversary, crashing: FloatArray) -> FloatArray:
        """The mass of crashes (m,) of an adversary made of a vehicle."""
        template, population = self._shells.template, self._population
        inside: BoolArray = self._shell <= boundary_shell(template)
        if made.crashes != "everywhere":
            weight = population.by_path(crashing * inside)
            order = np.argsort(-weight if made.crashes == "on_heaviest_paths" else weight, kind="stable")
            kept = np.zeros(weight.size, np.bool_)
            kept[order] = np.cumsum(weight[order]) <= made.share * weight.sum()
            crashing = crashing * kept[population.path]
        # Cut-ins on which nobody crashes are no part of a hole either: they are not tested.
        tested = ~inside & (self._shell < len(template.names))
        return np.where(tested, np.maximum(crashing, made.hole * population.mass), crashing)


def equals(library: Library, population: SuperPopulation, crashing: FloatArray) -> set[str]:
    """Surrogates that crash on the same cut-ins as a vehicle (its mass of them, shape (m,)), or nearly as often."""
    rate = crashing.sum()
    masses = {name: population.mass * population.crashes(d) for d, name in enumerate(library.surrogates)}
    near = {name for name, mass in masses.items() if abs(mass.sum() - rate) <= EQUAL_RATE * rate}
    return near | {name for name, mass in masses.items() if np.array_equal(mass, crashing)}


def leave_out(library: Library, names: set[str], conservative_first: tuple[str, ...]) -> Library:
    """The library without a vehicle's equals; the envelope stays, and another surrogate takes over as boundary.

    That is the next more conservative one that is left, or the next more aggressive one if none is. A library of which
    the envelope alone is left is a `CampaignError`.
    """
    names = names - {library.envelope}
    if library.boundary in names:
        place = conservative_first.index(library.boundary)
        nearest = [*reversed(conservative_first[:place]), *conservative_first[place + 1 :]]
        boundary = next((name for name in nearest if name not in {*names, library.envelope}), None)
        if boundary is None:
            found = f"no surrogate but the envelope, without the vehicle's equals ({', '.join(sorted(names))})"
            mend = "Add a surrogate to the library, or leave this vehicle out of the experiment."
            raise CampaignError("campaign.pool.library", found, "one that can be the boundary", mend)
        library = library.model_copy(update={"boundary": boundary})
    kept = {name: model for name, model in library.surrogates.items() if name not in names}
    return Library.model_validate({**dict(library), "surrogates": kept})
