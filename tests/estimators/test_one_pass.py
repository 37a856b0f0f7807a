"""One pass feeds all estimators in order; the whole way from a run folder to the content of ``estimates.json``."""

import json
from dataclasses import replace

import numpy as np
import pytest
from pydantic import TypeAdapter

from harness.errors import HarnessError, RunFolderError
from harness.estimators import (
    ESTIMATORS,
    CampaignFacts,
    Estimate,
    Unavailable,
    accumulator,
    estimate_blocks,
    one_pass,
)
from harness.estimators.estimate import Estimates, finite_json
from harness.runner import estimate_run
from harness.vocabulary import SAMPLING
from studies.chains.chain import overtaking
from studies.chains.sampler import blocks
from tests.chains.seed import SEED

from .run_folder import write_run
from .small_blocks import block

CHAIN = overtaking("two surrogates", skill=0.5, surrogates=[0.5, 0.2], level=0.02, horizon=6)
SIZES = [600, 600, 300]
KEYS = {
    "campaign", "campaign_hash", "lane_change_level", "confidence", "n_episodes", "n_crashes", "headline",
    "distance_per_test_km", "crash_rate_per_1e6_km", "estimates", "diagnostics", "convergence", "statement",
    "statements", "reference_statements", "boundary_statements", "ending", "decision",
    "scope",
}  # fmt: skip


def drawn(method: str):
    return list(blocks(CHAIN, method, SIZES, SEED))


def facts(**settings) -> CampaignFacts:
    return CampaignFacts("chain", "c0ffee", 3.0, **{"confidence": 0.8, **settings})


@pytest.mark.parametrize(
    ("method", "headline", "importance"),
    [
        ("nde", "nde", []),
        ("forced", "nade", []),
        ("step_mixture", "nade", ["one", "two"]),
        ("episode_mixture", "mixture_cv", ["forced", "one", "two"]),
    ],
)
def test_a_stored_run_gives_what_blocks_in_memory_give(tmp_path, method, headline, importance):
    parts = drawn(method)
    if method != "nde":  # of which records say nothing, as those of real campaigns do not
        parts = [replace(part, drawn=replace(part.drawn, weight_cap=None)) for part in parts]
    folder = write_run(tmp_path, parts, distance_per_test_m=400.0)
    content = estimate_run(folder)
    assert set(content) == KEYS
    assert content["headline"] == headline
    assert content["n_episodes"] == sum(SIZES)
    assert content["confidence"] == 0.8
    assert content["lane_change_level"] == 3.0
    assert list(content["diagnostics"]["mean_ratio"]) == importance
    memory = estimate_blocks(parts, facts(distance_per_test_m=400.0, importance_names=tuple(importance)))
    if method == "step_mixture":  # q was stored, q/q_sampled is divided again: one rounding in the regression
        memory["estimates"].pop("scv")
        content["estimates"].pop("scv")
    assert json.loads(json.dumps(content, allow_nan=False)) == memory


def test_each_estimator_has_its_sentence_with_rates_per_distance_where_that_is_known():
    unknown, known = (estimate_blocks(drawn("forced"), facts(distance_per_test_m=of)) for of in (None, 400.0))
    assert unknown["crash_rate_per_1e6_km"] is None
    assert "km" not in unknown["statement"]
    assert known["distance_per_test_km"] == 0.4
    assert known["crash_rate_per_1e6_km"]["rate"] == pytest.approx(known["estimates"]["nade"]["crash_rate"] / 0.4 * 1e6)
    assert "per 1e6 km" in known["statement"]
    assert "lane-change level 3" in known["statement"]
    assert "not about how well the environment matches the road" in known["scope"]
    assert set(known["statements"]) == set(known["estimates"])
    assert known["statements"]["nade"] == known["statement"]
    assert known["statements"]["nde"].startswith("No crash rate from these records: ")
    assert known["estimates"]["nde"]["reason"].rstrip(".") in known["statements"]["nde"]


