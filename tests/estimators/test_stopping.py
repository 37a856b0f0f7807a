"""Stopping: looks are declared beforehand, two passes are needed, the same data stop at the same place; decisions."""

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.campaign.sections import Run, Stop
from harness.estimators import StopRule, accumulator
from harness.estimators.stopping import LOOK_RATIO, Decision, look_grid
from harness.strata import ASSUMPTION_FREE
from studies.chains.chain import frequent_decisive
from studies.chains.sampler import blocks
from tests.chains.seed import SEED

from .small_blocks import block

SHARD = 200
ENDS = range(SHARD, 10**6, SHARD)


def passing(n: int, *, rhw: float = 0.01, n_crashes: int = 1_000):
    state = accumulator("nade")
    state.add(block([True] * 4, weight_cap=1.0))
    return replace(state.result(0.9), n_episodes=n, rhw=rhw, n_crashes=n_crashes, weight_cap=1.0)


@given(st.integers(1, 10**9), st.integers(1, 10**6))
def test_looks_are_shard_boundaries_on_a_geometric_grid(n_episodes, shard_size):
    looks = look_grid(n_episodes, Run(shard_size=shard_size).shard_ends(n_episodes))
    assert looks[-1] == n_episodes
    assert all(a < b for a, b in itertools.pairwise(looks))
    assert all(look % shard_size == 0 for look in looks[:-1])
    for a, b in itertools.pairwise(looks[:-1]):
        assert b <= a * LOOK_RATIO + 2 * shard_size


def test_looks_thin_out():
    looks = look_grid(10_000_000, range(5_000, 10_000_001, 5_000))
    assert looks[:4] == (5_000, 10_000, 15_000, 20_000)
    assert len(looks) < 70
    assert looks[-2] / looks[-3] == pytest.approx(LOOK_RATIO, rel=0.01)


def test_long_runs_have_some_200_shards():
    """The first are of the usual size; one that is given stays."""
    ends = Run().shard_ends(10_000_000)
    assert (list(ends[:32]), len(ends)) == ([5_000 * (k + 1) for k in range(32)], 167)
    assert Run().shard_ends(170_000) == ends[: len(Run().shard_ends(170_000))]
    assert len(Run().shard_ends(10**8)) < 300
    assert len(Run(shard_size=10).shard_ends(10**9)) == 10**8
    looks = look_grid(10_000_000, ends)
    assert set(looks[:-1]) <= set(ends)
    assert 40 < len(looks) < 70


def test_two_consecutive_passes_are_needed():
    rule = StopRule(Stop(episodes=100_000, rhw=0.3, min_crashes=10), "forced", ENDS)
    pattern = [True, False, True, True]
    answers = [rule.observe(n, passing(n, rhw=0.2 if ok else 0.4)) for n, ok in zip(rule.looks, pattern, strict=False)]
    assert answers == [False, False, False, True]
    assert rule.look.stopped
    with pytest.raises(ValueError, match="no look is due"):
        rule.observe(rule.looks[4], passing(rule.looks[4]))


def test_too_few_crashes_never_stop():
    rule = StopRule(Stop(episodes=2_000, rhw=0.3, min_crashes=50), "forced", ENDS)
    answers = [rule.observe(n, passing(n, n_crashes=49)) for n in rule.looks]
    assert answers == [False] * (len(rule.looks) - 1) + [True]
    assert not rule.look.stopped


@pytest.mark.parametrize(("weight_cap", "stops"), [(59.0, True), (61.0, False), (math.inf, False)])
def test_one_more_crash_of_the_largest_weight_must_not_matter(weight_cap, stops):
    """At n = 200 and a rate of 1 an RHW of 0.3 allows for a weight of 60."""
    rule = StopRule(Stop(episodes=100_000, rhw=0.3, min_crashes=10), "forced", ENDS)
    rule.observe(rule.looks[0], replace(passing(200), weight_cap=weight_cap))
    assert rule.look.one_more_crash == weight_cap / 200
    assert rule.observe(rule.looks[1], replace(passing(400), weight_cap=2 * weight_cap)) == stops


