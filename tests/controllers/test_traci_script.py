"""A TraCI script runs as it is: each test is one run of it, and its bits are those of the same vehicle as a hook."""

import json
import re
import shutil
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from harness.campaign.files import load_campaign
from harness.cli import main
from harness.controllers.find import require_controller, tried_script
from harness.controllers.traci_style import TraciStyleController
from harness.errors import CampaignError
from harness.report.acted import script_words
from harness.resolved import resolve
from harness.sampling import prepare
from harness.worlds.sumo import SumoWorld
from harness.worlds.twin import TwinWorld
from tests.in_process import run_here
from tests.stored_runs import answer_in
from tests.worlds.running import drive, motion

SCRIPTS = Path(__file__).parent / "scripts"
FILES = (str(file.relative_to(SCRIPTS)) for file in SCRIPTS.rglob("*.py") if file.parent.name != "parts")
NAMES = sorted(file + ":main" * file.startswith("with_main") for file in FILES)


class BrakesWith(TraciStyleController):
    def __init__(self, hardest):
        self.hardest = hardest

    def on_step(self, traci, veh_id, time):
        leader = traci.vehicle.getLeader(veh_id)
        if leader is not None:
            closing = traci.vehicle.getSpeed(veh_id) - traci.vehicle.getSpeed(leader[0])
            traci.vehicle.setAcceleration(veh_id, -self.hardest if 4.0 * closing > leader[1] else 0.0, 0.1)


class Brakes(BrakesWith):
    """What each of the scripts is."""

    def __init__(self):
        super().__init__(4.0)


FORCED = "testing={method: forced}", "stop.rhw=null", "stop.below_reference=null", "records={moments: none}"
HOOK = "av={controller: 'tests.controllers.test_traci_script:Brakes'}"


def script(name, more=""):
    return f"av={{controller: '{SCRIPTS / name}'{more}}}"


@pytest.fixture(scope="module")
def of_the_hook():
    return motion(HOOK, n=30)


@pytest.mark.parametrize("name", NAMES)
def test_a_script_leaves_the_bits_of_the_hook(name, of_the_hook):
    assert motion(script(name), n=30) == of_the_hook


@pytest.mark.slow
@pytest.mark.parametrize("name", ["main_guard.py", "with_main.py:main", "several/several.py"])
def test_so_it_does_in_sumo(name, of_the_hook):
    with closing(SumoWorld(7)) as world:
        assert motion(script(name), n=30, world=world) == of_the_hook


def test_one_that_acts_from_the_start_does_so_as_a_script():
    early = ", before_event: controller}", "testing={method: step_mixture}", "environment.lane_change_level=350"
    hook, *more = (HOOK[:-1] + early[0], *early[1:])
    as_script = motion(script("plain.py")[:-1] + early[0], *more, n=30)
    assert as_script == motion(hook, *more, n=30)
    assert as_script != motion(script("plain.py"), *more, n=30)


def test_a_campaign_is_the_same_wherever_its_script_lies(tmp_path):
    shutil.copy(SCRIPTS / "plain.py", tmp_path)
    hashes = {load_campaign(str(folder / "plain.py")).content_hash("") for folder in (SCRIPTS, tmp_path)}
    named = load_campaign(str(SCRIPTS / "plain.py"), ["av.traci_style.ego=ego"])
    assert hashes != {named.content_hash("")}
    assert len(hashes) == 1


def test_parameters_are_options_of_a_script_and_arguments_of_a_function():
    hook = f"{HOOK[:-1]}, parameters: {{hardest: 2.0}}}}".replace("Brakes", "BrakesWith")
    for name in ("options.py", "with_main.py:main"):
        assert motion(script(name, ", parameters: {hardest: 2.0, ego: other}"), n=40) == motion(hook, n=40)


LOOP = """
traci.start(["sumo"])
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    leader = traci.vehicle.getLeader("ego")
    {body}
traci.close()
"""


def text(body, loop=LOOP):
    return "import sys, time, traci\n" + loop.replace("{body}", body)


