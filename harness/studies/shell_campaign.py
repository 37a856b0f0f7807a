"""One shells campaign on a drawn pool: allocation, rounds, stop rule and estimator are those of a real campaign.

Given the pool, the tests of a stratum are independent draws, so that the world is replaced by one binomial number per
stratum and round. A real campaign draws from a systematic sample of the pool's cut-ins without replacement, which
scatters no more than that.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from harness.arrays import FloatArray, IntArray
from harness.campaign.models import Campaign
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate
from harness.runner.planner import RoundRule, ShellPlanner
from harness.strata import ShellDesign
from harness.studies.experiment import Fault
from harness.studies.rows import Row, estimate_row
from harness.studies.shell_source import ShellSource

FREE, CONDITIONAL = "shells", "shells, conditional"


class ShellCampaign:
    """A shells campaign to replicate.

    Parameters
    ----------
    campaign : Campaign
        Its stop rule, statement and first tests are used.
    source : ShellSource
    seed : int
    fault : Fault, optional
        Mistake to make.
    """

    def __init__(self, campaign: Campaign, source: ShellSource, seed: int, fault: Fault | None = None) -> None:
        self._campaign, self._source, self._seed, self._fault = campaign, source, seed, fault

    def run(self, replication: int) -> list[Row]:
        """Rows of both statements."""
        rng = np.random.default_rng([self._seed, replication])
        design, share = self._source.draw(rng)
        return self._rows(_wrong(design, self._fault), share, rng, replication)

    def _rows(self, design: ShellDesign, share: FloatArray, rng: np.random.Generator, replication: int) -> list[Row]:
        available = np.full(design.p.size, self._campaign.pool.cut_ins_per_shell, np.int64)
        planner = ShellPlanner(self._campaign, design, available)
        inside, conditional = RoundRule(_conditional(self._campaign)), None
        estimate: Estimate | None = None
        enough = False
        while not enough and (added := planner.next_round()).any():
            n = int(planner.tests.sum())
            enough = planner.add(_block(design, added, rng.binomial(added, share), n))
            estimate = planner.estimate
            if estimate is not None and conditional is None:
                inside.observe(estimate)
                if inside.reached:
                    conditional = _conditional_row(estimate, replication, reached=True)
        if estimate is None:
            raise ValueError("the campaign has no tests")
        outside = int(estimate.details["conditional"]["n_crashes_outside"])
        row = estimate_row(FREE, replication, estimate, reached=planner.rule.reached)
        free = replace(row, n_crashes_outside=outside)
        return [free, conditional or _conditional_row(estimate, replication, reached=False)]


def _conditional(campaign: Campaign) -> Campaign:
    shells = campaign.testing.shells.model_copy(update={"statement": "conditional"})
    return campaign.model_copy(update={"testing": campaign.testing.model_copy(update={"shells": shells})})


def _wrong(design: ShellDesign, fault: Fault | None) -> ShellDesign:
    if fault is None:
        return design
    factor = np.ones(design.p.size)
    factor[fault.shell] = fault.factor
    return replace(design, p=design.p * factor, moments=design.moments * np.outer(factor, factor))


def _block(design: ShellDesign, added: IntArray, crashes: IntArray, first: int) -> Block:
    """What the records of a round become: within a stratum the crashes come first, which no estimator can see."""
    component = np.repeat(np.arange(added.size), added)
    rank = np.arange(component.size) - np.repeat(np.cumsum(added) - added, added)
    n = component.size
    none = np.zeros(n, np.bool_)
    return Block(
        first_episode=first,
        method="shells",
        crash=rank < crashes[component],
        failed=none,
        cut_in=~none,
        bv_lv_contact=none,
        log_weight=np.zeros(n),
        log_q=np.zeros((n, 0)),
        alpha=np.zeros(0),
        n_control_steps=np.zeros(n, np.int64),
        component=component,
        shells=design,
    )


def _conditional_row(estimate: Estimate, replication: int, *, reached: bool) -> Row:
    found: dict[str, Any] = estimate.details["conditional"]
    shells = [shell for shell in estimate.details["shells"] if shell["inside"] and shell["n_episodes"]]
    variance = sum(
        shell["p"] ** 2 * shell["crash_share"] * (1.0 - shell["crash_share"]) / shell["n_episodes"] for shell in shells
    )
    return Row(
        CONDITIONAL,
        replication,
        found["n_episodes"],
        found["n_crashes"],
        found["crash_rate"],
        float(np.sqrt(variance)),
        found["ci_low"],
        found["ci_high"],
        reached,
        found["n_crashes_outside"],
    )
