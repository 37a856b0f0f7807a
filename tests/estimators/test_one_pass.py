"""One pass feeds all estimators in order, the user's own too; the content of ``estimates.json``."""

import json
import math

import numpy as np
import pyarrow as pa
import pytest

import harness
from harness.campaign.campaign import Campaign
from harness.errors import CampaignError, HarnessError, RunFolderError
from harness.estimators.answer import estimate_blocks
from harness.estimators.block import Block, block_from_tables
from harness.estimators.estimate import Unavailable, finite_json
from harness.estimators.one_pass import (
    ACCUMULATORS,
    Diagnostics,
    accumulator,
    asked_for,
    headline_of,
    one_pass,
    refusal,
)
from harness.vocabulary import CONTACT, ESTIMATORS, FAILED, OUTCOMES, SAMPLING, TIMEOUT
from studies.chains.chain import overtaking
from tests.chains import SEED
from tests.estimators.small_blocks import block, blocks, fed, in_shells
from tests.in_process import run_here
from tests.stored_runs import answer, copy_of, edit, golden, stored_table

CHAIN = overtaking("two surrogates", skill=0.5, surrogates=[0.5, 0.2], level=0.02, horizon=6)
SIZES = [600, 600, 300]


def drawn(method: str):
    return list(blocks(CHAIN, method, SIZES, SEED))


def answered(parts, **manifest) -> tuple[dict, dict]:
    """Content of ``estimates.json`` from blocks in memory, and its answer in words."""
    campaign = {"name": "chain", "environment": {"lane_change_level": 3.0}, "stop": {"confidence": 0.8}}
    campaign |= {"surrogates": {"one": {"model": "idm"}, "two": {"model": "fvdm"}}}
    campaign["testing"] = {"method": parts[0].drawn.method}
    campaign = Campaign.model_validate(campaign)
    content = estimate_blocks(parts, campaign, {"campaign_hash": "c0ffee", **manifest})
    return content, answer(content, campaign)


@pytest.mark.parametrize(("n", "doubts"), [(2_000, True), (20_000, False)])
def test_one_crash_that_could_double_the_rate_leads_the_warnings(n, doubts):
    """Three tests in a hundred crash, with weight 0.001; the largest weight, 0.1, counts as much as 100 of them."""
    some = block([k % 100 < 3 for k in range(n)], [-6.9] * n, method="forced", log_p_event=np.full(n, np.log(0.1)))
    content, told = answered([some])
    said = told["warnings"][0]
    assert said.startswith("the true rate may lie far above this interval: one more crash") == doubts
    assert ("might add 1.65 times it" in said) == doubts
    assert (content["estimates"]["nade"]["rhw"] is None) == doubts


SHORT = overtaking("short", skill=0.5, surrogates=[0.5, 0.2, 0.8], level=0.02, horizon=5)
METHODS = ["nde", "forced", "step_mixture", "episode_mixture"]


@pytest.mark.parametrize("method", METHODS)
def test_each_estimator_gets_what_it_would_get_alone_and_convergence_is_the_headline_on_prefixes(method):
    parts = list(blocks(SHORT, method, [500] * 6, SEED))
    done = one_pass(iter(parts))
    assert set(done.estimates) == set(ESTIMATORS)
    for name, estimate in done.estimates.items():
        alone = accumulator(name)
        if (why := refusal(parts[0], name)) is None:
            assert estimate == fed(alone, parts).result(0.9)
        else:
            assert estimate == Unavailable(why)
            assert finite_json(estimate)["crash_rate"] is None
    prefixes = [one_pass(parts[:k], ()).headline_estimate for k in range(1, 7)]
    assert [point.n for point in done.convergence] == [500, 1_000, 1_500, 2_000, 2_500, 3_000]
    assert [(at.crash_rate, at.rhw) for at in done.convergence] == [(e.crash_rate, e.precision) for e in prefixes]
    assert done.estimates[SAMPLING[method].headline] == prefixes[-1]


def diagnosed(*parts) -> dict:
    return fed(Diagnostics(), parts).result()


def test_what_is_counted_and_a_small_mean_weight_are_told():
    assert diagnosed(block([False] * 10, [-5.0] * 10))["mean_weight"]["mean"] == pytest.approx(np.exp(-5.0))
    base = block([False] * 4, [-1.0, 0.0, 0.0, 0.0], failed=[False, True, False, False])
    result = diagnosed(base.ending(np.array([True, False, False, False]), CONTACT))
    assert result["bv_lv_contact_share"]["mean"] == pytest.approx(np.exp(-1.0) / 4)
    assert (result["n_failed"], result["n_bv_lv_contacts"]) == (1, 1)
    assert diagnosed(block([False, False], [800.0, 0.0]))["mean_weight"]["mean"] == np.inf


