"""Shells and forced cut-ins pass the replication tests on exact chains; wrong methods fail the same tests.

All seeds are fixed. A right method fails the small experiments with probability 5 % per family by the criterion itself,
once and for all: with these seeds it passes. The wrong ones must fail at p < 1e-6.
"""

import json
from functools import partial

import pytest

from harness.campaign.campaign import Campaign
from harness.families import family_named
from harness.progress import Progress
from studies.chains.chain import CHAINS, REPLAYED
from studies.chains.shells import ChainShells
from studies.replication.experiment import Experiment, load_experiment
from studies.replication.judgement import FORMER, Judgement, Row, Subject, corrected, judge
from studies.replication.populations import Known, preventable_by, ratio_to
from studies.replication.run import validate
from studies.replication.shells import FREE, WITHIN, ShellCampaign
from studies.replication.weighted import WeightedCampaign, chain_episodes
from tests.golden.record import unlike
from tests.stored_runs import ROOT
from tests.studies.here import wrong_shell

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


def forced(chain) -> list[Row]:
    episodes = partial(chain_episodes, chain, "forced", 7)
    return WeightedCampaign(campaign("forced", 3000), episodes, ["nade"]).run(range(FEW))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("result", "repeated"), [(FREE, lambda chain: shells(chain, FEW, 1000)), ("nade", forced)], ids=["shells", "forced"]
)
def test_right_methods_cover_and_are_unbiased(result, repeated):
    for one in judged({chain.name: repeated(chain) for chain in REPLAYED}, result):
        assert not one["coverage_too_low"]
        assert abs(one["bias"]) < 4.0 * one["bias_std_error"]


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
