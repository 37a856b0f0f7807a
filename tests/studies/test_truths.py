"""Truths of a population that is small enough to add up by hand, and what the judgement makes of ones that are 0."""

from __future__ import annotations

import math

import numpy as np
import pytest

from harness.studies.judgement import Row, Subject, judge
from harness.studies.super_population import SuperPopulation
from harness.studies.truths import (
    DIFFERENCE,
    RATE,
    Known,
    of_pair,
    of_vehicle,
    preventable_by,
    ratio_of,
    ratio_to,
)

REFERENCE, VEHICLE, OTHER = 0, 1, 2
POPULATION = SuperPopulation(
    cut_in=np.array([8.0, 8.0, 8.0, 8.0]),
    path=np.array([0, 0, 1, 3]),
    mass=np.array([1.0, 2.0, 3.0, 4.0]),
    bits=np.array([0b011, 0b110, 0b011, 0b101]),
)
"""The reference crashes on 1 + 3 + 4, the vehicle on 1 + 2 + 3, the other one on 2 + 4, of four paths."""


def crashing(driver):
    return POPULATION.mass * POPULATION.crashes(driver)


def test_a_vehicle_beside_a_reference():
    known = of_vehicle(POPULATION, crashing(VEHICLE), {"cc": REFERENCE})
    assert known[RATE].value == known[RATE].scale == 6.0 / 4.0
    assert known[RATE].std_error == pytest.approx(np.std([3.0, 3.0, 0.0, 0.0]) / 2.0)
    assert known[ratio_to("cc")].value == pytest.approx(6.0 / 8.0)
    assert known[preventable_by("cc")].value == pytest.approx(2.0 / 6.0)
    assert known[preventable_by("cc")].scale == 1.0


def test_the_difference_of_two_vehicles_is_relative_to_the_larger_rate():
    known = of_pair(POPULATION, crashing(OTHER), crashing(VEHICLE))[DIFFERENCE]
    assert known.value == 0.0  # 6 and 6 of four paths
    assert known.scale == 6.0 / 4.0
    assert known.std_error == pytest.approx(np.std([-1.0, -3.0, 0.0, 4.0]) / 2.0)
    equal = of_pair(POPULATION, crashing(VEHICLE), crashing(VEHICLE))[DIFFERENCE]
    assert (equal.value, equal.std_error, equal.relative_error) == (0.0, 0.0, 0.0)


def test_the_error_of_a_ratio_is_that_of_repeated_samples():
    rng = np.random.default_rng(1)
    below = rng.gamma(2.0, 1.0, (2000, 400))
    above = below * rng.gamma(2.0, 0.5, below.shape)
    found = [ratio_of(a, b) for a, b in zip(above, below, strict=True)]
    spread = np.std([each.value for each in found])
    assert np.mean([each.std_error for each in found]) == pytest.approx(spread, rel=0.08)


def rows(values, half, **more):
    return [
        Row("difference", k, 100, 5, x, half / 1.6449, x - half, x + half, False, **more) for k, x in enumerate(values)
    ]


def test_a_difference_of_nothing_is_judged_relative_to_the_rates():
    subject = Subject("equal", Known(2.0, 0.0, 2.0), {"difference": Known(0.0, 0.0, 2.0)})
    errors = np.random.default_rng(2).normal(0.0, 0.2, 2000)
    found = judge(subject, "difference", rows(errors, 0.329), 0.9)
    assert found.truth == 0.0
    assert found.true_relvar == pytest.approx(0.01, rel=0.1)
    assert found.claimed_relvar == pytest.approx(0.01, rel=1e-3)
    assert abs(found.bias) < 4.0 * found.bias_std_error
    assert found.coverage_low < 0.9 < found.coverage_high
    shifted = judge(subject, "difference", rows(errors + 0.2, 0.329), 0.9)
    assert shifted.p_value < 1e-6
    assert shifted.bias == pytest.approx(0.1, abs=0.01)


def test_a_refusal_counts_as_covered_and_says_nothing_else():
    subject = Subject("a", Known(1.0, 0.0, 1.0))
    said = rows([1.1] * 6, 0.2)
    refused = [Row("difference", k, 100, 5, math.nan, math.inf, 0.0, math.inf, False, refused=True) for k in range(4)]
    found = judge(subject, "difference", said + refused, 0.9)
    assert (found.covered, found.refused) == (10, 0.4)
    assert found.bias == pytest.approx(0.1)
    assert found.to_json()["true_relvar"] == pytest.approx(0.01)
    nothing = judge(subject, "difference", refused, 0.9)
    assert nothing.to_json()["bias"] is None
