"""Decisions about a limit that is the truth, where an error rate is defined: both verdicts are wrong there.

Seeds are fixed. The right rule's `binomtest` would refuse an error of 5 % with probability 1e-4; the rule that it took
the place of, the interval's own limits after each tenth of tests, must fail at 1e-9. Of whole campaigns: docs/gate.md.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.campaign.campaign import Campaign
from harness.estimators.likelihood import Level
from harness.estimators.pairs import CRASH, NO_CRASH, no_pairs
from harness.estimators.shells import Shells
from harness.estimators.stopping import Decision, RoundRule
from harness.estimators.tally import Tally
from harness.strata import ASSUMPTION_FREE, Statement

from .small_blocks import SHELLS

P, SHARE = np.array([2e-6, 1e-5, 2e-5]), np.array([0.9, 0.5, 0.15])
"""A vehicle that crashes about 1e-5 times per test, on a share of each shell: the hardest that was measured."""
DESIGN = replace(
    SHELLS.without_references(), cell_p=P, n_paths=10**12, statements=(Statement("library", "outermost", "does", 2),)
)
LEVEL = Level.two_sided(0.9)
BUDGET = 3_000
REPLICATIONS = 500


def rule(limit: float, held: int = 0) -> RoundRule:
    content = {"name": "x", "testing": {"method": "shells"}, "stop": {"episodes": BUDGET}}
    return RoundRule(Campaign.model_validate({**content, "accept": {"crash_rate_below": limit}}), held)


def seen(tests, crashes) -> Shells:
    none = np.zeros(3, np.int64)
    return Shells.of(DESIGN, Tally(tests, crashes, none, np.outer(crashes, P), np.zeros((3, 3))))


def decided(seed: int, limit: float) -> Decision:
    """By a campaign whose rounds grow by a tenth, and give most tests to where the rate is least known.

    It is looked at in the midst of each round, too, as if a budget had ended there, and been raised.
    """
    rng, deciding = np.random.default_rng([34, seed]), rule(limit)
    spread = P * np.sqrt(SHARE * (1.0 - SHARE))
    tests = crashes = np.zeros(3, np.int64)
    while (n := int(tests.sum())) < BUDGET:
        added = np.ceil(min(max(0.05 * n, 15), BUDGET - n) * spread / spread.sum()).astype(np.int64)
        tests, crashes = tests + added, crashes + rng.binomial(added, SHARE)
        if deciding.observe(seen(tests, crashes)):
            break
    return deciding.look.decision


def wrong() -> tuple[int, int]:
    """How many campaigns accept, and reject, where the limit is the crash rate."""
    found = [decided(seed, float(P @ SHARE)).verdict for seed in range(REPLICATIONS)]
    return found.count("accepted"), found.count("rejected")


def test_either_verdict_is_wrong_in_at_most_one_of_twenty():
    assert all(binomtest(n, REPLICATIONS, 0.05, alternative="greater").pvalue > 1e-4 for n in wrong())


def test_the_intervals_own_limits_after_each_round_are_wrong_far_more_often(monkeypatch):
    monkeypatch.setattr(RoundRule, "level_at", staticmethod(lambda *_: LEVEL))
    assert all(binomtest(n, REPLICATIONS, 0.05, alternative="greater").pvalue < 1e-9 for n in wrong())


def test_every_round_is_looked_at_whatever_the_folder_holds():
    """So that the looks of a run are those of one with a larger budget; and none waits for the next e-fold."""
    for held in (0, 500):
        deciding = rule(1e-9, held)
        for n in range(30, 600, 10):
            deciding.observe(seen(np.array([n - 20, 10, 10]), np.array([0, 0, 0])))
            assert deciding.look.decision.n_episodes == n


def test_a_decision_stays_and_what_the_folder_holds_is_not_given_up():
    deciding = rule(1e-4, held=300)
    tests = np.array([100, 50, 50])
    assert not deciding.observe(seen(tests, np.zeros(3, int)))
    assert deciding.look.decision.verdict == "accepted"
    assert deciding.observe(seen(2 * tests, np.zeros(3, int)))
    assert deciding.look.decision.n_episodes == 200


@pytest.mark.parametrize(
    ("before", "said"),
    [
        ([], "limit 1.9e-07)."),
        ([3e-7, 1e-7, 4e-7], "This is the 4th limit asked of these tests (before: 3e-07, 1e-07, 4e-07)."),
    ],
)
def test_other_limits_that_were_asked_are_said(before, said):
    assert Decision(2e-7, "library", 0.95, 1e-7, 1.9e-7, asked_before=before).sentence.endswith(said)


def test_a_vehicle_that_always_crashes_may_have_a_rate_above_that_of_this_pool():
    """Rate, what lies outside, and what A alone does: cut at the pool's Σp these are too low in half of all pools."""
    n_paths, rng, covered, cut = 200, np.random.default_rng(35), np.zeros(3, int), np.zeros(3, int)
    tests, none, truth = np.full(3, 400), np.zeros(3, np.int64), P * math.exp(0.5)
    for _ in range(300):
        mass = rng.lognormal(sigma=1.0, size=(n_paths, 3)) * P
        drawn = np.array([mass[rng.choice(n_paths, 400, p=of / of.sum())].sum(0) for of in mass.T])
        design = replace(DESIGN, cell_p=mass.mean(0), n_paths=n_paths)
        found = Shells.of(design, Tally(tests, tests, none, drawn, np.zeros((3, 3))))
        pairs = no_pairs(design)
        pairs.ends[:, CRASH, NO_CRASH], pairs.mass[:, CRASH, NO_CRASH] = tests, drawn
        free, alone = found.limits_of(ASSUMPTION_FREE, LEVEL), pairs.alone(0, LEVEL)
        low = np.array([free.low, 0.0, alone.ci_low])
        high = np.array([free.high, found.within("library", 0.9).upper_bound_outside, alone.ci_high])
        true = np.array([truth.sum(), truth[2], truth.sum()])
        covered += (low <= true) & (true <= high)
        cut += true <= np.minimum(high, [design.p.sum(), design.p[2], design.p.sum()])
    assert all(binomtest(n, 300, 0.9, alternative="less").pvalue > 1e-4 for n in covered.tolist())
    assert all(binomtest(n, 300, 0.9, alternative="less").pvalue < 1e-9 for n in cut.tolist())
