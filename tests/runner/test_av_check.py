"""`av-check` and the tests that a run repeats: each fault is seen, and a good vehicle passes."""

from __future__ import annotations

import datetime
import math
import os
import re
import resource
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from harness.campaign.files import load_campaign
from harness.cli import main
from harness.errors import CampaignError
from harness.records.folder import read_manifest
from harness.report.av_check import cause, rows, verdict
from harness.runner.look import check_av
from harness.runner.stored import changed_since, replay_episode
from tests.in_process import run_here, run_with_workers
from tests.stored_runs import answer_in, copy_of, edit, sets
from tests.worlds.running import ROOT

MIXTURE_FILE, FORCED = (str(ROOT / f"scenarios/overtaking_{name}.yaml") for name in ("mixture", "forced"))
EXITS = "av={controller: 'tests.controllers.misbehaving:Misbehaving', parameters: {bad: {'2': ends_the_process}}}"


class Steady:
    """Brakes alike at all times."""

    def start(self, episode):
        self.random = episode.random

    def step(self, seen):
        return -1.5

    def close(self): ...


class Waits(Steady):
    """Brakes for who is on its lane."""

    def step(self, seen):
        return -1.5 if seen.gap_m < 80.0 else 0.0


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


class Sharing(Steady):
    """Brakes by how many there are."""

    all_of_them = set()

    def start(self, episode):
        self.all_of_them.add(id(self))

    def step(self, seen):
        return -0.01 * len(self.all_of_them)

    def close(self):
        self.all_of_them.discard(id(self))


CLOCKS = {
    "monotonic": (lambda: 1.0 * time.monotonic(), "time.monotonic"),
    "strftime": (lambda: float(time.strftime("%Y%j%H")), "time.time"),
    "clock_gettime_ns": (lambda: time.clock_gettime_ns(time.CLOCK_MONOTONIC) / 1e9, "time.clock_gettime"),
    "now": (lambda: datetime.datetime.now().minute / 60.0, "time.time"),
    "times": (lambda: os.times().user + resource.getrusage(resource.RUSAGE_SELF).ru_utime, "os.times"),
}
"""And as what each is told."""


class KeepsItsAnswer(Steady):
    """As PID controllers of packages do, it computes nothing anew within 10 ms."""

    def __init__(self, clock):
        self.now = CLOCKS[clock][0]

    def start(self, episode):
        self.at = -1.0

    def step(self, seen):
        if (now := self.now()) > self.at + 0.01:
            self.at, self.answer = now, -0.01 * seen.bv.speed_mps
        return self.answer


class LooksAtTheClock(Steady):
    """It does nothing with it, but for a library whose compiled modules know how a datetime lies in memory."""

    def step(self, seen):
        import pandas

        assert isinstance(pandas.Timestamp(datetime.datetime.now()), datetime.datetime)
        assert issubclass(pandas.Timestamp, datetime.datetime)
        return super().step(seen) + 0.0 * time.perf_counter_ns()


class OfItsProcess(Steady):
    def step(self, seen):
        return -1e-6 * (os.getpid() % 1000)


class Ages(Steady):
    n_steps = 0

    def step(self, seen):
        Ages.n_steps += 1
        return -1e-6 * min(Ages.n_steps, 500)


class HashesAText(Steady):
    def step(self, seen):
        return -1e-6 * (hash("BV") % 1000)


class WindsUp(Steady):
    """Has an integral without a bound."""

    def __init__(self, bound=math.inf):
        self.bound = bound

    def start(self, episode):
        self.integral = 0.0

    def step(self, seen):
        self.integral = min(max(self.integral + 0.1 * (40.0 - seen.speed_mps), -self.bound), self.bound)
        return -3.0 + 0.02 * self.integral


class Slow(Steady):
    def __init__(self):
        time.sleep(0.15)


class LoadsOnce(Steady):
    @staticmethod
    def load():
        time.sleep(0.15)

    def __init__(self, loaded): ...


def check(name, *overrides):
    controller = name if ":" in name else f"{__name__}:{name}"
    return check_av(load_campaign(MIXTURE_FILE, ["av={}", f"av.controller={controller}", *overrides]), 24)


