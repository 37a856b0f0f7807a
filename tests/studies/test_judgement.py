"""Judgements from rows that are made up; shells on exact chains, and wrong methods that fail there.

All seeds are fixed. A right method fails the small experiments with probability 5 % per family by the criterion itself,
once and for all: with these seeds it passes. The wrong ones must fail at p < 1e-6.
"""

import json
import math

import numpy as np
import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.families import family_named
from harness.progress import Progress
from harness.strata import ShellDesign
from studies.chains.chain import CHAINS
from studies.chains.shells import ChainShells
from studies.replication import populations
from studies.replication.experiment import Experiment, load_experiment
from studies.replication.judgement import FORMER, Judgement, Row, Subject, corrected, holm, judge
from studies.replication.populations import Known, preventable_by, ratio_to
from studies.replication.run import validate
from studies.replication.shells import FREE, WITHIN, DrawnPool, PairedCampaign, ShellCampaign
from tests.golden.record import unlike
from tests.stored_runs import ROOT, SCENARIOS
from tests.studies.here import wrong_shell


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


CONFIDENCE = 0.9
LARGEST_BIAS = 0.01
FEW = 60


def campaign(method: str, episodes: int) -> Campaign:
    content = {"world": {"engine": "twin"}, "testing": {"method": method}, "stop": {"episodes": episodes}}
    return Campaign.model_validate({"name": "x", "environment": {"parameters": "ndd-overtaking-1"}, **content})


def judged(runs: dict[str, list[Row]], result: str) -> list[Judgement]:
    found = []
    for name, rows in runs.items():
        of_result = [row for row in rows if row.result == result]
        found.append(judge(Subject(name, Known.exactly(CHAINS[name].crash_rate)), result, of_result, CONFIDENCE))
    return corrected(found)


def shells(chain, replications: int, episodes: int, wrong: float = 1.0) -> list[Row]:
    draw = wrong_shell(ChainShells(chain, 2048).draw, 0, wrong)
    return ShellCampaign(campaign("shells", episodes), draw, 5).run(range(replications))


@pytest.mark.slow
def test_a_corrupted_shell_probability_is_caught():
    """The first shell counts one and a half times: where it carries much of the rate, coverage breaks down."""
    chain = CHAINS["good surrogates"]
    (one,) = judged({chain.name: shells(chain, FEW, 3000, 1.5)}, FREE)
    assert one["coverage_too_low"]
    assert one["p_value_holm"] < 1e-6
    assert abs(one["bias"]) > max(LARGEST_BIAS, 8.0 * one["bias_std_error"])


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "caught"), [(1.0, False), (2.0, True)])
def test_limits_are_decided_rightly_but_where_a_shell_counts_twice(wrong, caught):
    """At 0.5 to 2 times the crash rate; nominal: 95 of 100 are right. The second is the sibling that must fail."""
    chain = CHAINS["good surrogates"]
    limits = {factor: factor * chain.crash_rate for factor in (0.5, 0.8, 1.0, 1.25, 2.0)}
    draw = wrong_shell(ChainShells(chain, 2048).draw, 0, wrong)
    rows = ShellCampaign(campaign("shells", 4000), draw, 11, limits, (4000,)).run(range(FEW // 2))
    subject, names = Subject(chain.name, Known.exactly(chain.crash_rate)), dict.fromkeys(row.result for row in rows)
    found = corrected([judge(subject, name, [row for row in rows if row.result == name], 0.95) for name in names])
    found = [one for one in found if one["result"].startswith("limit ")]
    assert any(one["coverage_too_low"] for one in found) == caught
    assert not caught or min(one["p_value_holm"] for one in found) < 1e-6


COMMITTED = {"chains_shells": 5000, "chains_forced": 5000, "shells_panel": 2000, "gate": 500, "shells_bounds": 300}
"""Results in docs/, and how often each was repeated."""


def committed(name: str) -> tuple[dict[tuple[str, str], Judgement], Experiment]:
    """Judgements by subject and result, and the experiment that they are of: shards have no part in it."""
    content = json.loads((ROOT / "docs" / "validation" / f"{name}.json").read_text())
    experiment = content["experiment"]
    for key in ("fault", "levels"):  # keys of earlier versions, all at their defaults
        experiment.pop(key, None)
    for key in ("boundary", "statements", "stopping"):
        experiment["campaign"]["testing"]["shells"].pop(key, None)
    experiment["campaign"]["stop"].pop("estimator", None)
    shipped, pool = load_experiment(ROOT / "scenarios" / "validate" / f"{name}.yaml"), experiment["campaign"]["pool"]
    pool.pop("pilot_tests", None)
    if shipped.campaign.pool.relative_error is None and pool["relative_error"] == family_named("cut_in").pool_error:
        pool["relative_error"] = None  # the default was a number
    both = Experiment.model_validate(experiment), shipped
    one, other = (each.model_dump(exclude={"campaign": {"run"}}) for each in both)
    assert one == other
    return {(one["subject"], one["result"]): one for one in content["judgements"]}, shipped


@pytest.mark.parametrize("name", COMMITTED)
def test_committed_experiments_were_run_at_full_length_and_right_methods_cover(name):
    found, shipped = committed(name)
    assert {subject for subject, _ in found} == {*shipped.avs, *shipped.adversaries, *shipped.chains}
    for (_, result), one in found.items():
        assert one["replications"] >= COMMITTED[name]
        assert not one["coverage_too_low"] or FORMER in result
        assert "chains" not in name or abs(one["bias"]) <= LARGEST_BIAS or result == WITHIN


def test_committed_numbers_of_tests_and_errors_are_those_that_docs_promise():
    panel, _ = committed("shells_panel")
    most = {FREE: 3000, WITHIN: 110}
    assert all(one["tests_median"] <= most.get(result, most[FREE]) for (_, result), one in panel.items())
    assert panel["idm", FREE]["tests_median"] <= 1300
    assert {ratio_to("r157-cc"), preventable_by("r157-cc")} < {result for _, result in panel}
    assert not panel["SM-II", WITHIN]["assumption_met"]
    assert panel["SM-II", FREE]["alarm"] == panel["never-brakes", FREE]["alarm"] == 1.0
    gate, _ = committed("gate")
    assert all(one["p_value"] >= 0.05 or FORMER in result for (_, result), one in gate.items())  # of 95 %, each alone
    former = f"limit 1 x rate, rejected within 400,000 tests{FORMER}"
    for subject in ("idm", "brakes-8", "late-600ms", "inattentive", "SM-II"):
        assert gate[subject, former]["p_value_holm"] < 1e-20
    for subject, tests in (("idm", 950), ("brakes-8", 1650)):
        assert gate[subject, "limit 2 x rate, rejected within 400,000 tests"]["tests_median"] <= tests
    bounds, _ = committed("shells_bounds")
    low = [subject for (subject, result), one in bounds.items() if "upper bound" in result and one["coverage"] < 0.8]
    assert set(low) == {"full-throttle"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chains_shells", "chains_forced"])
def test_committed_experiments_are_what_the_command_gives(name, tmp_path):
    stored, shipped = committed(name)
    validate(shipped, tmp_path, None, Progress())
    found = json.loads((tmp_path / "results.json").read_text())["judgements"]
    as_trees = (dict(enumerate(judgements)) for judgements in (found, stored.values()))
    assert unlike(*as_trees, digits=1e-9) == []  # in all digits on one CPU family
