"""`harness av-check` of AVs that are not Python classes: SUMO's own models, a TraCI program, an FMU."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.controllers.test_same_bits import fmu, fmu_av  # noqa: F401 - a fixture
from tests.sumo_av.running import EXAMPLE, ROOT


def check(av: str, *overrides: str, episodes: int = 6) -> tuple[int, dict]:
    """In a process of its own: SUMO's library allows one simulation per process."""
    command = [sys.executable, "-m", "harness", "av-check", str(ROOT / "scenarios/overtaking_forced.yaml"), "--json"]
    for override in (f"av={av}", *overrides):
        command += ["--set", override]
    done = subprocess.run(
        [*command, "--episodes", str(episodes)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 3), done.stderr
    return done.returncode, json.loads(done.stdout)


@pytest.mark.parametrize("model", ["ACC", "EIDM"])
def test_models_of_sumo(model):
    code, found = check(f"{{sumo: {{carFollowModel: {model}}}}}")
    assert (code, found["deterministic"], found["failures"]) == (0, True, {})
    assert (found["engine"], found["behaviour"]["n_cut_ins"]) == ("sumo", 6)
    assert found["behaviour"]["min_acceleration_mps2"] < -1.0


def test_a_program():
    code, found = check(f"{{traci: {{command: '{sys.executable} {EXAMPLE} --port {{port}} --cells {{cells}}'}}}}")
    assert (code, found["deterministic"], found["failures"]) == (0, True, {})
    assert found["behaviour"]["min_acceleration_mps2"] == pytest.approx(-4.0)


def test_an_fmu(fmu):  # noqa: F811 - the fixture
    code, found = check(fmu_av(fmu))
    assert (code, found["deterministic"], found["failures"]) == (0, True, {})
    assert found["behaviour"]["min_acceleration_mps2"] == pytest.approx(-4.0)


def test_a_program_that_dies_is_found_out():
    code, found = check("{traci: {command: 'false', connect_time_s: 5, restarts: 0}}")
    assert code == 3
    assert sum(found["failures"].values()) == 6