# -- failed tests: no crash in rate and lower limit, crashes in every upper limit, for every estimator --


METHOD = {"nde": "nde", "nade": "forced", "mixture_cv": "episode_mixture"}


def some_failed(parts: list[Block], share: float = 0.5, *, first: int = 1) -> list[Block]:
    """The blocks with a share of the crashes failed instead, from block ``first`` on."""
    rng = np.random.default_rng(SEED)
    changed = []
    for k, part in enumerate(parts):
        failed = part.crash & (rng.random(len(part)) < share) & (k >= first)
        changed.append(part.ending(failed, FAILED))
    return changed


def of_each(name: str) -> list[Block]:
    if name == "shells":
        rng = np.random.default_rng(SEED)
        shares = np.array([0.8, 0.3, 0.02])
        parts = []
        for k in range(4):
            strata = rng.integers(0, 3, 200)
            crash = rng.random(200) < shares[strata]
            parts.append(in_shells(strata.tolist(), crash.tolist(), first=200 * k))
        return parts
    size = 20_000 if name == "nde" else 1_000
    return list(blocks(SHORT, METHOD.get(name, "step_mixture"), [size] * 4, SEED))


@pytest.mark.parametrize("name", ACCUMULATORS)
def test_lower_ends_without_upper_ends_with_the_failed_tests(name):
    parts = some_failed(of_each(name))
    found = one_pass(parts, (name,)).estimates[name]
    as_safe = [part.ending(part.failed, TIMEOUT) for part in parts]
    seen = fed(ACCUMULATORS[name](), as_safe).result(0.9)
    worst = fed(ACCUMULATORS[name](), [part.failed_as_crashes() for part in parts]).result(0.9)
    assert (found.crash_rate, found.std_error, found.ci_low) == (seen.crash_rate, seen.std_error, seen.ci_low)
    assert (found.n_crashes, found.n_effective) == (seen.n_crashes, seen.n_effective)
    assert (found.ci_high, found.upper_bound) == (worst.ci_high, worst.upper_bound)
    assert found.ci_high > seen.ci_high
    assert found.rhw == (worst.ci_high - seen.ci_low) / 2.0 / seen.crash_rate
    assert found.details["crash_rate_if_failed_had_crashed"] == worst.crash_rate
    assert found.details["n_failed"] == sum(int(part.failed.sum()) for part in parts)
    assert "failed" in [warning.key for warning in found.warnings]


def test_rates_are_per_test_and_per_distance_where_that_is_known():
    (unknown, in_tests), (known, in_km) = (answered(drawn("forced"), distance_per_test_m=of) for of in (None, 400.0))
    assert unknown["crash_rate_per_1e6_km"] is None
    assert "km" not in in_tests["rows"][0]["remark"]
    assert known["distance_per_test_km"] == 0.4
    assert known["crash_rate_per_1e6_km"]["rate"] == pytest.approx(known["estimates"]["nade"]["crash_rate"] / 0.4 * 1e6)
    assert "per million km" in in_km["rows"][0]["remark"]


def test_unbounded_weights_lead_the_warnings_and_claim_no_precision():
    content, told = answered(drawn("step_mixture"))
    assert told["warnings"][0].startswith("the true rate may lie far above this interval: the weights")
    for name, n_cautions in (("nade", 1), ("scv", 2)):
        found = content["estimates"][name]
        assert (found["rhw"], found["cautions"]) == (None, found["warnings"][:n_cautions])
    assert {point["rhw"] for point in content["convergence"]} == {None}


def test_a_failed_test_has_the_weight_that_it_had():
    some = block([True, False, False], [-2.0, -1.0, 0.0], failed=[False, True, False])
    assert one_pass([some], ("nade",)).headline_estimate.details["crash_rate_if_failed_had_crashed"] == pytest.approx(
        (np.exp(-2.0) + np.exp(-1.0)) / 3.0
    )


# -- blocks from records --


NAME = "step-recursive-twin"


def read(episodes, moments=None, name=NAME):
    return block_from_tables(golden(name), episodes, moments)


@pytest.fixture
def tables(stored_run):
    return stored_table(stored_run(NAME), "episodes"), stored_table(stored_run(NAME), "moments")


def without(table: pa.Table, row: int) -> pa.Table:
    return pa.concat_tables([table.slice(0, row), table.slice(row + 1)])


def of_others(moments: pa.Table, episode: int) -> pa.Table:
    return moments.filter(pa.array(moments["episode"].to_numpy() != episode))


