"""On which side of a limit an interval lies, in words."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.estimators.stopping import Decision
from harness.strata import ASSUMPTION_FREE

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