NEVER_STEPS = "import traci\ntraci.start(['sumo'])\ntraci.vehicle.setSpeedMode('ego', 0)\n"
ENDLESS = "import traci\ntraci.vehicle.setSpeedMode('ego', 0)\nwhile True:\n    try:\n        traci.simulationStep()\n"
AT_THE_DOOR = {
    "commands no vehicle": text("traci.vehicle.getSpeed('ego')"),
    r"no speed or acceleration, .* a car cuts in, to ego.*leave out steps that only wait": text(
        "traci.vehicle.setSpeed('ego', 20.0)",
        LOOP.replace("while", "traci.vehicle.add('ego', 'r')\nfor _ in range(200): traci.simulationStep()\nwhile"),
    ),
    "commands ego and LV": text("traci.vehicle.setSpeed('ego', 20.0); traci.vehicle.setSpeed('LV', 20.0)"),
    "never calls simulationStep": NEVER_STEPS,
    r"ZeroDivisionError: division by zero \(my.py:7\)": text("traci.vehicle.setSpeed('ego', 1 / 0)"),
    "simulationStep is refused in a thread": (
        "import concurrent.futures, traci\ntraci.simulationStep()\n"
        "with concurrent.futures.ThreadPoolExecutor() as threads:\n    threads.submit(traci.simulationStep)\n"
    ),
    "goes on when its simulation has ended": f"{ENDLESS}    except Exception:\n        pass\n",
    r"no answer within 0.2 s .*construction_time_s\) \(my.py:8\)": text(
        "traci.vehicle.setSpeed('ego', 9.0)\n    while True: pass"
    ),
    r"traci has no trafficlight here; it has .*\(my.py:7\)": text(
        "traci.vehicle.setSpeed('ego', 9.0); traci.trafficlight.getIDList()"
    ),
    r"traci.vehicle has no getEmissionClass here: delete the line, or put in a value of your own \(my.py:7\)$": text(
        "traci.vehicle.setSpeed('ego', 9.0); traci.vehicle.getEmissionClass('ego')"
    ),
    r"Take out, or replace, vehicle.moveTo \(line 7\), edge.getIDList \(line 9\): docs": text(
        "traci.vehicle.setSpeed('ego', 9.0); traci.vehicle.moveTo('ego', 'e0_0', 1.0)\n\n    traci.edge.getIDList()"
    ),
    r"my.py:7\).*Fix the script in that line. Take out.*edge.getIDList \(line 9\).*it reads itself": text(
        "traci.vehicle.setSpeed('ego', 9.0); open('a.net.xml')\n\n    traci.edge.getIDList()"
    ),
    "'truck' is not known, or not seen yet: there are LV, BV, ego": text(
        "traci.vehicle.setSpeed('ego', 9.0); traci.vehicle.getSpeed('truck')"
    ),
    r"which is no Python.*invalid syntax in line 2": "import traci\ndef x(:\n",
    r"--step-length 0.25 is refused: steps here are 0.1 s.*\(my.py:3\)": text("").replace(
        '"sumo"', '"sumo", "--step-length", "0.25"'
    ),
    r"--step-length 0:00:01 is refused: steps here are 0.1 s.*\(my.py:3\)": text("").replace(
        '"sumo"', '"sumo", "--step-length=0:00:01"'
    ),
    "does not import traci.*Name its class or function: .*my.py:Mine": "class Mine:\n    def step(self, seen): ...\n",
}