def test_the_built_in_idm_is_fine():
    found = check_av(load_campaign(MIXTURE_FILE), 24)
    assert (found.exit_code, found.engine, found.method) == (0, "twin", "forced")
    assert found.behaviour.n_events == 24
    assert found.behaviour.min_acceleration_mps2 == found.limits_mps2[0] == -4.0
    assert 0.0 < found.behaviour.share_at_min < 1.0


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("Steady", ""),
        pytest.param("Noisy", "", marks=pytest.mark.slow),
        ("tests.controllers.misbehaving:Global", "random numbers of its own"),
        pytest.param("Remembering", "it remembers the last one", marks=pytest.mark.slow),
        pytest.param("Sharing", "they share something", marks=pytest.mark.slow),
        pytest.param("LooksAtTheClock", "", marks=pytest.mark.slow),
        *(
            pytest.param(f"KeepsItsAnswer {clock}", f"on the clock ({told}, test_av_check.py:", marks=pytest.mark.slow)
            for clock, (_, told) in CLOCKS.items()
        ),
        pytest.param("OfItsProcess", "It differs from process to process: ", marks=pytest.mark.slow),
        pytest.param("HashesAText", "It differs from process to process: ", marks=pytest.mark.slow),
        ("Ages", "what earlier tests have left in a variable of its module or class"),
    ],
)
def test_a_controller_that_is_not_reproduced_is_found_out(name, why):
    name, *clock = name.split()
    found, differs = check(name, *(f"av.parameters.clock={each}" for each in clock)), bool(why)
    assert why in cause(found)
    assert (found.exit_code, bool(found.differing), bool(found.failures)) == (3 if differs else 0, differs, False)
    if name == "Steady":
        did = found.behaviour
        assert did.mean_acceleration_mps2 == did.min_acceleration_mps2 == did.max_acceleration_mps2 == -1.5
        assert (did.reaction_s, did.braking_share, did.share_at_min) == (0.0, 1.0, 0.0)


@pytest.mark.slow
def test_a_seed_that_python_is_given_for_hashes_hides_none():
    command = [sys.executable, "-m", "harness", "av-check", f"{__file__}:HashesAText", "--tests", "6"]
    variables = {**os.environ, "PYTHONHASHSEED": "0"}
    done = subprocess.run(
        [*command, *sets("world.engine=twin")], env=variables, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, "It differs from process to process" in " ".join(done.stdout.split())) == (3, True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "moves"),
    [
        ((), {0.0: 0.0, 20.0: 1.0}),
        (("av.parameters.bound=1",), {}),
        (("av.before_event=controller", "testing.method=nde"), None),
    ],
    ids=["winds up", "is bounded", "acts early"],
)
def test_what_winds_up_in_a_longer_warm_up_is_seen(overrides, moves):
    found = check("WindsUp", *overrides)
    assert found.exit_code == 0
    assert ("LOOK AGAIN" in verdict(found) and "winds up" in verdict(found)) == bool(moves)
    assert set(found.moved_mps2) == (set() if moves is None else {0.0, 20.0})
    assert all(moved < 0.5 for seconds, moved in found.moved_mps2.items() if not moves or seconds == 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Slow", "LoadsOnce"])
def test_a_slow_constructor_is_measured_and_counted(name):
    found = check(name, "world.cells=8")
    assert found.speed.constructions == 8
    assert (found.speed.construction_s > 0.1, "calls it 8 times" in verdict(found)) == (name == "Slow",) * 2
    few = replace(found, n_episodes=48, behaviour=replace(found.behaviour, braking_share=1.0))
    assert "(a fault in fewer than 1 of 21, or only on the rare, hard" in verdict(few)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "late"), [("Waits", True), ("Steady", False)])
def test_a_vehicle_that_waits_for_the_overlap_is_told_so(name, late):
    found = check_av(load_campaign(f"{__name__}:{name}", ["world.engine=twin"]), 6)
    assert (found.shows, "bv_lateral_m > 0 shows it earlier" in verdict(found)) == (True, late)
    assert verdict(found).startswith("READY") == late  # the other one brakes with nobody ahead
    eager = replace(found, behaviour=replace(found.behaviour, n_asked_to_speed_up=1))
    assert ("But in 1 test it asked to speed up before BV was in its lane" in verdict(eager)) == late


def test_the_command_line(capfd):
    call = ["av-check", MIXTURE_FILE, "--tests", "6"]
    assert main(call) == 0
    out = capfd.readouterr().out
    assert re.search(r"built-in IDM +[│┃]\n", out)
    assert re.match(r"READY: 6 tests twice, the same bits; it braked after \d+% of \d+ cut-ins", out)
    assert re.search(r"it takes \d+(\.\d+)? µs a step\.", " ".join(out.split()))
    (mean,) = re.findall(r"mean acceleration, m/s² +│ +(\S+) +│ +(\S+) +│", out)
    assert mean[0] == mean[1]  # it is the built-in IDM
    assert re.search(r"tests that failed +│ none", out)
    assert "_" not in out
    assert "{}" not in out
    assert main([*call, "--set", EXITS]) == 3
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("error: av.controller\n  found:    the controller ended the worker process (exit code 7)\n")


@pytest.mark.parametrize(
    ("av", "code"),
    [
        pytest.param("{sumo: {carFollowModel: EIDM}}", 0, id="SUMO's EIDM", marks=pytest.mark.slow),
        pytest.param("{traci: {command: 'false', connect_time_s: 5, restarts: 0}}", 3, id="a program that dies"),
    ],
)
def test_it_sees_that_each_form_brakes_and_is_deterministic_or_fails(av, code):
    found = check_av(load_campaign(FORCED, [f"av={av}"]), 6)
    assert (found.exit_code, sum(found.failures.values())) == (code, 6 * bool(code))
    if code == 0:
        assert found.behaviour.n_events == 6
        assert found.behaviour.min_acceleration_mps2 < -1.0


# -- a run repeats some of its own tests, and replay knows --


