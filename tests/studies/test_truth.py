"""Truths: precise enough, from paths of their own."""

from __future__ import annotations

import pytest

from harness.campaign.models import AutomatedVehicle, EnvironmentSettings
from harness.environment.loading import load_environment
from harness.pool.library import load_library
from harness.progress import SilentProgress
from harness.studies.panel import Drivers
from harness.studies.truth import Truth, combined, truths


def test_two_truths_are_weighted_by_their_precision():
    one = combined(Truth(1.0, 0.1), Truth(2.0, 0.2))
    assert one.crash_rate == pytest.approx(1.2)
    assert one.std_error == pytest.approx(0.1 * 0.8**0.5)


def test_imprecise_ones_are_enumerated_again_and_agree():
    avs = {
        "idm": AutomatedVehicle.model_validate({}),
        "wild": AutomatedVehicle.model_validate({"model": "constant", "parameters": {"acceleration_mps2": 0.0}}),
    }
    drivers = Drivers(load_library("ladder-1"), avs)
    environment = load_environment(EnvironmentSettings())
    found = truths(environment, drivers, 3, 1024, SilentProgress())
    assert found["idm"].crash_rate == pytest.approx(1.343e-7, abs=4.0 * found["idm"].std_error)
    assert found["idm"].relative_error < 0.02  # once would leave some 2 %
    assert found["wild"].crash_rate == pytest.approx(2.43e-5, abs=4.0 * found["wild"].std_error)
