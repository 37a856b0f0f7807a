"""What stopping does to coverage where rare crashes weigh most, by replication; a rule without a known cap must fail.

Seeds are fixed, so that the outcome is too. The right rule's `binomtest` would reject a coverage of 0.90 with
probability 1e-4; the wrong one must fail at 1e-9.
"""

from dataclasses import replace

import numpy as np
from scipy.stats import binomtest

from harness.campaign.sections import Stop
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate
from harness.estimators.stopping import StopRule
from harness.estimators.weighted import Nade

from .small_blocks import block

REPLICATIONS = 300
SHARD = 500
LIGHT, HEAVY = 1e-3, 0.2
"""P(cut-in | path) of nearly all paths, and of one in a hundred."""
CRASH_SHARE = 0.1
RATE = CRASH_SHARE * (0.99 * LIGHT + 0.01 * HEAVY)
STOP = Stop(episodes=400_000, rhw=0.3, min_crashes=50)


def drawn(rng: np.random.Generator, n: int) -> Block:
    """Forced cut-ins: two thirds of the crash rate come from one path in a hundred."""
    path = np.log(np.where(rng.random(n) < 0.01, HEAVY, LIGHT))
    crash = rng.random(n) < CRASH_SHARE
    return block(crash.tolist(), path.tolist(), method="forced", log_p_cut_in=path)


def stopped(rng: np.random.Generator, *, cap_is_known: bool) -> Estimate:
    rule, state, n = StopRule(STOP, "forced", range(SHARD, STOP.episodes + SHARD, SHARD)), Nade(), 0
    for look in rule.looks:
        state.add(drawn(rng, look - n))
        n = look
        estimate = state.result(STOP.confidence)
        largest_seen = estimate.largest_weight_share * estimate.crash_rate * n
        if rule.observe(n, estimate if cap_is_known else replace(estimate, weight_cap=largest_seen, cautions=())):
            break
    assert rule.look.stopped
    return estimate


def coverage(*, cap_is_known: bool) -> tuple[int, float]:
    estimates = [stopped(np.random.default_rng([21, k]), cap_is_known=cap_is_known) for k in range(REPLICATIONS)]
    rates = np.array([one.crash_rate for one in estimates])
    return sum(one.ci_low <= RATE <= one.ci_high for one in estimates), float(rates.mean() / RATE - 1.0)


def test_a_known_cap_keeps_the_coverage():
    covered, bias = coverage(cap_is_known=True)
    assert binomtest(covered, REPLICATIONS, 0.9, alternative="less").pvalue > 1e-4
    assert abs(bias) < 0.03


def test_the_largest_weight_seen_does_not():
    covered, bias = coverage(cap_is_known=False)
    assert binomtest(covered, REPLICATIONS, 0.9, alternative="less").pvalue < 1e-9
    assert bias < -0.1