def with_value(episodes: pa.Table, name: str, row: int, value: object) -> pa.Table:
    values, at = episodes[name].to_pylist(), episodes.schema.get_field_index(name)
    column = pa.array([*values[:row], value, *values[row + 1 :]])
    return episodes.set_column(at, name, column.dictionary_encode() if name == "outcome" else column)


@pytest.mark.parametrize("name", ["nde-twin", "forced-twin", NAME, "mixture-twin"])
def test_a_block_holds_what_the_rows_say(name, stored_run):
    episodes = stored_table(stored_run(name), "episodes").slice(40)
    rows, found = episodes.to_pandas(), read(episodes, name=name)
    assert found.first_episode == 40
    assert [OUTCOMES[k] for k in found.outcome] == rows.outcome.tolist()
    np.testing.assert_array_equal(found.happened, rows.event_step.notna())
    if name in (NAME, "mixture-twin"):
        np.testing.assert_array_equal(found.log_q, np.stack(rows.log_q))
    for column in ("log_weight", "n_control_steps"):
        np.testing.assert_array_equal(getattr(found, column), rows[column])
    if "log_p_event" in found.columns:
        np.testing.assert_array_equal(found.columns["log_p_event"], rows.log_p_event.fillna(-np.inf))
    assert found.drawn.weight_cap == (1.0 if name == "nde-twin" else None)


def test_ratios_are_those_of_the_first_nine_control_steps(tables):
    found = read(*tables)
    assert found.n_control_steps.max() > 9
    expected = np.ones_like(found.first_ratios)
    for episode, steps in tables[1].to_pandas().groupby("episode"):
        ratios = np.stack(steps.q)[:9] / steps.q_sampled.to_numpy()[:9, None]
        expected[episode, : len(ratios)] = ratios
    np.testing.assert_allclose(found.first_ratios, expected, rtol=1e-15)


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (lambda episodes, moments: (without(episodes, 10), moments), "row 10: found episode 11 after episode 9"),
        (lambda episodes, moments: (with_value(episodes, "log_weight", 5, np.nan), moments), "5: found log_weight nan"),
        (lambda episodes, moments: (episodes, of_others(moments, 100)), "moments, episode 100: found"),
        (lambda episodes, moments: (episodes, moments.take(pa.array(range(len(moments))[::-1]))), "in order"),
    ],
)
def test_damaged_tables_name_the_place(damage, text, tables):
    with pytest.raises(RunFolderError, match=text):
        read(*damage(*tables))


def test_a_failed_episode_may_lack_its_weight_and_its_moments(tables):
    episodes, moments = tables
    failed = with_value(with_value(episodes, "outcome", 7, "failed"), "log_weight", 7, float("nan"))
    found = read(failed, of_others(moments, 7))
    assert (found.failed[7], found.log_weight[7]) == (True, 0.0)
    assert np.all(found.first_ratios[7] == 1.0)


