"""Shells: limits of the weighted sum, statements that say what they rest on, and how many paths crashes lie on."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from harness.estimators.beside import share_of_crashes
from harness.estimators.block import SamplingPlan
from harness.estimators.estimate import Estimate, finite_json
from harness.estimators.likelihood import Level, likelihood_limit
from harness.estimators.one_pass import one_pass
from harness.estimators.per_hour import FamilyTests, PerHour
from harness.estimators.shells import SeenShells
from harness.estimators.tally import (
    FEWEST_PATHS,
    ROOM,
    CrashedTests,
    OnRuns,
    Tally,
    combined,
    crash_square,
    empty_tally,
    mean_square,
    paths_that_count,
    pool_variance,
)
from harness.families.protocol import Exposure
from harness.strata import ASSUMPTION_FREE, Reference
from tests.estimators.small_blocks import EXACT, SHELLS, in_shells, tally

P, LEVEL = SHELLS.p, Level.two_sided(0.9)


def shells_estimate(*rows: tuple[int, int, int, int], shells=SHELLS, **columns) -> Estimate:
    """From rows of (stratum, crashes, failed tests, further tests)."""
    strata = np.repeat([stratum for stratum, *_ in rows], [sum(counts) for _, *counts in rows])
    end = np.concatenate([np.repeat(["crash", "failed", "passed"], counts) for _, *counts in rows])
    block = in_shells(strata, end == "crash", end == "failed")
    block = replace(block, columns={**block.columns, **columns}, drawn=SamplingPlan("shells", shells=shells))
    return one_pass([block], ("shells",)).headline_estimate


def within(estimate: Estimate) -> dict:
    """What is said of the inside of the boundary."""
    return estimate.details["within"]


def test_limits_are_those_of_the_likelihood_ratio_and_wider_where_the_pool_errs():
    found = tally(P, (5, 0, 0), (10, 10, 100), (1, 0, 2))
    limits = combined(P, found, EXACT, LEVEL)
    assert limits.rate == pytest.approx(5e-5)
    assert limits.low == pytest.approx(likelihood_limit(P, found.crashes, found.tests, LEVEL, -1.0), rel=1e-5)
    worst = found.crashes + found.failed
    assert limits.high == pytest.approx(likelihood_limit(P, worst, found.tests, LEVEL, 1.0), rel=1e-5)
    untested = combined(P, tally(P, (5, 5, 0), (10, 10, 0)), EXACT, LEVEL)
    assert untested.high >= P[2]
    found = tally(P, (5, 5, 5), (10, 10, 10))
    exact = combined(P, found, EXACT, LEVEL)
    rough = combined(P, found._replace(crash_mass=found.crash_mass * 50), 100, LEVEL)
    assert rough.rate == exact.rate
    assert rough.high - rough.rate > 1.3 * (exact.high - exact.rate)


def test_no_rate_is_above_1_where_probabilities_that_the_pool_estimates_sum_to_more():
    every = ((0, 40, 0, 0), (1, 40, 0, 0), (2, 40, 0, 0))
    estimate = shells_estimate(*every, shells=replace(SHELLS, cell_p=SHELLS.cell_p * (1.004 / SHELLS.p.sum())))
    assert 0.0 < estimate.ci_low <= estimate.crash_rate <= estimate.ci_high == 1.0


def test_a_reference_that_crashes_nowhere_in_the_pool_is_nothing_to_compare_with():
    """As beside a vehicle that keeps its distance all along: every other reference is still there."""
    who = Reference("r157-cc", "a driver"), Reference("r157-fsm", "another")
    beside = replace(
        SHELLS, references=who, reference_rate=np.array([0.0, 1e-5]), reference_square=np.array([0.0, 1.0])
    )
    (found,) = shells_estimate((0, 3, 0, 40), (1, 0, 0, 40), shells=beside).details["references"]
    assert found["reference"] == "r157-fsm"
    assert math.isfinite(found["ratio"])


N_PATHS = 20_000


def made_up() -> tuple[np.ndarray, dict[str, np.ndarray], np.random.Generator]:
    """Mass of paths (n, 3), and the shares of each path's cut-ins of a stratum on which vehicles crash."""
    rng = np.random.default_rng(3)
    walked = rng.exponential(size=(N_PATHS, 1)) * rng.exponential(size=(N_PATHS, 3))
    mass = walked * P * (rng.random((N_PATHS, 1)) < 0.5)
    share, whole = np.array([0.9, 0.3, 0.01]), mass.sum(1, keepdims=True)
    on = rng.random((N_PATHS, 1))
    heaviest = np.argsort(np.argsort(-whole[:, 0]))[:, None] < 0.01 * N_PATHS
    crashes_on = {
        "here and there": np.broadcast_to(share, mass.shape),
        "on whole paths": 1.0 * (on < share.max()) * np.ones(3),
        "nested": 1.0 * (on < share),
        "each stratum on paths of its own": 1.0 * (rng.random(mass.shape) < share),
        "on the heaviest paths": 1.0 * heaviest * np.ones(3),
        "on the lightest paths": 1.0 * (whole < np.quantile(whole[whole > 0], 0.3)) * np.ones(3),
    }
    return mass, crashes_on, rng