def test_without_a_crash_the_statement_gives_the_upper_bound():
    none = block([False] * 200, method="forced", weight_cap=1e-4)
    content = estimate_blocks([none], facts(distance_per_test_m=400.0))
    upper = content["estimates"]["nade"]["upper_bound"]
    assert f"below {upper:.3g} per test" in content["statement"]
    assert f"{upper / 0.4 * 1e6:.3g} per 1e6 km" in content["statement"]
    assert content["convergence"][-1]["rhw"] is None


@pytest.mark.parametrize("method", ["nde", "forced", "episode_mixture"])
def test_failed_tests_are_named_in_the_answer_itself(method):
    """Failures look like a safe vehicle otherwise."""
    crashes = [True] * 4 + [False] * 196
    some = block(crashes, failed=[False] * 150 + [True] * 50, method=method, weight_cap=1.0)
    content = estimate_blocks([some], facts())
    assert "50 FAILED: they count as no crash in the rate and as crashes in the upper limit." in content["statement"]
    assert "Had they all crashed, the rate would be 0.27." in content["statement"]
    none = estimate_blocks([block(crashes, method=method, weight_cap=1.0)], facts())
    assert "FAILED" not in none["statement"]


def test_unbounded_weights_lead_the_sentence_and_claim_no_precision():
    content = estimate_blocks(drawn("step_mixture"), facts())
    unbounded = "the weights of these tests are unbounded: the true rate may lie far above this interval"
    assert content["statement"].startswith(f"WARNING: {unbounded}. The crash rate is")
    assert content["statements"]["scv"].startswith("WARNING: this interval is known to be too narrow; use nade's")
    for name in ("nade", "scv"):
        assert "half-width" not in content["statements"][name]
        assert content["estimates"][name]["rhw"] is None
        cautions = content["estimates"][name]["cautions"]
        assert cautions == content["estimates"][name]["warnings"][: 2 if name == "scv" else 1]
    assert {point["rhw"] for point in content["convergence"]} == {None}


