"""`av-check` with good and bad controllers: each fault is seen, and a good one passes."""

import json
from pathlib import Path

import pytest

from harness.campaign.files import load_campaign
from harness.cli import main
from harness.runner.look import check_av

MIXTURE_FILE = str(Path(__file__).parents[2] / "scenarios/overtaking_mixture.yaml")
CONTROLLERS = '''
import os
import random


class Base:
    def start(self, episode):
        self.random = episode.random

    def step(self, observation):
        return -1.5

    def close(self):
        pass


class Steady(Base):
    """Brakes alike at all times."""


class Noisy(Base):
    """Random, but from the stream that it is given."""

    def step(self, observation):
        return -self.random.random()


class Global(Base):
    """Random from a stream of its own."""

    def step(self, observation):
        return -random.random()


class Remembering(Base):
    """Brakes harder from episode to episode."""

    seen = 0

    def start(self, episode):
        self.seen += 1

    def step(self, observation):
        return -0.01 * self.seen


class Exits(Base):
    """Ends the process in its third step."""

    calls = 0

    def step(self, observation):
        self.calls += 1
        if self.calls == 3:
            os._exit(1)
        return 0.0


class Undefined(Base):
    def step(self, observation):
        return float("nan") if observation.speed_mps > 30.0 else -1.0
'''


@pytest.fixture
def check(tmp_path, monkeypatch):
    (tmp_path / "checked_controllers.py").write_text(CONTROLLERS)
    monkeypatch.syspath_prepend(str(tmp_path))

    def check_one(name, *overrides):
        source = ["av={}", f"av.controller=checked_controllers:{name}"] if name else []
        return check_av(load_campaign(MIXTURE_FILE, [*source, *overrides]), 24)

    return check_one


def test_the_built_in_idm_is_fine(check):
    found = check(None)
    assert found.exit_code == 0
    assert (found.engine, found.method) == ("twin", "forced")
    assert found.behaviour.n_cut_ins == 24
    assert found.behaviour.min_acceleration_mps2 == found.limits_mps2[0] == -4.0
    assert 0.0 < found.behaviour.share_at_min < 1.0


@pytest.mark.parametrize("name", ["Steady", "Noisy"])
def test_a_controller_that_keeps_to_its_stream_is_deterministic(check, name):
    found = check(name)
    assert found.exit_code == 0
    assert found.differing == ()
    assert found.limits_mps2 == (-15.0, 10.0)


def test_what_it_did_is_told(check):
    found = check("Steady").behaviour
    assert found.mean_acceleration_mps2 == found.min_acceleration_mps2 == found.max_acceleration_mps2 == -1.5
    assert (found.reaction_s, found.braking_share, found.share_at_min) == (0.0, 1.0, 0.0)


@pytest.mark.parametrize("name", ["Global", "Remembering"])
def test_a_controller_that_is_not_reproduced_is_found_out(check, name):
    found = check(name)
    assert found.differing
    assert not found.failures
    assert found.exit_code == 3


def test_failures_are_counted_by_cause(check):
    found = check("Undefined")
    assert found.exit_code == 3
    assert all("nan" in cause for cause in found.failures)
    assert 0 < sum(found.failures.values()) <= 24
    assert found.differing == ()


def test_a_controller_that_acts_early_is_checked_without_forcing(check):
    found = check("Steady", "av.before_cut_in=controller", "testing.method=nde")
    assert found.method == "step_mixture"
    assert found.exit_code == 0


def test_the_command_line(check, capsys):
    assert main(["av-check", MIXTURE_FILE, "--episodes", "6"]) == 0
    out = capsys.readouterr().out
    assert "deterministic" in out
    assert "speed.idm_us_per_step" in out
    assert main(["av-check", MIXTURE_FILE, "--episodes", "6", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["deterministic"] is True
    assert main(["av-check", MIXTURE_FILE, "--set", "av={}", "--set", "av.controller=not_there:X"]) == 2
    assert "cannot be imported" in capsys.readouterr().err


def test_a_controller_that_ends_the_process_is_told(check, tmp_path, capfd):
    arguments = ["--set", "av={}", "--set", "av.controller=checked_controllers:Exits", "--episodes", "6"]
    assert main(["av-check", MIXTURE_FILE, *arguments]) == 3
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith(
        "error: av.controller\n  found:    the controller ended the worker process (exit code 1), in "
    )
    assert "of step" in err