@pytest.mark.parametrize("reason", AT_THE_DOOR)
def test_what_a_script_does_wrong_in_any_test_is_said_before_the_first(reason, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my.py").write_text(AT_THE_DOOR[reason], "utf-8")
    with pytest.raises(CampaignError) as caught:
        drive("av={controller: my.py}", "av.limits.construction_time_s=0.2")
    assert re.search(reason, caught.value.found if reason.endswith("$") else str(caught.value))
    assert "traci_style.ego" not in caught.value.mend or "step-length" not in reason


HELD = "av.traci_style.ego=ego"
IN_A_TEST = {
    r"step: ZeroDivisionError: division by zero \(my.py:7\)": text("if leader: print(1 / 0)"),
    r"step: ScriptError: the script returns after .*before the test has ended": text("if leader: break").replace(
        "traci.close()", ""
    ),
    r"step: RefusedError: traci.close is refused after .*\(my.py:8\)": text("if leader: break"),
    r"step: StepTimeoutError: no answer within 0.2 s .*\(my.py:[78]\)": text("while leader:\n        pass"),
    r"step: RefusedError: traci.vehicle.changeLane is refused: the AV stays.*\(my.py:8\)": text(
        "if leader:\n        try: traci.vehicle.changeLane('ego', 1, 5.0)\n        except traci.TraCIException: pass"
    ),
    r"step: AttributeError: traci.vehicle has no getTau here.*\(my.py:8\)": text(
        "if leader:\n        try: traci.vehicle.setAcceleration('ego', -traci.vehicle.getTau('ego'), 0.1)\n"
        "        except Exception: pass"
    ),
    r"step: asked for -\d+\.?\d* m/s2, outside of av.limits \(-15 to 10\) \(my.py:7\): .* mode 0, .* use mode 30": text(
        "if leader: traci.vehicle.setSpeedMode('ego', 0), traci.vehicle.setSpeed('ego', 0.0)"
    ),
}


@pytest.mark.parametrize("cause", IN_A_TEST)
def test_what_it_does_wrong_in_a_test_fails_it_with_the_line_and_no_other(cause, tmp_path):
    (tmp_path / "my.py").write_text(IN_A_TEST[cause], "utf-8")
    shard = drive(f"av={{controller: '{tmp_path}/my.py'}}", HELD, "av.limits.step_time_s=0.2", n=6)
    assert len(shard.failures) == 6
    for failure in shard.failures.values():
        assert re.match(cause, failure), failure


@pytest.mark.parametrize(("given", "hardest"), [((), -4.5), (("av.traci_style.decel_mps2=6",), -6.0)])
def test_bounds_are_those_of_its_vehicle_type(given, hardest, tmp_path):
    """By default of SUMO's."""
    (tmp_path / "my.py").write_text(text("if leader: traci.vehicle.setSpeed('ego', 0.0)"), "utf-8")
    shard = drive(f"av={{controller: '{tmp_path}/my.py'}}", *given, n=20)
    assert shard.failures == {}
    assert min(shard.traces[row][:-1, 2, 2].min() for row in range(20)) == hardest


PER_SECOND = """
traci.start(["sumo", "-c", "no.sumocfg", {option}])
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    if traci.simulation.getMinExpectedNumber() and traci.vehicle.getLeader("ego"):
        traci.vehicle.setSpeed("ego", max(0.0, traci.vehicle.getSpeed("ego") - 3.0))
        assert traci.simulation.getDeltaT() == {step_s}
"""


def test_a_step_of_the_script_is_as_long_as_it_asks_for(tmp_path):
    """What it does once a second it does once a second, and a command leads there in that time."""
    hardest = []
    (tmp_path / "a file.sumocfg").write_text('<c><time><step-length value="0.5"/></time></c>', "utf-8")
    (tmp_path / "damaged.sumocfg").write_text("<c", "utf-8")
    for option, step_s in (
        ('"--step-length", "1"', 1.0),
        ("'--step-length=0.5'", 0.5),
        (f"'-c', '{tmp_path}/a file.sumocfg'", 0.5),
        (f"'-c={tmp_path}/damaged.sumocfg', \"--no-warnings\"", 0.1),
    ):
        (tmp_path / "my.py").write_text(text("", PER_SECOND.format(option=option, step_s=step_s)), "utf-8")
        shard = drive(f"av={{controller: '{tmp_path}/my.py'}}", HELD, n=12)
        assert shard.failures == {}
        hardest.append(min(shard.traces[row][:-1, 2, 2].min() for row in range(12)))
        braking = shard.traces[0][:-1, 2, 2]
        begins = int(np.flatnonzero(braking < 0.0)[0])
        assert set(braking[begins : begins + round(10 * step_s)]) == {braking[begins]}
    assert hardest == pytest.approx([-3.0, -4.5, -4.5, -4.5], abs=1e-9)


def test_how_often_it_is_asked_is_what_it_asks_for_and_one_that_names_none_is_told_so_once(tmp_path, capsys):
    body, folder = text("traci.vehicle.setSpeed('ego', 20.0)"), tmp_path / "my.pyenv"
    folder.mkdir()
    (tmp_path / "my.sumocfg").write_text('<c><time><step-length value="0.2"/></time></c>', "utf-8")
    scripts = {
        "none.py": body,
        "some.py": body.replace('"sumo"', '"sumo", "--step-length=0.1"'),
        "cfg.py": body.replace('"sumo"', f'"sumo", "-c", "{tmp_path}/my.sumocfg"'),
        "named.py": "STEP = .2\n" + body.replace('"sumo"', '"sumo", "--step-length", str(STEP)'),
        "remark.py": "# --step-length 0.2\n" + body.replace('"sumo"', '"sumo", "--step-length=.1"'),
        "action.py": body.replace('"sumo"', '"sumo", "--default.action-step-length", "0.2", "--step-length", "0.1"'),
    }
    for name, script in scripts.items():
        (folder / name).write_text(script, "utf-8")
        for _ in range(2):
            assert tried_script(load_campaign(str(folder / name)).av).step_s == (
                0.2 if name in ("cfg.py", "named.py") else 0.1
            )
    note, *asked = capsys.readouterr().err.splitlines()
    assert note.startswith("note: none.py names no --step-length")
    # From 25 to 20 m/s in a step is more than SUMO's default type can.
    assert [each.split(" of", 1)[0] for each in asked] == [
        f"note: {name} asks for harder braking than 4.5 m/s², the decel" for name in ("none.py", *list(scripts)[1:])
    ]


@pytest.mark.parametrize(
    "bound", ["traci.vehicle.setDecel('ego', 9.0)", "traci.vehicle.setSpeedMode('ego', 0)", "given"]
)
def test_a_script_that_bounds_its_braking_itself_is_told_nothing_of_its_type(bound, tmp_path, capsys):
    body = text("traci.vehicle.setSpeed('ego', 20.0)").replace('"sumo"', '"sumo", "--step-length", "0.1"')
    own = f"traci.vehicle.setSpeed('ego', 20.0); {bound}" if bound != "given" else "traci.vehicle.setSpeed('ego', 20.0)"
    (tmp_path / "my.py").write_text(body.replace("traci.vehicle.setSpeed('ego', 20.0)", own), "utf-8")
    overrides = ["av.traci_style.decel_mps2=4.5"] if bound == "given" else []
    assert tried_script(load_campaign(str(tmp_path / "my.py"), overrides).av).step_s == 0.1
    told, loose = capsys.readouterr().err, "note: my.py sets a speed mode in which no decel bounds its braking"
    assert told.startswith(loose) if "SpeedMode" in bound else not told


@pytest.mark.parametrize(("steps", "told"), [(0, ""), (11, ""), (12, "looks at no vehicle in the first 1.1 s")])
def test_a_script_that_first_waits_is_told_that_each_test_begins_with_its_first_line(steps, told, tmp_path):
    waits = f"traci.vehicle.add('ego', 'r')\nfor _ in range({steps}): traci.simulationStep()\nwhile"
    keeps = "traci.vehicle.setSpeed('ego', traci.lane.getMaxSpeed(traci.vehicle.getLaneID('ego')))"
    body = text(keeps, LOOP.replace("while", waits)).replace('"sumo"', '"sumo", "--step-length", "0.1"')
    (tmp_path / f"my{steps}.py").write_text(body, "utf-8")
    tried = tried_script(load_campaign(str(tmp_path / f"my{steps}.py")).av)
    assert tried.step_s == 0.1
    assert told in (said := " ".join(script_words(tried._replace(safe_speeds=False)._asdict())))
    assert bool(told) == bool(said)


@pytest.mark.parametrize(("body", "mend"), [("", "the script itself"), ("def drive(): pass\n", r"my\.py:drive")])
def test_a_function_that_a_script_lacks_is_told_without_running_it(body, mend, tmp_path):
    (tmp_path / "my.py").write_text(f"import traci\n{body}raise RuntimeError\n", "utf-8")
    with pytest.raises(CampaignError, match=rf"no driv in .*my\.py; .*{mend}") as refused:
        require_controller(load_campaign(f"{tmp_path}/my.py:driv").av)
    assert "RuntimeError" not in str(refused.value)


def test_what_a_script_adds_to_the_path_ends_with_its_run(tmp_path):
    """After thousands of tests no process could be started with it, and tests counted as not reproducible."""
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib/own_speed.py").write_text("MPS = 20.0\n")
    path = f"import sys\nsys.path.append({str(tmp_path / 'lib')!r})\nimport own_speed\n"
    (tmp_path / "my.py").write_text(path + text("traci.vehicle.setSpeed('ego', own_speed.MPS)"), "utf-8")
    shard = drive(f"av={{controller: '{tmp_path}/my.py'}}", HELD, n=12)
    assert shard.failures == {}
    assert str(tmp_path / "lib") not in sys.path


def test_a_script_that_waits_for_most_of_a_test_is_refused_also_where_its_vehicle_is_named(tmp_path):
    waits = "for _ in range(200): traci.simulationStep()\nwhile"
    (tmp_path / "my.py").write_text(text("traci.vehicle.setSpeed('ego', 20.0)", LOOP.replace("while", waits)), "utf-8")
    with pytest.raises(CampaignError, match=r"looks at no vehicle for 1[45] s; .*leave out steps that only wait"):
        tried_script(load_campaign(str(tmp_path / "my.py"), ["av.traci_style.ego=ego"]).av)


@pytest.mark.parametrize(
    ("command", "left_s"),
    [
        ("traci.vehicle.setSpeed('ego', 20.0)", 0.0),
        ("traci.vehicle.setSpeed('ego', 20.0 if traci.simulation.getTime() < 6.0 else -1)", 9.0),
        ("if traci.simulation.getTime() < 0.2: traci.vehicle.slowDown('ego', 20.0, 1.0)", 10.0),
    ],
)
def test_a_script_that_leaves_the_vehicle_to_sumo_is_told_that_here_it_keeps_its_speed(command, left_s, tmp_path):
    body = text(command).replace('"sumo"', '"sumo", "--step-length", "0.1"')
    (tmp_path / "my.py").write_text(body, "utf-8")
    tried = tried_script(load_campaign(str(tmp_path / "my.py")).av)
    assert tried.left_s == pytest.approx(left_s, abs=2.0)
    said = list(script_words(tried._replace(safe_speeds=False)._asdict()))
    assert [f"gives no command for {tried.left_s:.1f} s behind" in words for words in said] == [True] * bool(left_s)


@pytest.mark.parametrize(("modes", "bounded"), [("", True), ("31", True), ("31 30", False), ("32", False)])
def test_a_script_that_sumos_safe_speeds_would_hold_back_is_told_that_here_they_do_not(modes, bounded, tmp_path):
    """A script that alone would never crash in SUMO may crash here."""
    sets = "\n    ".join(f"traci.vehicle.setSpeedMode('ego', {mode})" for mode in modes.split())
    drives = "traci.vehicle.setDecel('ego', 6.0)\n    traci.vehicle.setSpeed('ego', 20.0)"
    (tmp_path / "my.py").write_text(text(f"{sets or 'pass'}\n    {drives}"), "utf-8")
    tried = tried_script(load_campaign(str(tmp_path / "my.py")).av)
    assert (tried.safe_speeds, tried.accel_mps2, tried.decel_mps2) == (bounded, 2.6, 6.0)
    assert ["safe speeds would hold the" in words for words in script_words(tried._asdict())] == [True] * bounded


def test_a_stored_answer_is_the_same_when_the_script_has_gone_or_is_broken(tmp_path):
    file, asked = tmp_path / "my.py", ["world.engine=twin", *FORCED, "stop.episodes=40"]
    file.write_text(text("", PER_SECOND.format(option='"--step-length=1"', step_s=1.0)), "utf-8")
    run_here(load_campaign(f"{file}", asked), tmp_path / "run")
    told = answer_in(tmp_path / "run")
    assert told["parameters"] == [["type", "accel 2.6, decel 4.5, minGap 0"], ["step", "1 s"]]
    assert "BV’s getLateralLanePosition < 0 shows it" in "".join(told["warnings"])
    file.write_bytes(b"\xff")
    assert answer_in(tmp_path / "run") == told
    file.unlink()
    assert answer_in(tmp_path / "run") == told


def test_its_end_is_that_of_sumo(tmp_path, monkeypatch):
    """No vehicle is left, then an error; what stands behind the loop runs once a test."""
    monkeypatch.chdir(tmp_path)
    left = """
ends = []
try:
    while True:
        traci.simulationStep()
        ends.append((traci.simulation.getMinExpectedNumber(), traci.vehicle.getIDCount()))
        if ends[-1][1]: traci.vehicle.setSpeedMode("ego", 0)
except traci.exceptions.FatalTraCIError as error:
    with open("ends.txt", "a") as file: file.write(f"{ends[0]} {ends[-2]} {ends[-1]} {error}\\n")
    assert traci.simulation.getArrivedIDList() == ("LV", "BV", "ego")
    traci.close()
"""
    (tmp_path / "my.py").write_text(text("", left), "utf-8")
    assert motion(f"av={{controller: '{tmp_path}/my.py'}}", HELD, n=9, cells=4)
    lines = (tmp_path / "ends.txt").read_text("utf-8").splitlines()
    assert lines == ["(3, 3) (3, 3) (0, 0) Connection closed by SUMO."] * 9


def test_what_imports_traci_is_a_script_and_its_settings_need_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("script.py").write_text("def run():\n    import libsumo.constants as tc, os\n", "utf-8")
    campaign = load_campaign("script.py")
    assert (campaign.name, campaign.av.controller) == ("script", str(tmp_path / "script.py"))
    with pytest.raises(CampaignError, match=r"av\.traci_style.*it only beside a controller"):
        load_campaign("idm", ["av.traci_style.ego=ego"])


@pytest.mark.parametrize(("name", "engine"), [("main_guard.py", "sumo"), ("remembers.py", "twin")])
@pytest.mark.slow
def test_from_the_command_line_with_workers_of_its_own_resumed_and_repeated(name, engine, tmp_path):
    short = [f"--set={each}" for each in (*FORCED, f"world.engine={engine}", "run.shard_size=40")]
    run = ["run", str(SCRIPTS / name), "--out", str(tmp_path / "run"), "--quiet", *short]
    assert main([*run, "--workers", "2", "--set=stop.episodes=80"]) in (0, 4)
    assert main([*run, "--workers", "1", "--set=stop.episodes=120", "--resume"]) in (0, 4)
    hook = ["run", "tests.controllers.test_traci_script:Brakes", "--out", str(tmp_path / "hook"), "--quiet", *short]
    assert main([*hook, "--set=stop.episodes=120"]) in (0, 4)
    of_both = [pq.read_table(tmp_path / each / "episodes").sort_by("episode") for each in ("run", "hook")]
    assert of_both[0].equals(of_both[1])
    assert of_both[0].num_rows == 120
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text("utf-8"))
    assert manifest["repeated"]["n_episodes"] > 1
    assert manifest["repeated"]["differing"] == []


def test_where_there_is_no_other_vehicle_no_name_of_one_is_there(tmp_path):
    (tmp_path / "my.py").write_text(text("assert set(traci.vehicle.getIDList()) == {'LV', 'ego'}"), "utf-8")
    changes = [*FORCED, "scenario=lead_brakes", "world.engine=twin", HELD]
    ready = prepare(resolve(load_campaign(str(tmp_path / "my.py"), changes)))
    with closing(ready.loop(TwinWorld(8, ready.scenario.vehicles))) as loop:
        assert loop.run(0, ready.tests(0, 20)).failures == {}
