"""One shells campaign on a drawn pool: allocation, rounds, stop rule and estimator are those of a real campaign.

Given the pool, the tests of a stratum are independent draws, so that the world is replaced by one binomial number per
stratum and round. A real campaign draws from a systematic sample of the pool's cut-ins without replacement, which
scatters no more than that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from harness.arrays import FloatArray, IntArray
from harness.campaign.models import Campaign
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate
from harness.runner.planner import RoundRule, ShellPlanner
from harness.strata import ShellDesign
from harness.studies.experiment import Fault
from harness.studies.judgement import Row, estimate_row

FREE = "shells"


def result_of(statement: str) -> str:
    """Name of a statement's rows among results."""
    return f"{FREE}, {statement}"


@dataclass(frozen=True, eq=False)
class DrawnPool:
    """A pool, and what a vehicle does on its paths.

    ``mass`` and ``crash_mass`` (n, S) are each path's probability of a cut-in of each stratum, and of a crash in it;
    ``failing`` is the share of crashes that end as failed tests.
    """

    design: ShellDesign
    mass: FloatArray
    crash_mass: FloatArray
    failing: float = 0.0

    @cached_property
    def share(self) -> FloatArray:
        """Share of crashes in each stratum, shape (S,)."""
        p, crash_p = self.mass.sum(0), self.crash_mass.sum(0)
        share = np.divide(crash_p, p, out=np.zeros_like(p), where=p > 0.0)
        return np.asarray(np.clip(share, 0.0, 1.0))  # rounding may leave the unit interval

    @cached_property
    def _cumulative(self) -> FloatArray:
        return np.cumsum(self.crash_mass, axis=0)

    def crashed_paths(self, stratum: int, n: int, rng: np.random.Generator) -> FloatArray:
        """Mass (n, S) of the paths of n crashed tests of a stratum."""
        cumulative = self._cumulative[:, stratum]
        paths: FloatArray = self.mass[np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right")]
        return paths


class ShellSource(Protocol):
    """Where the pools of replications come from."""

    def draw(self, rng: np.random.Generator) -> DrawnPool:
        """A new pool."""
        ...


@dataclass(frozen=True, eq=False)
class ShellCampaign:
    """A shells campaign to replicate; its stop rule, statement and first tests are used."""

    campaign: Campaign
    source: ShellSource
    seed: int
    fault: Fault | None = None

    def run(self, replications: range) -> list[Row]:
        """Rows of both statements for each replication."""
        return [row for replication in replications for row in self._replicate(replication)]

    def _replicate(self, replication: int) -> Iterator[Row]:
        rng = np.random.default_rng([self.seed, replication])
        drawn = _wrong(self.source.draw(rng), self.fault)
        design = drawn.design
        available = np.full(design.p.size, self.campaign.pool.cut_ins_per_shell, np.int64)
        planner = ShellPlanner(self.campaign, design, available)
        rules = {each.name: RoundRule(asking(self.campaign, each.name)) for each in design.statements}
        known: dict[str, Row] = {}
        enough = False
        while not enough and (added := planner.next_round()).any():
            enough = planner.add(campaign_block(drawn, added, int(planner.tally.tests.sum()), rng))
            for name, rule in rules.items():
                if name not in known and planner.seen.tally.tests.size and rule.observe(planner.seen) and rule.reached:
                    known[name] = _statement_row(self._estimate(planner), name, replication, reached=True)
        estimate = self._estimate(planner)
        outside = int(estimate.details["statements"][0]["n_crashes_outside"])
        yield estimate_row(FREE, replication, estimate, reached=planner.rule.reached, outside=outside)
        for name in rules:
            yield known.get(name) or _statement_row(estimate, name, replication, reached=False)

    def _estimate(self, planner: ShellPlanner) -> Estimate:
        return planner.seen.result(self.campaign.stop.confidence)


def asking(campaign: Campaign, statement: str) -> Campaign:
    """The campaign, were it to end with a statement."""
    shells = campaign.testing.shells.model_copy(update={"statement": statement})
    return campaign.model_copy(update={"testing": campaign.testing.model_copy(update={"shells": shells})})


def _wrong(drawn: DrawnPool, fault: Fault | None) -> DrawnPool:
    """The pool with probabilities that are not those of its paths."""
    if fault is None:
        return drawn
    factor = np.ones(drawn.design.cell_p.size)
    factor[fault.shell] = fault.factor
    return replace(drawn, design=replace(drawn.design, cell_p=drawn.design.cell_p * factor))


def campaign_block(drawn: DrawnPool, added: IntArray, first: int, rng: np.random.Generator) -> Block:
    """What the records of a round become: within a stratum the crashes come first, which no estimator can see."""
    stratum, crashes = np.repeat(np.arange(added.size), added), rng.binomial(added, drawn.share)
    n = stratum.size
    rank = np.arange(n) - np.repeat(np.cumsum(added) - added, added)
    none, bad = np.zeros(n, np.bool_), rank < crashes[stratum]
    failed = bad & (rank < rng.binomial(crashes, drawn.failing)[stratum]) if drawn.failing else none
    mass = np.zeros((n, added.size))
    mass[bad] = np.concatenate([drawn.crashed_paths(s, k, rng) for s, k in enumerate(crashes.tolist())])
    return Block(
        first_episode=first,
        method="shells",
        crash=bad & ~failed,
        failed=failed,
        cut_in=~none,
        bv_lv_contact=none,
        log_weight=np.zeros(n),
        log_q=np.zeros((n, 0)),
        alpha=np.zeros(0),
        n_control_steps=np.zeros(n, np.int64),
        stratum=stratum,
        cell=stratum,
        cell_mass=mass,
        shells=drawn.design,
    )


def _statement_row(estimate: Estimate, name: str, replication: int, *, reached: bool) -> Row:
    found = next(each for each in estimate.details["statements"] if each["name"] == name)
    shells = [shell for shell in estimate.details["shells"][: found["n_shells"]] if shell["n_episodes"]]
    variance = sum(
        shell["p"] ** 2 * shell["crash_share"] * (1.0 - shell["crash_share"]) / shell["n_episodes"] for shell in shells
    )
    reported = {name: found[name] for name in ("n_crashes", "crash_rate", "ci_low", "ci_high", "n_crashes_outside")}
    return Row(
        result_of(name),
        replication,
        n_tests=found["n_episodes"],
        std_error=float(np.sqrt(variance)),
        reached=reached,
        **reported,
    )
