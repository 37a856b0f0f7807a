"""Cut-outs too mild to count: how many there are, and that crashes on them are said, and accept nothing."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from contextlib import nullcontext

import numpy as np
import pytest

import harness
from harness.cli import main
from harness.families import family_named
from harness.families.following.approach import starts_from
from harness.families.following.family import MILDEST_MPS2, N_SPEEDS
from harness.families.protocol import Paths
from harness.records.folder import read_manifest
from harness.runner.stored import estimate_run
from harness.sampling.paths import beyond_scope
from tests.families.roads import SETTINGS, traffic_of
from tests.families.test_same_bits import SMALL
from tests.in_process import controllers_here, one_process, run_here, without_page

CUT_OUT = family_named("cut_out")
AV = """
import math


class MyAV:
    '''An adaptive cruise control that brakes with 3.0 m/s² at most.'''

    def step(self, seen):
        cruise = 0.4 * (40.0 - seen.speed_mps)
        if math.isinf(seen.gap_m):
            return cruise
        closes = 0.23 * (seen.gap_m - 5.0 - 1.1 * seen.speed_mps) + 0.07 * (seen.lead_speed_mps - seen.speed_mps)
        return max(-3.0, min(closes, cruise, 2.0))


class Fails(MyAV):
    def start(self, episode):
        if episode.episode == 3:
            raise RuntimeError("no")


class Rams(MyAV):
    def start(self, episode):
        self.sleeps = episode.episode % 5 == 0

    def step(self, seen):
        return 3.0 if self.sleeps else max(super().step(seen), -8.0)
"""


def test_their_rate_is_a_sum_over_the_grid():
    """By the condition of families' text, dv² ≥ 2 a (τ dv + 1 s · v), at each speed; scopes add up, with ends exact."""
    parameters = CUT_OUT.parameters(SETTINGS)
    traffic = CUT_OUT.traffic(SETTINGS, parameters)
    mild, wide = CUT_OUT.milder(traffic), traffic_of("cut_out", {"leaving__scope_mps2": MILDEST_MPS2})
    u = (np.arange(N_SPEEDS) + 0.5) / N_SPEEDS
    v = starts_from(traffic.numbers, np.column_stack((u, u)))["speed_mps"]  # a scope at the onset: no test drives yet
    paths = Paths(np.arange(N_SPEEDS), np.zeros(N_SPEEDS, starts_from(traffic.numbers, np.zeros((1, 2))).dtype))
    paths.start["speed_mps"] = v
    chosen = CUT_OUT.choose(traffic, 0, paths, np.full(N_SPEEDS, -1))
    at_onset = chosen.facts["lead_speed_mps"][:, None]
    closing = (1.0 - traffic.grid["ratio"]) * at_onset
    needs = closing**2 / (2.0 * (traffic.grid["ttc_s"] * closing + at_onset))
    expected = (traffic.share * ((needs >= MILDEST_MPS2) & (needs < 2.0))).sum(1).mean()
    found = CUT_OUT.exposure(mild, parameters).per_hour
    assert found == pytest.approx(expected, rel=1e-12)
    assert found == pytest.approx(0.10, abs=0.005)
    both = CUT_OUT.exposure(traffic, parameters).per_hour + found
    assert CUT_OUT.exposure(wide, parameters).per_hour == pytest.approx(both, rel=1e-12)
    assert CUT_OUT.milder(wide) is None
    lead = family_named("lead_brakes")
    assert lead.milder(lead.traffic(SETTINGS)) is None


def gate(tmp_path, vehicle, scenario="cut_out", page=without_page):
    """Folder, JUnit file and exit code of a limit that is far above the rate of cut-outs in scope."""
    small = [f"--set={each}" for each in (*SMALL, "world.engine=twin", "stop.episodes=600")]
    out, junit = tmp_path / "run", tmp_path / "gate.xml"
    asked = ["--scenario", scenario, "--accept", "0.9", "--out", str(out), "--junit", str(junit)]
    with one_process(), controllers_here(), page():
        return out, junit, main(["run", vehicle, *asked, *small])


