"""Stopping: looks are declared beforehand, two passes are needed, the same data stop at the same place; decisions."""

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.campaign.sections import Run, Stop
from harness.estimators.one_pass import accumulator
from harness.estimators.stopping import LOOK_RATIO, Decision, StopRule, look_grid

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


def test_long_runs_have_some_200_shards():
    """The first are of the usual size; one that is given stays."""
    ends = Run().shard_ends(10_000_000)
    assert (list(ends[:32]), len(ends)) == ([5_000 * (k + 1) for k in range(32)], 145)
    assert Run().shard_ends(170_000) == ends[: len(Run().shard_ends(170_000))]
    assert len(Run().shard_ends(10**8)) <= 200
    assert len(Run(shard_size=10).shard_ends(10**9)) == 10**8
    for shards in (ends, range(5_000, 10_000_001, 5_000)):
        looks = look_grid(10_000_000, shards)
        assert set(looks[:-1]) <= set(shards)
        assert 40 < len(looks) < 70


@pytest.mark.parametrize(("weight_cap", "stops"), [(59.0, True), (61.0, False), (math.inf, False)])
def test_one_more_crash_of_the_largest_weight_must_not_matter(weight_cap, stops):
    """At n = 200 and a rate of 1 an RHW of 0.3 allows for a weight of 60."""
    rule = StopRule(Stop(episodes=100_000, rhw=0.3, min_crashes=10), "forced", ENDS)
    rule.observe(rule.looks[0], replace(passing(200), weight_cap=weight_cap))
    assert rule.look.one_more_crash == weight_cap / 200
    assert rule.observe(rule.looks[1], replace(passing(400), weight_cap=2 * weight_cap)) == stops


def test_looking_elsewhere_is_refused():
    rule = StopRule(Stop(episodes=10_000, rhw=0.3, min_crashes=10), "nde", ENDS)

    def refused(n: int, of: int) -> None:
        with pytest.raises(ValueError, match="no look is due"):
            rule.observe(n, passing(of))

    refused(300, 300)
    refused(200, 400)
    rule.observe(200, passing(200))
    refused(200, 200)
    assert rule.observe(400, passing(400))
    refused(rule.looks[2], rule.looks[2])


FEW, WIDE, HEAVY = {"n_crashes": 5}, {"rhw": 0.4}, {"weight_cap": 1e9}
WRONG = {"cautions": ("unbounded",)}


@pytest.mark.parametrize(
    ("looks", "reached", "unmet"),
    [
        ([{}, {}], True, ()),
        ([WIDE, FEW, {}, {}], True, ("stop.min_crashes (50)",)),
        ([FEW, WIDE, {}, {}], True, ("stop.rhw (0.3)",)),
        ([WIDE, {}, WIDE, {}, {}], True, ("stop.rhw (0.3)",)),
        ([HEAVY, {}, {}], True, ("stop.rhw (0.3) for one more crash of the largest possible weight",)),
        ([FEW, FEW, FEW], False, ("stop.min_crashes (50)",)),
        ([WIDE | FEW, WIDE | FEW], False, ("stop.rhw (0.3)", "stop.min_crashes (50)")),
        ([WIDE, {}], False, ("the same at a second look",)),
        ([WRONG, WRONG, WRONG], False, ("stop.rhw (0.3)",)),
    ],
)
def test_two_looks_in_turn_must_pass_and_what_was_missing_is_remembered(looks, reached, unmet):
    rule = StopRule(Stop(episodes=SHARD * len(looks), rhw=0.3, min_crashes=50), "forced", ENDS)
    ended = [rule.observe(n, replace(passing(n), **of)) for n, of in zip(rule.looks, looks, strict=True)]
    assert ended == [False] * (len(looks) - 1) + [True]
    assert (rule.look.stopped, rule.look.unmet) == (reached, unmet)


RATES = st.floats(1e-9, 1e-3)


@given(limit=RATES, one=RATES, other=RATES, contradicted=st.booleans())
def test_a_verdict_says_that_the_whole_interval_is_on_one_side(limit, one, other, contradicted):
    """A statement that tests contradict accepts nothing and still rejects."""
    low, high = sorted((one, other))
    found = Decision(limit, "library", 0.95, low, high, contradicted=contradicted)
    assert (found.verdict == "rejected") == (low > limit)
    assert (found.verdict == "accepted") == (high < limit and not contradicted)
    assert found.is_final == (not low <= limit <= high)
    assert ("does not do what statement library assumes" in found.sentence) == (contradicted and low <= limit)
