"""`harness av-check` of AVs that are not Python classes: SUMO's own models, a TraCI program, an FMU."""

from __future__ import annotations

import json
import sys

import pytest

from harness.cli import main
from tests.controllers.test_same_bits import fmu_av
from tests.sumo_av.running import EXAMPLE, ROOT


@pytest.fixture
def check(capfd):
    def checked(av: str) -> tuple[int, dict]:
        campaign = str(ROOT / "scenarios/overtaking_forced.yaml")
        code = main(["av-check", campaign, "--json", "--episodes", "6", "--set", f"av={av}"])
        return code, json.loads(capfd.readouterr().out)

    return checked


@pytest.mark.parametrize("model", ["ACC", "EIDM"])
def test_models_of_sumo(model, check):
    code, found = check(f"{{sumo: {{carFollowModel: {model}}}}}")
    assert (code, found["deterministic"], found["failures"]) == (0, True, {})
    assert (found["engine"], found["behaviour"]["n_cut_ins"]) == ("sumo", 6)
    assert found["behaviour"]["min_acceleration_mps2"] < -1.0


def test_a_program(check):
    code, found = check(f"{{traci: {{command: '{sys.executable} {EXAMPLE} --port {{port}} --cells {{cells}}'}}}}")
    assert (code, found["deterministic"], found["failures"]) == (0, True, {})
    assert found["behaviour"]["min_acceleration_mps2"] == pytest.approx(-4.0)


def test_an_fmu(fmu, check):
    code, found = check(fmu_av(fmu))
    assert (code, found["deterministic"], found["failures"]) == (0, True, {})
    assert found["behaviour"]["min_acceleration_mps2"] == pytest.approx(-4.0)


def test_a_program_that_dies_is_found_out(check):
    code, found = check("{traci: {command: 'false', connect_time_s: 5, restarts: 0}}")
    assert code == 3
    assert sum(found["failures"].values()) == 6
