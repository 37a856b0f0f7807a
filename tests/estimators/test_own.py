"""Estimators of one's own: how they are found, what is refused of them, and what of ours goes with them."""

import json

import pytest

import harness
from harness.errors import CampaignError, HarnessError
from harness.estimators.one_pass import asked_for, headline_of, one_pass
from tests.estimators.small_blocks import block
from tests.in_process import run_here
from tests.stored_runs import copy_of, edit, golden

CODE = """
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


class Anywhere(Mean):
    methods = "shells",


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
        ("Anywhere", "methods .*'shells'", "Write methods ="),
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