def drawn_tests(mass: np.ndarray, crashes_on: np.ndarray, n: int, rng: np.random.Generator) -> Tally:
    """Tests of paths drawn in proportion to their mass in each stratum."""
    found = empty_tally(3)._replace(tests=np.full(3, n))
    for s in range(3):
        rows = rng.choice(len(mass), n, p=mass[:, s] / mass[:, s].sum())
        rows = rows[rng.random(n) < crashes_on[rows, s]]
        found.crashes[s], found.crash_mass[s] = rows.size, mass[rows].sum(0)
    return found


def test_the_variance_of_the_pool_is_not_too_small_for_any_vehicle():
    """Mean over 20 times 4,000 tests a stratum; where crashes are few the least of three estimates is a little low."""
    mass, vehicles, rng = made_up()
    for name, crashes_on in vehicles.items():
        true = (mass * crashes_on).sum(1).var() / N_PATHS
        found = [pool_variance(mass.mean(0), drawn_tests(mass, crashes_on, 4_000, rng), N_PATHS) for _ in range(20)]
        assert np.mean(found) >= 0.9 * true, name


def test_crash_shares_and_moments_alone_would_be_too_small_for_the_heaviest_paths():
    """What the variance was made of before, the sibling that must fail: Σ min(c_s, c_t) E[m_s m_t]."""
    mass, vehicles, _ = made_up()
    crashing = mass * vehicles["on the heaviest paths"]
    rate, share = crashing.sum(1), crashing.mean(0) / mass.mean(0)
    former = (np.minimum(share[:, None], share) * (mass.T @ mass / N_PATHS)).sum() - rate.mean() ** 2
    assert former < 0.8 * rate.var()


def test_failed_tests_outside_are_not_taken_for_safe_ones():
    estimate = shells_estimate((0, 8, 2, 0), (2, 0, 4, 396))
    conditional = within(estimate)
    assert (conditional["n_failed"], conditional["n_failed_outside"]) == (2, 4)
    assert conditional["crash_rate_if_failed_had_crashed"] == pytest.approx(1e-4)
    without_pool = likelihood_limit(P[2:], np.array([4]), np.array([400]), Level.of_bound(0.9, 400), 1.0)
    assert conditional["upper_bound_outside"] >= without_pool


def test_infinitely_many_tests_are_asked_for_of_strata_that_have_some():
    two = replace(SHELLS, strata=("a", "b"), cell_stratum=(0, 1), cell_references=(0, 0), cell_p=P[:2], n_inside=1)
    seen = SeenShells.of(replace(two, available=(9, 9)), tally(P[:2], (4, 0), (9, 0)))
    assert (seen.events_for(2.0), seen.events_for(math.inf)) == (2.0, math.inf)


