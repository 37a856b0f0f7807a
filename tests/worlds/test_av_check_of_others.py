"""`harness av-check` of AVs that are not Python classes: SUMO's own models, a TraCI program, an FMU."""

from __future__ import annotations

import json
import sys

import pytest

from harness.cli import main
from tests.controllers.driving import fmu_av
from tests.worlds.running import EXAMPLE, ROOT


@pytest.fixture
def check(capfd):
    def checked(av: str) -> tuple[int, dict]:
        campaign = str(ROOT / "scenarios/overtaking_forced.yaml")
        code = main(["av-check", campaign, "--json", "--episodes", "6", "--set", f"av={av}"])
        return code, json.loads(capfd.readouterr().out)

    return checked


@pytest.mark.parametrize("form", ["ACC", "EIDM", "program", "fmu"])
def test_it_sees_that_each_form_brakes_and_is_deterministic(form, check, request):
    if form == "fmu":
        av = fmu_av(request.getfixturevalue("fmu"))
    elif form == "program":
        av = f"{{traci: {{command: '{sys.executable} {EXAMPLE} --port {{port}} --cells {{cells}}'}}}}"
    else:
        av = f"{{sumo: {{carFollowModel: {form}}}}}"
    code, found = check(av)
    assert (code, found["deterministic"], found["failures"]) == (0, True, {})
    assert found["behaviour"]["n_cut_ins"] == 6
    braking = found["behaviour"]["min_acceleration_mps2"]
    assert braking == pytest.approx(-4.0) if form in ("program", "fmu") else braking < -1.0


def test_a_program_that_dies_is_found_out(check):
    code, found = check("{traci: {command: 'false', connect_time_s: 5, restarts: 0}}")
    assert code == 3
    assert sum(found["failures"].values()) == 6
