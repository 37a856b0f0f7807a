"""Judgements from rows that are made up, and truths of a population that is added up by hand."""

import math

import numpy as np
import pytest

from harness.campaign.files import load_campaign
from harness.strata import ShellDesign
from studies.replication import populations
from studies.replication.judgement import Row, Subject, corrected, holm, judge
from studies.replication.shells import DrawnPool, PairedCampaign
from tests.stored_runs import SCENARIOS


def rows(rates, half: float) -> list[Row]:
    return [Row("x", k, 100, 5, r, half / 1.6449, r - half, r + half, False) for k, r in enumerate(rates)]


def test_holm_as_in_a_worked_example():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_normal_estimates_are_judged_right():
    rates = np.random.default_rng(1).normal(1.0, 0.1, 4000)
    right, narrow, wide = (
        judge(Subject(str(h), populations.Known.exactly(1.0)), "x", rows(rates, h), 0.9) for h in (0.16449, 0.13, 0.3)
    )
    assert abs(right["bias"]) < 4.0 * right["bias_std_error"]
    assert right["true_relvar"] == pytest.approx(0.01, rel=0.1)
    assert right["claimed_relvar"] == pytest.approx(0.01, rel=1e-9)
    assert right["coverage_low"] < 0.9 < right["coverage_high"]
    assert right["p_value"] > 1e-3
    assert right["tests_for_wanted_rhw"] == pytest.approx(30.06 * 100 * 0.01, rel=0.1)
    too_narrow, too_wide = corrected([narrow, wide])
    assert (too_narrow["coverage_too_low"], too_wide["coverage_too_low"]) == (True, False)
    assert too_narrow["p_value_holm"] == pytest.approx(2.0 * narrow["p_value"])


def test_a_difference_of_nothing_is_judged_relative_to_the_rates():
    subject = Subject("equal", populations.Known(2.0, 0.0, 2.0), {"x": populations.Known(0.0, 0.0, 2.0)})
    errors = np.random.default_rng(2).normal(0.0, 0.2, 2000)
    found = judge(subject, "x", rows(errors, 0.329), 0.9)
    assert found["truth"] == 0.0
    assert found["true_relvar"] == pytest.approx(0.01, rel=0.1)
    assert found["coverage_low"] < 0.9 < found["coverage_high"]
    shifted = judge(subject, "x", rows(errors + 0.2, 0.329), 0.9)
    assert shifted["p_value"] < 1e-6
    assert shifted["bias"] == pytest.approx(0.1, abs=0.01)


def test_a_refusal_counts_as_covered_and_says_nothing_else():
    subject = Subject("a", populations.Known.exactly(1.0))
    refused = [Row("x", k, 100, 5, math.nan, math.inf, 0.0, math.inf, False, refused=True) for k in range(4)]
    found = judge(subject, "x", rows([1.1] * 6, 0.2) + refused, 0.9)
    assert (found["covered"], found["refused"]) == (10, 0.4)
    assert found["bias"] == pytest.approx(0.1)
    assert math.isnan(judge(subject, "x", refused, 0.9)["bias"])


def test_a_vehicle_beside_a_reference():
    """The reference crashes on 1 + 3 + 4, the vehicle on 1 + 2 + 3, of four paths."""
    cut_in, path, mass = np.full(4, 8.0), np.array([0, 0, 1, 3]), np.array([1.0, 2.0, 3.0, 4.0])
    population = populations.SuperPopulation(cut_in, path, mass, np.array([0b011, 0b110, 0b011, 0b101]))
    known = populations.of_vehicle(population, mass * population.crashes(1), {"cc": 0})
    assert known[populations.RATE].value == known[populations.RATE].scale == 6.0 / 4.0
    assert known[populations.RATE].std_error == pytest.approx(np.std([3.0, 3.0, 0.0, 0.0]) / 2.0)
    assert known[populations.ratio_to("cc")].value == pytest.approx(6.0 / 8.0)
    assert known[populations.preventable_by("cc")].value == pytest.approx(2.0 / 6.0)
    assert known[populations.preventable_by("cc")].scale == 1.0


def test_the_error_of_a_ratio_is_that_of_repeated_samples():
    rng = np.random.default_rng(1)
    below = rng.gamma(2.0, 1.0, (2000, 400))
    above = below * rng.gamma(2.0, 0.5, below.shape)
    found = [populations.ratio_of(a, b) for a, b in zip(above, below, strict=True)]
    spread = np.std([each.value for each in found])
    assert np.mean([each.std_error for each in found]) == pytest.approx(spread, rel=0.08)


# -- comparisons, repeated: intervals of the difference cover; one that assumes what is not so does not --


P = np.array([1e-7, 2e-7, 3e-6])
BOTH, ONLY_A, ONLY_B = np.array([[0.5, 0.2, 0.0], [0.3, 0.1, 0.1], [0.0, 0.1, 0.0]])
"""Shares of each stratum."""
TRUTH = float(P @ (ONLY_A - ONLY_B))
REPLICATIONS = 120
"""At 0.9 a standard error of 0.027: three of them below 0.9 is 0.818."""


def known_pool(_rng):
    """A pool without error of its own."""
    design = ShellDesign(
        pool="0" * 24, strata=("a", "b", "outside"), cell_stratum=(0, 1, 2), cell_p=P, n_paths=10**12,
        boundary="b", assumes="keeps to b", n_inside=2, p_event=float(P.sum()), p_unreachable=0.0,
    )  # fmt: skip
    mass = np.diag(P)
    return [DrawnPool(design, mass, mass * share) for share in (BOTH, ONLY_A, ONLY_B)]


def covered(rows):
    return np.mean([row.ci_low <= TRUTH <= row.ci_high for row in rows])


@pytest.mark.slow
def test_intervals_cover_at_the_stop_and_conditional_ones_do_not_where_vehicles_differ_outside():
    """Nine tenths of the difference lie beyond the boundary, which the conditional statement leaves out."""
    campaign = load_campaign(
        SCENARIOS / "overtaking_shells.yaml", ["world.engine=twin", "stop.rhw=0.5", "testing.shells.first_tests=12"]
    )
    found = PairedCampaign(campaign, known_pool, seed=3).run(range(REPLICATIONS))
    free, inside = (
        [row for row in found if row.result == name]
        for name in (populations.DIFFERENCE, populations.CONDITIONAL_DIFFERENCE)
    )
    assert len(free) == REPLICATIONS
    assert all(row.reached for row in free)
    assert covered(free) >= 0.818
    larger = float(P @ (BOTH + ONLY_A))
    assert abs(np.mean([row.crash_rate for row in free]) - TRUTH) < 0.1 * larger
    assert covered(inside) < 0.5
    assert all(row.n_crashes_outside == 0 for row in inside)
    assert any(row.n_crashes_outside > 0 for row in free)