def test_shares_of_the_crashes_have_the_limits_of_a_binomial_share():
    """In one stratum, of a pool without error: Σ n KL(seen, limit) is a level's threshold."""
    one = replace(SHELLS, strata=("a",), cell_stratum=(0,), cell_references=(0,), cell_p=P[:1], n_inside=1)
    every, some = (SeenShells.of(one, tally(0.0 * P[:1], (crashes,), (500,))) for crashes in (40, 10))
    low, high = share_of_crashes(every.design, every.tally, some.tally, LEVEL, of_the_others=False)
    for limit in (low, high):
        distance = 10 * math.log(0.25 / limit) + 30 * math.log(0.75 / (1.0 - limit))
        assert LEVEL.z**2 / 2.0 < distance < LEVEL.threshold  # which are those for many crashes and for few
    others = share_of_crashes(every.design, every.tally, some.tally, LEVEL, of_the_others=True)
    assert others == pytest.approx((1.0 - high, 1.0 - low), rel=1e-6)
    assert share_of_crashes(every.design, every.tally, every.tally, LEVEL, of_the_others=False)[1] == 1.0
    uncertain = SeenShells.of(replace(one, n_paths=30), tally(P[:1], (40,), (500,)))
    fewer = SeenShells.of(one, tally(P[:1], (10,), (500,)))
    assert share_of_crashes(uncertain.design, uncertain.tally, fewer.tally, LEVEL, of_the_others=False)[0] < low


def test_it_has_its_own_inside_and_its_own_refutation():
    """One set of tests: a crash beyond a narrow boundary leaves what is said of a wide one as it is."""
    rows = (0, 8, 0, 2), (1, 3, 0, 17), (2, 0, 0, 400)
    refuted = shells_estimate(*rows, shells=replace(SHELLS, boundary="careful", n_inside=1))
    narrow = within(refuted)
    assert "refuted" in [warning.key for warning in refuted.warnings]
    estimate = shells_estimate(*rows)
    wide = within(estimate)
    assert estimate.crash_rate == pytest.approx(0.8e-4 + 0.15 * 3e-4)
    assert sum(shell["contribution"] for shell in estimate.details["shells"]) == pytest.approx(estimate.crash_rate)
    json.dumps(finite_json(estimate.shown), allow_nan=False)
    assert (narrow["n_episodes"], narrow["n_episodes_outside"], narrow["refuted"]) == (10, 420, True)
    assert narrow["refuted_by"] == (10, 11, 12)
    assert (wide["n_episodes"], wide["n_episodes_outside"], wide["refuted"]) == (30, 400, False)
    assert narrow["crash_rate"] == pytest.approx(0.8e-4)
    assert wide["crash_rate"] == pytest.approx(estimate.crash_rate)
    alone = combined(P[:2], tally(P, (8, 3, 0), (10, 20, 400)).part(slice(0, 2)), SHELLS.n_paths, LEVEL)
    assert (wide["ci_low"], wide["ci_high"]) == pytest.approx((alone.low, alone.high), rel=1e-9)
    assert wide["ci_high"] < estimate.ci_high
    bound = 2e-2 * -np.expm1(-Level.of_bound(0.9, 400).threshold / 400)
    assert wide["upper_bound_outside"] == pytest.approx(bound)


def counted(run, step, mass, stratum, n_runs=100, tests=1000) -> Tally:
    """Crashed tests of baseline runs in two strata, and as many others as never to be a bound."""
    stratum, n = np.asarray(stratum), np.full(2, tests)
    place = CrashedTests(*(np.broadcast_to(each, stratum.shape) for each in (run, step, mass)), stratum)
    crashes = np.bincount(stratum, minlength=2)
    loose = np.full((2, 2), 1e9)
    return Tally(n, crashes, 0 * crashes, loose, 0 * loose, OnRuns.of(n_runs, 2, place))


def test_the_mean_square_of_runs_is_that_of_their_tests_and_of_pairs_in_different_steps():
    """Runs 1, 1, 1, 2 in stratum 0, 2 and 3 in stratum 1, of 1 one step twice: by hand."""
    found = counted(
        [1, 1, 1, 2, 2, 3], [5, 5, 6, 5, 6, 6], [1.0, 1.0, 2.0, 4.0, 8.0, 16.0], [0, 0, 0, 0, 1, 1], tests=4
    )
    own, pairs = (8.0 + 24.0 * 0.5), 100 * (4 / 3 * 2 * 2 + 2 * 0.5)
    assert found.runs.square(np.array([1.0, 0.5]), found) == pytest.approx(own + pairs)
    assert found.runs.square(np.array([1.0, 0.0]), found) == pytest.approx(8.0 + 100 * 4 / 3 * 4)
    assert found.runs.n_pairs(np.ones(2, bool)) == 3.0
    assert found.part(slice(1, 2)).runs.square(np.array([0.5]), found.part(slice(1, 2))) == pytest.approx(12.0)


