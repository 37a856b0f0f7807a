"""`av-check` with good and bad controllers: each fault is seen, and a good one passes."""

import json
from pathlib import Path

import pytest

from harness.campaign.files import load_campaign
from harness.cli import main
from harness.runner.look import check_av

MIXTURE_FILE = str(Path(__file__).parents[2] / "scenarios/overtaking_mixture.yaml")
EXITS = "av={controller: 'tests.controllers.misbehaving:Misbehaving', parameters: {bad: {'2': ends_the_process}}}"


class Steady:
    """Brakes alike at all times."""

    def start(self, episode):
        self.random = episode.random

    def step(self, seen):
        return -1.5

    def close(self): ...


class Noisy(Steady):
    """Random, but from the stream that it is given."""

    def step(self, seen):
        return -self.random.random()


class Remembering(Steady):
    """Brakes harder from episode to episode."""

    seen = 0

    def start(self, episode):
        self.seen += 1

    def step(self, seen):
        return -0.01 * self.seen


class Undefined(Steady):
    def step(self, seen):
        return float("nan") if seen.speed_mps > 30.0 else -1.0


def check(name, *overrides):
    controller = name if ":" in name else f"{__name__}:{name}"
    return check_av(load_campaign(MIXTURE_FILE, ["av={}", f"av.controller={controller}", *overrides]), 24)


def test_the_built_in_idm_is_fine():
    found = check_av(load_campaign(MIXTURE_FILE), 24)
    assert (found.exit_code, found.engine, found.method) == (0, "twin", "forced")
    assert found.behaviour.n_cut_ins == 24
    assert found.behaviour.min_acceleration_mps2 == found.limits_mps2[0] == -4.0
    assert 0.0 < found.behaviour.share_at_min < 1.0


@pytest.mark.parametrize(
    ("name", "differs"),
    [("Steady", False), ("Noisy", False), ("tests.controllers.misbehaving:Global", True), ("Remembering", True)],
)
def test_a_controller_that_is_not_reproduced_is_found_out(name, differs):
    found = check(name)
    assert (found.exit_code, bool(found.differing), bool(found.failures)) == (3 if differs else 0, differs, False)
    if name == "Steady":
        did = found.behaviour
        assert did.mean_acceleration_mps2 == did.min_acceleration_mps2 == did.max_acceleration_mps2 == -1.5
        assert (did.reaction_s, did.braking_share, did.share_at_min) == (0.0, 1.0, 0.0)


def test_failures_are_counted_by_cause():
    found = check("Undefined")
    assert (found.exit_code, found.differing) == (3, ())
    assert all("nan" in cause for cause in found.failures)
    assert 0 < sum(found.failures.values()) <= 24


def test_a_controller_that_acts_early_is_checked_without_forcing():
    found = check("Steady", "av.before_cut_in=controller", "testing.method=nde")
    assert (found.method, found.exit_code) == ("step_mixture", 0)


def test_the_command_line(capfd):
    call = ["av-check", MIXTURE_FILE, "--episodes", "6"]
    assert main(call) == 0
    assert "speed.idm_us_per_step" in capfd.readouterr().out
    assert main([*call, "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["deterministic"] is True
    assert main([*call, "--set", "av={}", "--set", "av.controller=not_there:X"]) == 2
    assert "cannot be imported" in capfd.readouterr().err
    assert main([*call, "--set", EXITS]) == 3
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith(
        "error: av.controller\n  found:    the controller ended the worker process (exit code 7), in "
    )
    assert "of step" in err
