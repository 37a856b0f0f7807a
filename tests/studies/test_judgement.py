"""Judgements from rows that are made up so that the answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from studies.replication.judgement import Row, Subject, corrected, holm, judge
from studies.replication.populations import Known


def rows(rates, half: float, tests: int = 100, outside: int = 0) -> list[Row]:
    return [Row("x", k, tests, 5, r, half / 1.6449, r - half, r + half, False, outside) for k, r in enumerate(rates)]


def test_holm_as_in_a_worked_example():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_normal_estimates_are_judged_right():
    rng = np.random.default_rng(1)
    rates = rng.normal(1.0, 0.1, 4000)
    found = judge(Subject.exact("a", 1.0), "x", rows(rates, 0.16449), 0.9)
    assert abs(found.bias) < 4.0 * found.bias_std_error
    assert found.true_relvar == pytest.approx(0.01, rel=0.1)
    assert found.claimed_relvar == pytest.approx(0.01, rel=1e-9)
    assert found.coverage_low < 0.9 < found.coverage_high
    assert found.p_value > 1e-3
    assert found.tests_for_wanted_rhw == pytest.approx(30.06 * 100 * 0.01, rel=0.1)


def test_too_narrow_intervals_are_noticed_and_too_wide_ones_are_not_blamed():
    rates = np.random.default_rng(1).normal(1.0, 0.1, 1000)
    narrow, wide = (
        judge(Subject.exact(n, 1.0), "x", rows(rates, h), 0.9) for n, h in (("narrow", 0.13), ("wide", 0.3))
    )
    narrow, wide = corrected([narrow, wide])
    assert narrow.too_low
    assert not wide.too_low
    assert narrow.p_value_holm == pytest.approx(2.0 * narrow.p_value)
    assert wide.coverage > 0.99


def test_a_difference_of_nothing_is_judged_relative_to_the_rates():
    subject = Subject("equal", Known(2.0, 0.0, 2.0), {"x": Known(0.0, 0.0, 2.0)})
    errors = np.random.default_rng(2).normal(0.0, 0.2, 2000)
    found = judge(subject, "x", rows(errors, 0.329), 0.9)
    assert found.truth == 0.0
    assert found.true_relvar == pytest.approx(0.01, rel=0.1)
    assert found.claimed_relvar == pytest.approx(0.01, rel=1e-3)
    assert abs(found.bias) < 4.0 * found.bias_std_error
    assert found.coverage_low < 0.9 < found.coverage_high
    shifted = judge(subject, "x", rows(errors + 0.2, 0.329), 0.9)
    assert shifted.p_value < 1e-6
    assert shifted.bias == pytest.approx(0.1, abs=0.01)


def test_a_refusal_counts_as_covered_and_says_nothing_else():
    subject = Subject("a", Known(1.0, 0.0, 1.0))
    said = rows([1.1] * 6, 0.2)
    refused = [Row("x", k, 100, 5, math.nan, math.inf, 0.0, math.inf, False, refused=True) for k in range(4)]
    found = judge(subject, "x", said + refused, 0.9)
    assert (found.covered, found.refused) == (10, 0.4)
    assert found.bias == pytest.approx(0.1)
    assert found.to_json()["true_relvar"] == pytest.approx(0.01)
    nothing = judge(subject, "x", refused, 0.9)
    assert nothing.to_json()["bias"] is None
