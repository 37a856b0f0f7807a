"""Stopping: looks are declared beforehand, two passes are needed, the same data stop at the same place; decisions."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from harness.campaign.campaign import Campaign
from harness.campaign.sections import RunSettings, Stop
from harness.estimators.answer import ended_by, expected_for
from harness.estimators.likelihood import Level
from harness.estimators.one_pass import accumulator
from harness.estimators.pairs import CRASH, NO_CRASH, no_pairs
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import LOOK_RATIO, Decision, RoundRule, StopRule, look_grid
from harness.estimators.tally import Tally
from harness.numbers import two_digits_up
from harness.report.words import runs_warning
from harness.strata import ASSUMPTION_FREE, Reference
from tests.estimators.small_blocks import SHELLS, block

SHARD = 200
ENDS = range(SHARD, 10**6, SHARD)


def passing(n: int, *, rhw: float = 0.01, n_crashes: int = 1_000):
    state = accumulator("nade")
    state.add(block([True] * 4, weight_cap=1.0))
    return replace(state.result(0.9), n_episodes=n, rhw=rhw, n_crashes=n_crashes, weight_cap=1.0)


@given(st.integers(1, 10**9), st.integers(1, 10**6))
def test_looks_are_shard_boundaries_on_a_geometric_grid(n_episodes, shard_size):
    looks = look_grid(n_episodes, RunSettings(shard_size=shard_size).shard_ends(n_episodes))
    assert looks[-1] == n_episodes
    assert all(a < b for a, b in itertools.pairwise(looks))
    assert all(look % shard_size == 0 for look in looks[:-1])
    for a, b in itertools.pairwise(looks[:-1]):
        assert b <= a * LOOK_RATIO + 2 * shard_size


@pytest.mark.parametrize(("weight_cap", "stops"), [(59.0, True), (61.0, False), (math.inf, False)])
def test_one_more_crash_of_the_largest_weight_must_not_matter(weight_cap, stops):
    """At n = 200 and a rate of 1 an RHW of 0.3 allows for a weight of 60."""
    rule = StopRule(Stop(episodes=100_000, rhw=0.3, min_crashes=10), ENDS)
    rule.observe(rule.looks[0], replace(passing(200), weight_cap=weight_cap))
    assert rule.observe(rule.looks[1], replace(passing(400), weight_cap=2 * weight_cap)) == stops


FEW, WIDE, HEAVY = {"n_crashes": 5}, {"rhw": 0.4}, {"weight_cap": 1e9}
WRONG = {"cautions": ("unbounded",)}


@pytest.mark.parametrize(
    ("looks", "reached", "unmet"),
    [
        ([{}, {}], True, ()),
        ([WIDE, FEW, {}, {}], True, ("min_crashes",)),
        ([FEW, WIDE, {}, {}], True, ("rhw",)),
        ([WIDE, {}, WIDE, {}, {}], True, ("rhw",)),
        ([HEAVY, {}, {}], True, ("one_more_crash",)),
        ([FEW, FEW, FEW], False, ("min_crashes",)),
        ([WIDE | FEW, WIDE | FEW], False, ("rhw", "min_crashes")),
        ([WIDE, {}], False, ("second_look",)),
        ([WRONG, WRONG, WRONG], False, ("rhw",)),
    ],
)
def test_two_looks_in_turn_must_pass_and_what_was_missing_is_remembered(looks, reached, unmet):
    rule = StopRule(Stop(episodes=SHARD * len(looks), rhw=0.3, min_crashes=50), ENDS)
    ended = [rule.observe(n, replace(passing(n), **of)) for n, of in zip(rule.looks, looks, strict=True)]
    assert ended == [False] * (len(looks) - 1) + [True]
    assert (rule.look.stopped, tuple(each.key for each in rule.look.unmet)) == (reached, unmet)


# -- decisions about a limit that is the truth, where an error rate is defined: both verdicts are wrong there --


P, SHARE = np.array([2e-6, 1e-5, 2e-5]), np.array([0.9, 0.5, 0.15])
"""A vehicle that crashes about 1e-5 times per test, on a share of each shell: the hardest that was measured."""
DESIGN = replace(
    SHELLS.without_references(), cell_p=P, n_paths=10**12, boundary="outermost", assumes="does", n_inside=2
)
LEVEL = Level.two_sided(0.9)
BUDGET = 3_000
REPLICATIONS = 250


def rule(limit: float, held: int = 0) -> RoundRule:
    content = {"name": "x", "testing": {"method": "shells"}, "stop": {"episodes": BUDGET}}
    return RoundRule(Campaign.model_validate({**content, "accept": {"crash_rate_below": limit}}), held)


def seen(tests, crashes) -> SeenShells:
    none = np.zeros(3, np.int64)
    return SeenShells.of(DESIGN, Tally(tests, crashes, none, np.outer(crashes, P), np.zeros((3, 3))))


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


@pytest.mark.slow
def test_either_verdict_is_wrong_in_at_most_one_of_twenty():
    assert all(binomtest(n, REPLICATIONS, 0.05, alternative="greater").pvalue > 1e-4 for n in wrong())


@pytest.mark.slow
def test_the_intervals_own_limits_after_each_round_are_wrong_far_more_often(monkeypatch):
    monkeypatch.setattr(RoundRule, "level_at", staticmethod(lambda *_: LEVEL))
    assert all(binomtest(n, REPLICATIONS, 0.05, alternative="greater").pvalue < 1e-9 for n in wrong())


@pytest.mark.parametrize("n", [30, 300, 1_000, 3_000])
def test_a_run_that_a_reference_driver_ends_is_held_to_the_level_of_decisions(n):
    """It ends where a gate with the same limit accepts: where the limit is the rate, in at most one of twenty."""
    known = {"references": (Reference("r157-cc", "a driver"),), "reference_square": np.array([1e-4])}
    tests, crashes = np.array([n, n, 8 * n]), np.array([0, 1, 0])
    content, stopped = {"name": "x", "testing": {"method": "shells"}}, []
    for rate in np.geomspace(1e-7, 1e-2, 40):
        design = replace(DESIGN, **known, reference_rate=np.array([rate]))
        counted = SeenShells.of(design, Tally(tests, crashes, 0 * tests, np.outer(crashes, P), np.zeros((3, 3))))
        asked = {"stop": {"rhw": 1e-3, "below_reference": 0.2}}
        gate = {"accept": {"times_reference": {"driver": "r157-cc", "at_most": 0.2}}}
        below, accepting = (RoundRule(Campaign.model_validate({**content, **each})) for each in (asked, gate))
        accepting.observe(counted)
        stopped.append(below.observe(counted))
        assert stopped[-1] == (accepting.look.decision.verdict == "accepted") == (below.look.ended == "below_reference")
    assert stopped == sorted(stopped)
    assert 0 < sum(stopped) < 40


def test_few_baseline_runs_accept_nobody_who_may_do_it_rarely():
    """However many tests repeat them: a share of drives that none of 500 shows may crash on all events."""
    tests, crashes = np.full(len(DESIGN.strata), 3_000), np.zeros(len(DESIGN.strata), np.int64)
    limit, found = 0.003 * DESIGN.p.sum(), {}
    for n_paths in (0, 500, 1_000):
        runs = {"shadow_runs": True, "n_paths": n_paths, "candidates": 10**9} if n_paths else {}
        of_runs, asked = seen(tests, crashes), rule(limit)
        of_runs.design = replace(DESIGN, **runs)
        asked.observe(of_runs)
        found[n_paths] = asked.look.decision
        assert asked.look.ended == "accept"
    share = 1.0 - 0.05 ** (1 / 500)
    assert [each.verdict for each in found.values()] == ["accepted", "undecided", "accepted"]
    assert found[500].n_runs == two_digits_up(500 * share / 0.003)
    assert "baseline runs may miss" in " ".join(runs_warning(found[500].to_json()))


def test_a_decision_stays_and_what_the_folder_holds_is_not_given_up():
    deciding = rule(1e-4, held=300)
    tests = np.array([100, 50, 50])
    assert not deciding.observe(seen(tests, np.zeros(3, int)))
    assert deciding.look.decision.verdict == "accepted"
    assert deciding.observe(seen(2 * tests, np.zeros(3, int)))
    assert deciding.look.decision.n_episodes == 200


def test_a_vehicle_that_always_crashes_may_have_a_rate_above_that_of_this_pool():
    """Rate, what lies outside, and what A alone does: cut at the pool's Σp these are too low in half of all pools."""
    n_paths, rng, covered, cut = 200, np.random.default_rng(35), np.zeros(3, int), np.zeros(3, int)
    tests, none, truth = np.full(3, 400), np.zeros(3, np.int64), P * math.exp(0.5)
    for _ in range(300):
        mass = rng.lognormal(sigma=1.0, size=(n_paths, 3)) * P
        drawn = np.array([mass[rng.choice(n_paths, 400, p=of / of.sum())].sum(0) for of in mass.T])
        design = replace(DESIGN, cell_p=mass.mean(0), n_paths=n_paths)
        found = SeenShells.of(design, Tally(tests, tests, none, drawn, np.zeros((3, 3))))
        (own,) = (pairs := no_pairs(design)).each
        own.ends[:, CRASH, NO_CRASH], own.mass[:, CRASH, NO_CRASH] = tests, drawn
        free, alone = found.limits(LEVEL), pairs.alone(0, LEVEL)
        low = np.array([free.low, 0.0, alone.ci_low])
        high = np.array([free.high, found.within(0.9).upper_bound_outside, alone.ci_high])
        true = np.array([truth.sum(), truth[2], truth.sum()])
        covered += (low <= true) & (true <= high)
        cut += true <= np.minimum(high, [design.p.sum(), design.p[2], design.p.sum()])
    assert all(binomtest(n, 300, 0.9, alternative="less").pvalue > 1e-4 for n in covered.tolist())
    assert all(binomtest(n, 300, 0.9, alternative="less").pvalue < 1e-9 for n in cut.tolist())