def test_the_error_of_few_runs_is_neither_a_bound_nor_told_by_pairs_alone():
    """Runs with few and with many crashes, mostly where nearly nobody crashes: there the bound is far too large."""
    rng, n_runs, n_tests = np.random.default_rng(8), 150, 400
    mass = rng.exponential(size=(n_runs, 1)) * rng.exponential(size=(n_runs, 20))
    stratum = np.arange(20) % 2 * np.ones((n_runs, 1), int)
    crash = rng.random(mass.shape) < np.where(stratum == 0, 0.6, 0.03 * (np.arange(n_runs) < 100)[:, None])
    mass = np.where(stratum == 0, 0.05 * mass, mass)
    p, by_path = np.array([mass[stratum == s].sum() for s in (0, 1)]) / n_runs, (mass * crash).sum(1)
    row, step = np.indices(mass.shape)
    found, alone, bound = [], [], []
    for _ in range(200):
        tests, crash_mass = [], np.zeros((2, 2))
        for s in (0, 1):
            drawn = rng.choice(mass.size, n_tests, p=np.where(stratum == s, mass, 0.0).ravel() / (p[s] * n_runs))
            tests.append(drawn := drawn[crash.ravel()[drawn]])
            crash_mass[s] = [mass[row.ravel()[drawn]][:, t::2].sum() for t in (0, 1)]
        of = np.concatenate(tests)
        place = CrashedTests(row.ravel()[of], step.ravel()[of], mass.ravel()[of], stratum.ravel()[of])
        runs, crashes = OnRuns.of(n_runs, 2, place), np.array([each.size for each in tests])
        tally = Tally(np.full(2, n_tests), crashes, 0 * crashes, crash_mass, 0 * crash_mass, runs)
        scale = p / n_tests
        found.append(runs.square(scale, tally))
        alone.append(runs._replace(own=0.0 * runs.own).square(scale, tally))
        bound.append(crash_square(scale, tally._replace(runs=None)))
        assert crash_square(scale, tally) <= bound[-1]
    true = np.mean(by_path**2)
    assert np.mean(found) == pytest.approx(true, rel=0.03)
    assert np.mean(alone) < 0.8 * true
    assert np.mean(bound) > 2.5 * true


def test_without_pairs_the_bound_stays_and_with_few_there_is_room_for_one_more():
    none, weight = counted(range(12), 1, 1e-3, [0] * 12), np.array([1e-3, 1e-3])
    assert none.runs.square(weight, none, ROOM) == math.inf
    assert crash_square(weight, none) == mean_square(weight, none.crash_mass)
    assert none.runs.square(weight, none, -ROOM) == 0.0
    few = counted([0, 0, *range(10)], [1, 2, *[3] * 10], 1e-3, [0] * 12)
    of_mean, square = 12e-3**2, few.runs.square(weight, few)
    expected = of_mean + (square - of_mean) * (1.0 + ROOM * math.sqrt(2.0 / 3.0)) + 2.0 * 100 * 1e-6
    assert few.runs.square(weight, few, ROOM) == pytest.approx(expected)


def test_one_or_two_pairs_of_few_crashes_say_nothing():
    p = np.ones(2)
    assert paths_that_count(p, counted([1, 1, 2, 2, 3], range(5), 1.0, [0] * 5)) == math.inf
    assert paths_that_count(p, counted([1, 1, 1, 2], range(4), 0.0, [0] * 4)) == pytest.approx(16 / 6, rel=2e-3)
    assert paths_that_count(p, empty_tally(2)) == math.inf
    noisy = counted([1, 1, 1, *range(2, 12)], range(13), 1e-4, [0] * 13)
    assert paths_that_count(p, noisy) < FEWEST_PATHS < paths_that_count(p, noisy, -ROOM)