CODE = """
from harness.estimators.estimate import Estimate


class Mean:
    methods = "step_mixture", "episode_mixture"

    def __init__(self):
        self.n, self.y, self.yy = 0, 0.0, 0.0

    def add(self, block):
        y = block.weighted_crashes()
        self.n, self.y, self.yy = self.n + len(block), self.y + y.sum(), self.yy + y @ y
        self.drawn = block.drawn

    def result(self, confidence):
        mean = self.y / self.n
        return mean, ((self.yy / self.n - mean**2) / (self.n - 1)) ** 0.5


class Raises(Mean):
    def result(self, confidence):
        raise ZeroDivisionError("no weight")


class Nothing(Mean):
    def result(self, confidence):
        return float("nan"), 1.0


class UpsideDown(Mean):
    def result(self, confidence):
        return Estimate(1.0, 0.0, 0.9, 0.1, 1.0, confidence, 0.1, self.n, 1, 1.0, 1.0, "normal", "one_sided")


class Writes(Mean):
    def add(self, block):
        super().add(block)
        block.log_weight[:], block.outcome[:] = 0.0, 0


class Below(Mean):
    def result(self, confidence):
        return -0.5, 0.1


class Anywhere(Mean):
    methods = "shells",


class Three(Mean):
    methods = 3


class NoResult:
    methods, add = ("nde",), None
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "mine.py").write_text(CODE)
    return tmp_path / "mine.py"


def one(file, name="Mean"):
    return asked_for([f"{file}:{name}"], "-e")[0]


def test_it_is_ours_with_a_normal_interval_and_is_told_what_tests_are_drawn_by(file):
    parts = [block([True, False] * 40, [-3.0] * 80, epsilon=0.2, first_episode=80 * k) for k in range(3)]
    found = one_pass(parts, ["nade", one(file)]).estimates
    ours, theirs = found["nade"], found["mine.py:Mean"]
    assert (theirs.crash_rate, theirs.weight_cap) == (pytest.approx(ours.crash_rate), ours.weight_cap)
    assert theirs.std_error == pytest.approx(ours.std_error, rel=1e-6)
    assert theirs.cautions == ours.cautions
    assert theirs.warnings[-1].key == "own"
    assert theirs.interval == "normal"


def test_one_with_the_name_of_one_of_ours_is_refused():
    mine = type("nade", (), {"methods": ("forced",), "add": None, "result": None})
    with pytest.raises(HarnessError, match=r"own named nade; expected .* Rename the class"):
        asked_for(["nade", mine], "estimators")


def test_others_are_the_same_beside_one_that_writes_into_its_blocks(file):
    found = one_pass([block([True, False], [-3.0, -2.0])], [one(file, "Writes"), "nade"]).estimates
    assert found["nade"].crash_rate == pytest.approx(math.exp(-3.0) / 2.0)


def test_an_interval_of_a_negative_rate_ends_at_0(file):
    found = one_pass([block([True, False])], [one(file, "Below")]).estimates["mine.py:Below"]
    assert (found.ci_low, found.ci_high) == (0.0, 0.0)


def test_one_answers_for_a_campaign_draws_its_course_and_stops_it(file, tmp_path):
    campaign = golden("mixture-twin", "stop.rhw=0.9", f"testing.estimator={file}:Mean")
    assert headline_of(campaign).name == "mine.py:Mean"
    result = run_here(campaign, tmp_path / "run")
    estimates = result.estimates
    assert estimates["headline"] == "mine.py:Mean"
    assert estimates["convergence"][-1]["crash_rate"] == estimates["estimates"]["mine.py:Mean"]["crash_rate"]
    assert json.loads(json.dumps(harness.estimate(tmp_path / "run")))["headline"] == "mine.py:Mean"
    other = copy_of(tmp_path / "run", tmp_path / "other")
    edit(other, signature="another's")
    with pytest.raises(HarnessError, match=r"not made on this machine by this user; it names .*mine.py:Mean"):
        harness.estimate(other)


@pytest.mark.parametrize(
    ("name", "found", "mend"),
    [
        ("Raises", r"ZeroDivisionError: no weight \(.*mine.py:\d+\)", "Fix the class"),
        ("Nothing", r"\(nan, 1.0\)", "Fix what it returns"),
        ("UpsideDown", "ci_low=0.9, ci_high=0.1", "Fix what it returns"),
        ("Anywhere", "methods .*'shells'", "Write methods ="),
        ("Three", "methods 3", "Write methods ="),
        ("NoResult", "NoResult without result", "Add what is missing"),
        ("Meen", "no class or function Meen", "Did you mean 'Mean'"),
    ],
)
def test_what_is_wrong_with_one_is_told_in_four_parts(file, name, found, mend):
    with pytest.raises(HarnessError, match=f"found .*{found}.*; expected .*{mend}") as caught:
        one_pass([block([True, False])], [one(file, name)])
    assert caught.value.exit_code == 2


def test_one_that_cannot_use_the_tests_is_refused_with_the_reason(file):
    found = one_pass([block([True], method="forced")], [one(file)]).estimates["mine.py:Mean"]
    assert found.crash_rate is None
    assert found.why.numbers == {"methods": "step_mixture, episode_mixture", "method": "forced"}
    for method in ("forced", "shells"):
        with pytest.raises(CampaignError, match=f"with testing.method {method}"):
            headline_of(golden("mixture-twin", f"testing.method={method}", f"testing.estimator={file}:Mean"))


def test_an_installed_package_gives_one_a_name(file, monkeypatch):
    from importlib.metadata import EntryPoint

    entry = EntryPoint("ratio", f"{file}:Mean", "harness.estimators")
    monkeypatch.setattr(
        "harness.estimators.one_pass.entry_points", lambda *, group: [entry] if group == entry.group else []
    )
    assert asked_for(["ratio"], "-e")[0].name == "ratio"
    with pytest.raises(HarnessError, match="Did you mean 'ratio'"):
        asked_for(["ratios"], "-e")


def test_failed_tests_count_both_ways(file):
    failed = block([True, False, False] * 40, failed=[False, True, False] * 40)
    found = one_pass([failed], [one(file)]).estimates["mine.py:Mean"]
    assert found.details["crash_rate_if_failed_had_crashed"] == pytest.approx(2 / 3)
    assert found.ci_high > 2 / 3