def test_tests_that_are_missing_are_those_that_would_do():
    """Tests of each stratum that crash as often, also where nothing has crashed."""
    tests, crashes, level = np.array([40, 60, 400]), np.array([30, 10, 0]), Level.two_sided(0.9)
    for target in (0.25, 0.1):
        times = seen(tests, crashes).more_tests(ASSUMPTION_FREE, level, target, 1.0)
        assert times > 1.2
        enough, few = (
            seen(*(np.rint(each * k).astype(np.int64) for each in (tests, crashes))) for k in (times, times / 1.2)
        )
        assert enough.limits(level).rhw <= 1.02 * target < few.limits(level).rhw


@pytest.mark.parametrize(
    ("tests", "statement", "driver", "expected"),
    [
        ([100, 100, 800], ASSUMPTION_FREE, None, 1_000 * 1e-7 / 3.2e-5),
        ([100, 100, 80_000], ASSUMPTION_FREE, None, 80_200 * 1e-7 / 3.2e-5),
        ([100, 100, 800], "library", None, 200 * 1e-7 / 1.2e-5),
        ([100, 100, 800], ASSUMPTION_FREE, "r157-cc", 1_000 * 1e-7 * 2e-8 / 3.2e-5),
    ],
)
def test_a_limits_threshold_follows_from_the_crashes_that_it_makes_expected(tests, statement, driver, expected):
    """Ten times the tests where ten times as much lies outside: cut-ins that take time are no rarer decided."""
    known = {"reference_rate": np.array([2e-8]), "reference_square": np.array([1e-15])}
    design = replace(DESIGN, references=(Reference("r157-cc", "a driver"),), **known)
    none, of_pairs = np.zeros(3, np.int64), np.zeros((3, 3))
    counted = SeenShells.of(design, Tally(np.array(tests), none, none, of_pairs, of_pairs))
    assert counted.expected(1e-7, driver, statement) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("from_pool", "outside", "runs"), [(0.1, 400, 500), (0.4, 400, 1_800), (math.inf, 400, None), (0.1, 0, None)]
)
def test_what_is_missing_is_counted(from_pool, outside, runs):
    av = {"controller": "examples.acting:Holds", "before_event": "controller", "limits": {"max_acceleration_mps2": 2}}
    content = {"name": "x", "testing": {"method": "shells"}, "stop": {"rhw": 0.3, "episodes": 500}, "av": av}
    campaign = Campaign.model_validate(content)
    looking = RoundRule(campaign)
    looking.observe(seen(np.array([40, 60, outside]), np.array([30, 10, 0])))
    looking.look = replace(looking.look, rhw_from_pool=from_pool)
    assert ended_by(campaign, looking, 500) == "episodes"
    needed = expected_for(looking, campaign, 500)
    assert (needed and needed["runs"]) == runs
    assert needed is None or needed["tests"] > 500


def test_every_round_is_looked_at_whatever_the_folder_holds():
    """So that the looks of a run are those of one with a larger budget; and none waits for the next e-fold."""
    for held in (0, 500):
        deciding = rule(1e-9, held)
        for n in range(30, 600, 10):
            deciding.observe(seen(np.array([n - 20, 10, 10]), np.array([0, 0, 0])))
            assert deciding.look.decision.n_episodes == n