@pytest.mark.parametrize(("untested", "available", "sure"), [(0, 9, False), (0, 0, True), (50, 9, True)])
def test_few_paths_end_nothing_while_another_stratum_is_to_be_tested(untested, available, sure):
    """All crashes on two of 100 runs: there may be others where nothing has been tested, unless nothing can be."""
    two = counted([1, 2] * 30, range(60), 1e-4, [0] * 60)._replace(tests=np.array([1000, untested]), runs=None)
    place = CrashedTests(np.array([1, 2] * 30), np.arange(60), np.full(60, 1e-4), np.zeros(60, np.int64))
    design = replace(SHELLS, strata=("careful", "outside"), cell_stratum=(0, 1), cell_references=(0, 0), n_paths=100)
    design = replace(design, cell_p=P[:2], available=(9_000, available), n_inside=1)
    seen = SeenShells()
    seen.count(design, two, place)
    limits = seen.limits(LEVEL)
    assert (limits.from_pool, limits.from_pool_at_least) == (math.inf, math.inf if sure else 0.0)
    seen.count(replace(design, n_inside=0), empty_tally(2))
    assert seen.within(0.9).upper_bound_outside == 1.0  # they may be all on others there, too


@pytest.mark.parametrize("n_paths", [8, 25, 150, 500])
def test_it_is_the_number_of_equal_paths_and_the_guard_tells_few_from_many(n_paths):
    """Eighty crashes, each a cut-in of its own; the guard decides wrongly in 1,000 draws never."""
    rng = np.random.default_rng(n_paths)
    drawn = (counted(rng.integers(n_paths, size=80), range(80), 1e-4, [0] * 80, n_paths) for _ in range(1000))
    numbers = np.array([paths_that_count(np.ones(2), each) for each in drawn])
    assert np.mean(1.0 / numbers) == pytest.approx(1.0 / n_paths, rel=0.05)
    assert np.all((numbers < FEWEST_PATHS) == (n_paths < FEWEST_PATHS))


@pytest.mark.parametrize("on", [1, 100])
def test_a_run_ends_on_the_interval_that_is_written_also_where_failed_tests_lie_on_few_paths(on):
    """400 crashes, each on a path of its own, and 100 failed tests, on one path or on 100."""
    n, k = 4000, np.arange(4000)
    crash, failed, reference = k < 400, (k >= 400) & (k < 500), (Reference("r157-cc", "a driver"),)
    design = replace(SHELLS, strata=("careful",), cell_stratum=(0,), cell_references=(0,), cell_p=P[:1], n_inside=1)
    design = replace(design, n_paths=2000, candidates=10**9, references=reference, reference_rate=np.array([1e-5]))
    block = in_shells([0] * n, crash, failed)
    walked = {"shadow": np.where(crash, k, 1000 + k % on), "step": k, "event_mass": np.full(n, 1e-4)}
    columns = {**block.columns, **walked, "cell_mass": block.columns["cell_mass"][:, :1]}
    design = replace(design, reference_square=np.array([1e-9]))
    block = replace(block, columns=columns, drawn=SamplingPlan("shells", shells=design))
    seen, written = SeenShells.of_blocks([block]), one_pass([block], ("shells",)).headline_estimate
    assert seen.limits(LEVEL)[1:3] == (written.ci_low, written.ci_high)
    assert seen.limits(LEVEL).rhw == written.rhw
    hour = PerHour([FamilyTests("cut_in", Exposure(1.0, 1.0, 1.0, None, ""), seen)])
    highs = written.ci_high == 1.0, seen.beside("r157-cc", ASSUMPTION_FREE, LEVEL)[1] == math.inf
    assert (*highs, hour.limits(LEVEL).high == math.inf) == (on == 1,) * 3


def test_plain_means_do_not_know_what_to_do_with_shells():
    found = one_pass([in_shells([0], [True])], ("nade", "nde")).estimates
    assert [found[name].why.key for name in ("nade", "nde")] == ["needs_nade", "needs_nde"]


def test_failed_tests_are_of_runs_like_crashed_ones():
    place = CrashedTests(*np.array([[1, 1, 2], [3, 4, 3], [1, 2, 4], [0, 2, 3]]))  # the second and third have failed
    one, none = np.array([1, 0]), np.zeros((2, 2))
    found = Tally(np.array([9, 9]), one, np.array([1, 1]), none, none, OnRuns.of(10, 2, place))
    whole = np.array([1.0, 1.0])
    assert found.runs.square(whole, found) == 1.0
    assert found.failed_as_crashes(np.array([True, False])).runs.n_pairs(whole > 0.0) == 1.0
    assert found.failed_as_crashes().runs.own.tolist() == [3.0, 4.0, 0.0, 0.0]