def test_without_a_precision_the_budget_decides():
    rule = StopRule(Stop(episodes=1_050), "nde", ENDS)
    answers = [rule.observe(n, passing(n)) for n in rule.looks]
    assert answers == [False] * (len(rule.looks) - 1) + [True]
    assert rule.looks[-1] == 1_050
    assert not rule.look.stopped


def test_looking_elsewhere_is_refused():
    rule = StopRule(Stop(episodes=10_000, rhw=0.3), "nde", ENDS)
    with pytest.raises(ValueError, match="no look is due"):
        rule.observe(300, passing(300))
    with pytest.raises(ValueError, match="no look is due"):
        rule.observe(200, passing(400))
    rule.observe(200, passing(200))
    with pytest.raises(ValueError, match="no look is due"):
        rule.observe(200, passing(200))


def test_watches_the_methods_own_estimator_unless_told_otherwise():
    assert StopRule(Stop(), "episode_mixture", ENDS).estimator == "mixture_cv"
    assert StopRule(Stop(estimator="nade"), "episode_mixture", ENDS).estimator == "nade"


@pytest.mark.parametrize("method", ["nde", "forced", "episode_mixture"])
def test_the_same_campaign_stops_at_the_same_test(method):
    """However many tests are ready beyond the prefix, and however often it is run."""

    def stopped_at(n_ready: int) -> tuple[int, float]:
        rule = StopRule(Stop(episodes=40_000, rhw=0.2, min_crashes=30), method, ENDS)
        state, n = accumulator(rule.estimator), 0
        for part in blocks(frequent_decisive(), method, [SHARD] * n_ready, SEED):
            state.add(part)
            n += len(part)
            if rule.due(n) and rule.observe(n, estimate := state.result(0.9)):
                return n, estimate.crash_rate
        raise AssertionError("the prefix was too short")

    first = stopped_at(200)
    assert first == stopped_at(180 if first[0] <= 180 * SHARD else 200)
    assert first[0] % SHARD == 0


RATES = st.floats(1e-9, 1e-3)


@given(limit=RATES, one=RATES, other=RATES)
def test_a_verdict_says_that_the_whole_interval_is_on_one_side(limit, one, other):
    low, high = sorted((one, other))
    verdict = Decision(limit, ASSUMPTION_FREE, 0.95, low, high).verdict
    assert (verdict == "undecided") == (low <= limit <= high)
    assert (verdict == "accepted") == (high < limit)


@pytest.mark.parametrize(
    ("interval", "sentence"),
    [
        (
            (1e-7, 1.9e-7),
            "ACCEPTED: with confidence 0.95 the crash rate is below 2e-07 per test (upper limit 1.9e-07).",
        ),
        ((3e-7, 4e-7), "REJECTED: with confidence 0.95 the crash rate is above 2e-07 per test (lower limit 3e-07)."),
        (
            (1e-7, 4e-7),
            "UNDECIDED: whether the crash rate is below 2e-07 per test is not known; it may be 1e-07 as well as 4e-07.",
        ),
    ],
)
def test_it_is_said_in_a_sentence(interval, sentence):
    assert Decision(2e-7, ASSUMPTION_FREE, 0.95, *interval).sentence == sentence


def test_what_a_statement_decides_says_so():
    found = Decision(2e-7, "library", 0.95, 0.0, 1e-7)
    assert "the crash rate, given statement library, is below" in found.sentence
    assert found.to_json()["verdict"] == "accepted"


@pytest.mark.parametrize(
    ("interval", "verdict", "final"),
    [((1e-8, 1e-7), "undecided", True), ((1e-7, 3e-7), "undecided", False), ((3e-7, 4e-7), "rejected", True)],
)
def test_a_statement_that_tests_contradict_accepts_nothing_and_still_rejects(interval, verdict, final):
    found = Decision(2e-7, "need-based", 0.95, *interval, contradicted=True)
    assert (found.verdict, found.is_final) == (verdict, final)
    assert ("does not do what statement need-based assumes" in found.sentence) == (verdict == "undecided")
