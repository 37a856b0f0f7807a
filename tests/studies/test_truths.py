"""Truths of a population that is small enough to add up by hand."""

from __future__ import annotations

import numpy as np
import pytest

from studies.replication.populations import RATE, SuperPopulation, of_vehicle, preventable_by, ratio_of, ratio_to

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


def test_the_error_of_a_ratio_is_that_of_repeated_samples():
    rng = np.random.default_rng(1)
    below = rng.gamma(2.0, 1.0, (2000, 400))
    above = below * rng.gamma(2.0, 0.5, below.shape)
    found = [ratio_of(a, b) for a, b in zip(above, below, strict=True)]
    spread = np.std([each.value for each in found])
    assert np.mean([each.std_error for each in found]) == pytest.approx(spread, rel=0.08)