@pytest.mark.parametrize(("n", "doubts"), [(2_000, True), (20_000, False)])
def test_one_crash_that_could_double_the_rate_leads_the_sentence(n, doubts):
    """60 crashes of weight 0.001; one of the largest weight, 0.1, would count as much as 100 of them."""
    crashes = [True] * (60 * n // 2_000) + [False] * (n - 60 * n // 2_000)
    some = block(crashes, [-6.9] * n, method="forced", log_p_cut_in=np.full(n, np.log(0.1)))
    content = estimate_blocks([some], facts())
    caution = "WARNING: one more crash of the largest possible weight would add 1.65 times this rate"
    assert content["statement"].startswith(caution) == doubts
    assert ("relative half-width" in content["statement"]) != doubts


def test_estimators_that_the_records_do_not_allow_are_there_with_the_reason(tmp_path):
    content = estimate_run(write_run(tmp_path, drawn("step_mixture"), with_moments=False))
    assert content["estimates"]["scv"]["crash_rate"] is None
    assert "records.moments" in content["estimates"]["scv"]["reason"]
    assert content["estimates"]["nde"]["crash_rate"] is None


def test_only_asked_estimators_and_the_headline_are_reported(tmp_path):
    folder = write_run(tmp_path, drawn("step_mixture"))
    assert set(estimate_run(folder, estimators=["scv"])["estimates"]) == {"nade", "scv"}
    wider = estimate_run(folder, confidence=0.99)["estimates"]["nade"]
    narrow = estimate_run(folder)["estimates"]["nade"]
    assert wider["confidence"] == 0.99
    assert wider["ci_high"] > narrow["ci_high"]


def test_only_the_prefix_that_counts_is_estimated(tmp_path):
    content = estimate_run(write_run(tmp_path, drawn("forced"), n_episodes=700))
    assert content["n_episodes"] == 700
    assert content["convergence"][-1]["n"] == 700


@pytest.mark.parametrize(
    ("kept", "n_episodes", "text"),
    [((0, 1, 2), 5_000, "1500 episodes on record"), ((0, 2), 900, "begins at episode 1200")],
    ids=["too few episodes", "a shard missing in between"],
)
def test_missing_episodes_are_an_error(tmp_path, kept, n_episodes, text):
    parts = drawn("forced")
    with pytest.raises(RunFolderError, match=text):
        estimate_run(write_run(tmp_path, [parts[k] for k in kept], n_episodes=n_episodes))


def test_a_folder_that_is_no_run_is_an_error(tmp_path):
    with pytest.raises(HarnessError, match=r"manifest\.json"):
        estimate_run(tmp_path)


SHORT = overtaking("short", skill=0.5, surrogates=[0.5, 0.2, 0.8], level=0.02, horizon=5)
METHODS = ["nde", "forced", "step_mixture", "episode_mixture"]


@pytest.mark.parametrize("method", METHODS)
def test_each_estimator_gets_what_it_would_get_alone(method):
    parts = list(blocks(SHORT, method, [1_000] * 4, SEED))
    together = one_pass(iter(parts)).estimates
    for name, estimate in together.items():
        alone = accumulator(name)
        reason = alone.seen.refusal(parts[0])
        if reason is not None:
            assert estimate == Unavailable(reason)
            assert finite_json(estimate.shown) == {"crash_rate": None, "reason": reason}
            continue
        for part in parts:
            alone.add(part)
        assert estimate == alone.result(0.9)
    assert set(together) == set(ESTIMATORS)
    assert isinstance(together[SAMPLING[method].headline], Estimate)


@pytest.mark.parametrize("method", METHODS)
def test_convergence_is_the_headline_on_prefixes(method):
    parts = list(blocks(SHORT, method, [500] * 6, SEED))
    points = one_pass(parts).convergence
    assert [point["n"] for point in points] == [500, 1_000, 1_500, 2_000, 2_500, 3_000]
    for k in (1, 3, 6):
        prefix = one_pass(parts[:k]).headline_estimate
        assert (points[k - 1]["crash_rate"], points[k - 1]["rhw"]) == (prefix.crash_rate, prefix.precision)


def test_convergence_points_are_thinned_but_end_at_the_end():
    parts = list(blocks(SHORT, "nde", [10] * 400, SEED))
    numbers = np.array([point["n"] for point in one_pass(parts).convergence])
    assert numbers[-1] == 4_000
    assert np.all(numbers[1:-1] >= 1.01 * numbers[:-2])
    assert len(numbers) < 300


def test_a_gap_is_refused():
    first, second, third = blocks(SHORT, "nde", [10] * 3, SEED)
    with pytest.raises(ValueError, match="expected a block from episode 10 on, got one from 20"):
        one_pass([first, third])
    with pytest.raises(ValueError, match="expected a block from episode 0"):
        one_pass([second])
    with pytest.raises(ValueError, match="at least one episode"):
        one_pass([])


OF_ONE = """crash_rate std_error ci_low ci_high upper_bound confidence rhw n_episodes n_crashes n_effective
largest_weight_share weight_cap method warnings cautions details"""


@pytest.mark.parametrize("method", ["nde", "step_mixture", "episode_mixture"])
def test_the_file_keeps_its_keys_and_is_read_as_what_wrote_it(method):
    content = estimate_blocks(drawn(method), facts())
    assert content.keys() == KEYS
    assert content["estimates"][content["headline"]].keys() == set(OF_ONE.split())
    assert content["convergence"][0].keys() == {"n", "crash_rate", "ci_low", "ci_high", "rhw", "n_crashes"}
    assert finite_json(TypeAdapter(Estimates).validate_json(json.dumps(content), strict=True)) == content