def test_a_vehicle_that_crashes_on_them_is_told_so_and_not_accepted(tmp_path, capsys):
    """It brakes with 3 m/s² at most; a limit far above its rate is kept, and yet it does not pass."""
    (tmp_path / "my_av.py").write_text(AV)
    out, junit, code = gate(tmp_path, f"{tmp_path}/my_av.py:MyAV", page=nullcontext)
    told, estimates = capsys.readouterr().out, json.loads((out / "estimates.json").read_text())
    n = estimates["milder"]["n_crashes"]
    assert 3 < n < 36 == estimates["milder"]["n_tests"]
    assert code == 4
    assert estimates["decision"]["verdict"] == "undecided"
    assert estimates["decision"]["high"] < 0.9
    assert "yet not accepted, see !" in ET.parse(junit).getroot().find(".//error").get("message")
    assert "stopped: rate below the limit" in told
    for text in (told, ET.parse(junit).getroot().find(".//error").text):
        assert f"{n} of 36 MILDER cut-outs end in a crash, too" in " ".join(text.split())
    assert "MILDER" in (out / "report.html").read_text()
    driven = read_manifest(out)["before"]["milder"]
    assert (driven.n_episodes, (out / driven.files["milder"].path).exists()) == (36, True)
    assert estimate_run(out)["milder"] == estimates["milder"]


def test_one_that_does_not_do_the_same_again_is_not_accepted(tmp_path, capsys):
    out, _, code = gate(tmp_path, "tests.controllers.misbehaving:Global")
    decision = json.loads((out / "estimates.json").read_text())["decision"]
    assert (code, decision["verdict"], decision["n_milder"]) == (4, "undecided", 0)
    assert decision["high"] < 0.9
    assert decision["n_differing"] > 0
    told = capsys.readouterr().out
    assert "! NOT REPRODUCIBLE: " in told
    assert "yet not accepted, see !" in told


def test_one_that_does_not_is_not_told_of_them(tmp_path, capsys):
    out, _, code = gate(tmp_path, "idm")
    assert code == 0
    assert "MILDER" not in capsys.readouterr().out
    assert json.loads((out / "estimates.json").read_text())["milder"]["n_crashes"] == 0


@pytest.mark.parametrize("scenario", ["lead_brakes", "cut_out"])
def test_one_that_crashes_without_an_event_is_told_so_and_not_accepted(scenario, tmp_path, capsys):
    """Every fifth test ends in the vehicle ahead before that brakes or leaves; the rate is far below the limit."""
    (tmp_path / "my_av.py").write_text(AV)
    out, _, code = gate(tmp_path, f"{tmp_path}/my_av.py:Rams", scenario)
    estimates = json.loads((out / "estimates.json").read_text())
    n = estimates["diagnostics"]["n_crashes_before_event"]
    assert 0 < n == -(-estimates["n_episodes"] // 5)
    assert f"{n} tests crashed BEFORE the event" in " ".join(capsys.readouterr().out.split())
    assert (code, estimates["decision"]["verdict"]) == (4, "undecided")
    assert estimates["decision"]["high"] < 0.9


@pytest.mark.slow
def test_one_that_makes_the_events_milder_itself_is_told_so_and_not_accepted(tmp_path, capsys):
    """By falling behind the vehicle ahead: beside the competent driver, too, that is said at once."""
    out, _, code = gate(tmp_path, "tests.families.test_controllers:Lags", "lead_brakes")
    estimates = json.loads((out / "estimates.json").read_text())
    assert (code, estimates["decision"]["verdict"]) == (4, "undecided")
    assert estimates["decision"]["n_milder"] == estimates["diagnostics"]["n_fell_behind"] > 100
    told = " ".join(capsys.readouterr().out.split())
    assert "yet not accepted, see !" in told
    assert "it never braked with 1 m/s² or more (below 0): does it see the other vehicle?" in told


@pytest.mark.slow
def test_one_that_fails_is_told_and_the_run_goes_on(tmp_path):
    """A thirty-sixth is more than may fail of tests that count; here it speaks against the vehicle as a crash does."""
    (tmp_path / "my_av.py").write_text(AV)
    asked = (*SMALL, "scenario=cut_out", "world.engine=twin", "stop.rhw=null", "stop.episodes=300")
    run = run_here(harness.load_campaign(f"{tmp_path}/my_av.py:Fails", [*asked]), tmp_path / "run")
    milder = run.estimates["milder"]
    assert milder["n_failed"] == 1
    assert beyond_scope(milder) == milder["n_crashes"] + 1
    assert f"{beyond_scope(milder)} of 36 MILDER cut-outs end in a crash or FAIL" in " ".join(repr(run).split())