SMALL = ("world.engine=twin", "stop.rhw=null", "stop.episodes=400", "run.shard_size=100", "records.traces=none")
GLOBAL = "{controller: 'tests.controllers.misbehaving:Global'}"


@pytest.fixture
def run_av(tmp_path):
    def run_one(av, *overrides, name="run", run=run_here, **options):
        return run(load_campaign(FORCED, [*SMALL, f"av={av}", *overrides]), tmp_path / name, **options).folder

    return run_one


@pytest.mark.parametrize("name", ["shells-controller-twin", "forced-batch", "forced-krauss", "forced-traci-style"])
def test_a_vehicle_that_does_the_same_again_is_said_to(name, stored_run):
    manifest = read_manifest(stored_run(name))
    assert (manifest["repeated"]["differing"], manifest["reproducible"]) == ([], True)
    assert manifest["repeated"]["n_episodes"] > 5


@pytest.mark.slow
def test_a_vehicle_that_does_not_is_found_out_for_any_number_of_workers_and_after_a_resume(run_av, tmp_path):
    folders = [run_av(GLOBAL, name="1"), run_av(GLOBAL, name="2", run=run_with_workers, workers=2)]
    one, two = (read_manifest(folder) for folder in folders)
    assert one["repeated"] == two["repeated"]
    assert len(one["repeated"]["differing"]) == one["repeated"]["n_episodes"] == 20
    assert (one["reproducible"], two["reproducible"]) == (False, False)
    warnings = answer_in(folders[0])["warnings"]
    assert any(told.startswith("NOT REPRODUCIBLE: 20 of 20 tests") for told in warnings)
    with pytest.raises(CampaignError, match="20 of the 20 tests that it ran twice differed"):
        replay_episode(folders[0], 3)
    copied = copy_of(folders[0], tmp_path / "copy")
    run_av(GLOBAL, "stop.episodes=500", name=copied.name, resume=True)
    longer = read_manifest(copied)
    assert (longer["repeated"], longer["reproducible"], longer["n_episodes"]) == (one["repeated"], False, 500)


def test_a_vehicle_that_differs_later_on_is_found_by_what_repeats_later_tests(run_av):
    repeated = read_manifest(run_av(GLOBAL.replace("Global", "Tires"), run=run_with_workers, workers=1))["repeated"]
    assert repeated["n_episodes"] == 20
    assert all(episode >= 150 for episode in repeated["differing"])
    assert len(repeated["differing"]) == 10


def test_a_replay_that_differs_names_what_it_knows(stored_run, tmp_path):
    folder = copy_of(stored_run("shells-controller-twin"), tmp_path / "run")
    manifest = read_manifest(folder)
    (folder / "estimates.json").unlink()
    edit(folder, repeated=None)
    assert replay_episode(folder, 3).changed is None
    campaign = load_campaign(folder / "campaign.yaml")
    assert "the vehicle does not do the same again" in changed_since(manifest, campaign)
    assert "made of, has been changed" in changed_since({**manifest, "controller_sha256": "0"}, campaign)
    assert "CPU Z80 (here" in changed_since({**manifest, "cpu": "Z80"}, campaign)


@pytest.mark.slow
def test_a_controller_that_acts_early_is_checked_without_forcing():
    found = check("Steady", "av.before_event=controller", "testing.method=nde")
    assert (found.method, found.exit_code) == ("step_mixture", 0)


def test_of_a_vehicle_that_follows_it_is_said_how():
    """IDM keeps 1 s and some metres to a vehicle of its own speed; words are the scenario's."""
    found = check_av(load_campaign("idm", ["scenario=cut_out"]), 6)
    assert found.follows == found.idm_follows
    assert 1.0 < found.follows.headway_s < 2.0
    assert found.follows.smallest_gap_m > 10.0
    assert found.follows.n_hit == 0
    assert found.moved_mps2 == {}
    told = [row["what"] for row in rows(found)]
    assert found.events in told
    assert "headway at the onset, median, s" in told
    assert "cut-in" not in " ".join(told)
    lags = replace(found, follows=replace(found.follows, headway_s=9.0))
    early = replace(found, shows=True, behaviour=replace(found.behaviour, n_braked_before=3))
    faint = replace(found, behaviour=replace(found.behaviour, min_acceleration_mps2=-0.9))
    said = (
        "when the event begins it is 9.0 s",
        "in 3 tests it braked with nobody ahead",
        "it never braked with 1 m/s² or",
    )
    for each, text in zip((lags, early, faint), said, strict=True):
        assert verdict(each).startswith(f"LOOK AGAIN: {text}")
    script = check_av(load_campaign("tests/controllers/scripts/plain.py", ["scenario=cut_out"]), 6)
    assert script.limits_mps2 == (-4.5, 2.6)  # those of SUMO's default type
    never_brakes = "av={model: constant, parameters: {acceleration_mps2: 2}}"
    blind = check_av(load_campaign("idm", ["scenario=cut_out", never_brakes]), 6)
    assert blind.follows.headway_s > found.follows.headway_s  # it does nothing before the event
