"""Loading a campaign: every mistake is named with YAML path and line, several at once; --set and --av are laid over."""

import json
import pickle
import re
import shutil
from pathlib import Path

import jsonschema
import pytest
import yaml

from harness.campaign.campaign import Campaign
from harness.campaign.drivers import IDMParameters, Surrogate
from harness.campaign.files import QUICK, load_campaign, load_panel, schema_text
from harness.campaign.models import read_model
from harness.campaign.vehicle import AutomatedVehicle
from harness.cli import main
from harness.errors import EXIT_BAD_INPUT, CampaignError
from harness.families.cut_in.parameters import SHIPPED_FOLDER, EnvironmentParameters


@pytest.fixture
def load(tmp_path):
    def load_text(text, *overrides, **options):
        file = tmp_path / "bad.yaml"
        file.write_text("name: bad\n" + text)
        return load_campaign(file, overrides, **options)

    return load_text


MISTAKES = (
    ("stop: {confidence: 95}", "stop.confidence", 2, "less than or equal to 0.999999999. Write confidence: 0.95."),
    ("stop: {rhw: 30 %}", "stop.rhw", 2, "Write 0.3."),
    ("testin:\n  epsilon: 0.2", "testin", 2, "Did you mean 'testing'?"),
    ("av:\n  reaction: {delay: 0.5}", "av.reaction.delay", 3, "Did you mean 'delay_s'?"),  # its unit is left out
    ("epsilon: 0.2", "epsilon", 2, "belongs under testing"),
    ("testing: 5", "testing", 2, "a section with keys such as method"),
    ("stop: 100", "stop", 2, "a section with keys such as episodes"),
    ("accept: r157-cc", "accept", 2, "crash_rate_below, times_reference. Write {times_reference: {driver: r157-cc}}"),
    ("scenarios: all", "scenarios", 2, "a list"),
    ("exposure: 3", "exposure", 2, "names, each with its value"),
    ("av: my_av.py:MyAV", "av", 2, "Write {controller: my_av.py:MyAV} or {model: r157-cc} there."),
    ("av:\n  limits: {max_braking_mps2: 8}", "av.limits.max_braking_mps2", 3, "Did you mean 'min_acceleration_mps2'?"),
    ("av:\n  limits: {min_acceleration_mps2: 8}", "av.limits.min_acceleration_mps2", 3, "min_acceleration_mps2: -8."),
    ("world:", "world", 2, "delete the key for its default"),
    ("stop:\n  rhw: 10", "stop.rhw", 3, "less than 10, or null"),
    ("stop:\n  rhw: 1e-320", "stop.rhw", 3, "0.0001, or null"),
    ("stop:\n  confidence: 1e-16", "stop.confidence", 3, "0.01"),
    ("testing:\n  epsilon: 0", "testing.epsilon", 3, "what no surrogate crashes on would never be drawn"),
    ("surrogates:\n  A:\n    parameters: {}", "surrogates.A.model", 3, "no such key"),
    ("surrogates:\n  a.b: {model: idm}", "surrogates.a.b", 3, "another name"),
    ("av:\n  controller: my module", "av.controller", 3, "text such as my_av.py:MyClass"),
    ("av:\n  sumo:\n    carFollowModel: ACC\n    minGap: true", "av.sumo.minGap", 5, "text or a number"),
    ("av:\n  traci: {command: ''}", "av.traci.command", 3, "starts the program"),
)
"""Which an editor's schema refuses, too."""
BROKEN_RULES = (
    ("av:\n  model: fvdm\n  parameters: {time_headway_s: 1}", "av.parameters.time_headway_s", 4, "kappa_per_s"),
    ("av:\n  parameters: {kappa_per_s: 1}", "av.parameters.kappa_per_s", 3, "surrogates.NAME.parameters"),
    ("av:\n  model: idm\n  controller: a:B", "av", 2, "An AV has one driver"),
    ("av:\n  controller:", "av.controller", 3, "Write a value after 'controller:'"),
    ("surrogates:\n  A: my.py:Model", "surrogates.A.controller", 3, "no file"),
    ("testing: {challenge: immediate}\nsurrogates: {A: my.py:Model}", "surrogates", 3, "one hold period"),
    ("testing: {method: episode_mixture}\nsurrogates: {}", "surrogates", 3, "at least one surrogate"),
    ("testing: {method: step_mixture, estimator: scv}\nrecords: {moments: none}", "records.moments", 3, "first_9"),
    ("testing:\n  alpha: {SM-I: 0.5, SM-II: 0.4, SM-III: 0.2}", "testing.alpha", 3, "sum to 1.1"),
    ("environment:\n  acceleration_hold_s: 0.25", "environment.acceleration_hold_s", 3, "multiple of the 0.1 s"),
    ("scenario: all", "scenario", 2, "Write scenarios: [cut_in, lead_brakes, cut_out]"),
    ("scenarios: [cut_in, lead_brakes]\nexposure: {lead: 0.3}", "exposure.lead", 3, "Did you mean 'lead_brakes'"),
    ("scenarios:\n  - cut_in\n  - cutout", "scenarios.1", 4, "Did you mean 'cut_out'"),
    ("scenario: cut_out\nscenarios: [cut_in, lead_brakes]", "scenario", 2, "Delete one of both keys"),
    ("environment:\n  parameters: gone.yaml", "environment.parameters", 3, "a parameter file"),
    ("av:\n  sumo: {tau: 1}\nworld: {engine: twin}", "world.engine", 4, "Write engine: sumo"),
    ("av:\n  traci: {command: 'x {host}'}", "av.traci.command", 3, "Double a brace"),
    ("av:\n  before_event: controller", "av.before_event", 3, "hold_speed"),
    ("stop:\n  rhw: 1\n  rhw: 2", "stop.rhw", 4, "again, first written on line 3"),
    ("testing: {method: step_mixture}\nstop:\n  rhw: 0.3", "stop.rhw", 4, "a fixed number of tests"),
    ("stop:\n  below_reference: 0.3", "stop.below_reference", 3, "ask for that limit alone"),
    ("testing: {method: forced}\nstop:\n  below_reference: 1\n  rhw: 1", "stop.below_reference", 4, "Write null"),
    ("testing: {method: forced}\naccept: {crash_rate_below: 0.1}", "accept", 3, "testing.method shells"),
    ("accept: {crash_rate_below: 1e-7, statement: library}", "accept.statement", 2, "belongs under testing.shells"),
    ("accept: {crash_rate_below: 1e-7, times_reference: {driver: r157-cc}}", "accept", 2, "both"),
    ("accept: {}", "accept", 2, "neither"),
)
SCHEMA = jsonschema.Draft202012Validator(json.loads(schema_text()))


@pytest.mark.parametrize(("text", "path", "line", "words"), MISTAKES + BROKEN_RULES)
def test_a_mistake_is_named(load, text, path, line, words):
    with pytest.raises(CampaignError) as caught:
        load(text)
    error = caught.value
    assert error.where.startswith(f"{path} (")
    assert re.search(rf"bad\.yaml:{line}(:\d+)?\)$", error.where)
    assert words in str(error)
    assert error.exit_code == EXIT_BAD_INPUT
    assert all((error.found, error.expected, error.mend))
    in_schema = (text, path, line, words) in MISTAKES
    assert not in_schema or not SCHEMA.is_valid(yaml.safe_load(f"name: bad\n{text}"))


def places_in(error: CampaignError) -> set[str]:
    return set(re.findall(r"^  (.*?): found ", str(error), re.MULTILINE))


def test_all_mistakes_are_named_at_once(load):
    with pytest.raises(CampaignError) as caught:
        load("stop:\n  rhw: x\ntesting:\n  alpha: {SM-I: 0.9}\n  epsilom: 1\nwordl: {}")
    where = {place.partition(" ")[0] for place in places_in(caught.value)}
    assert where == {"stop.rhw", "testing.alpha", "testing.epsilom", "wordl"}
    assert {problem.where.partition(" ")[0] for problem in caught.value.problems} == where
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    with pytest.raises(CampaignError, match=r"at least 20 problems"):
        load("".join(f"key_{i}: 1\n" for i in range(1000)))


def test_parameter_files_are_read_with_the_place_of_every_problem(tmp_path):
    text = (SHIPPED_FOLDER / "ndd-overtaking-1.yaml").read_text()
    text = text.replace("r2_min_m: {value: 20.0,", "r2_min_m: {value: '20',")
    text = text.replace("r2_max_m: {value: 100.0, source: paper}", "r2_max_m: {value: 100.0, sourse: paper}")
    (tmp_path / "mine.yaml").write_text(text)
    line = 1 + next(i for i, row in enumerate(text.splitlines()) if "r2_min_m" in row)
    with pytest.raises(CampaignError, match="Did you mean 'source'") as caught:
        read_model(tmp_path / "mine.yaml", EnvironmentParameters)
    assert places_in(caught.value) == {
        f"initial_state.r2_min_m.value ({tmp_path}/mine.yaml:{line})",
        f"initial_state.r2_max_m.source ({tmp_path}/mine.yaml:{line + 1})",
        f"initial_state.r2_max_m.sourse ({tmp_path}/mine.yaml:{line + 1})",
    }


def test_values_of_several_kinds(load):
    campaign = load("testing: {epsilon: 1e-5}\nstop: {episodes: 1e8, rhw: 1}\nav: {model: fvdm, parameters: {c2: 1.6}}")
    assert (campaign.testing.epsilon, campaign.stop.rhw) == (1e-5, 1.0)
    assert load("testing: {method: step_mixture, epsilon: 1}\nstop: {rhw: 0.3}").stop.rhw == 0.3  # plain simulation
    assert (campaign.stop.episodes, type(campaign.stop.episodes)) == (100_000_000, int)
    assert (campaign.av.parameters.c2, campaign.av.parameters.kappa_per_s) == (1.6, 0.85)
    # These fit the built-in IDM as well; tried as a union they would become its parameters, and be lost.
    av = load("av: {model: idm, parameters: {}}", "av={controller: 'a:B', parameters: {time_headway_s: 1.5}}").av
    assert av.parameters == {"time_headway_s": 1.5}
    assert load("av: {model: idm}", "av.model=null", "av.controller=a:B").av.source == "controller"


def test_how_a_number_is_written_does_not_change_the_hash(load):
    text = "run: {{shard_size: {}}}\nenvironment: {{lane_change_level: {}}}"
    numbers = (("1000", "10"), ("1e3", "1e1"), ("1000.0", "10.0"))
    assert len({load(text.format(*pair)).content_hash("parameters") for pair in numbers}) == 1


def test_files_are_relative_to_the_campaign(load, tmp_path, monkeypatch):
    (tmp_path / "deep").mkdir()
    shutil.copy(SHIPPED_FOLDER / "ndd-overtaking-1.yaml", tmp_path / "deep" / "mine.yaml")
    monkeypatch.chdir("/")
    ray = "run: {ray: {runtime_env: {working_dir: src, py_modules: [a, 's3://b'], pip: [x]}}}"
    campaign = load("environment: {parameters: deep/mine.yaml}\n" + ray)
    assert campaign.environment.parameters == str(tmp_path / "deep/mine.yaml")
    folders = {"working_dir": f"{tmp_path}/src", "py_modules": [f"{tmp_path}/a", "s3://b"], "pip": ["x"]}
    assert campaign.run.ray.runtime_env == folders
    gone = load("environment: {parameters: ./gone.yaml}", check_files=False)
    assert gone.environment.parameters == str(tmp_path / "gone.yaml")


# -- --set --


def test_later_overrides_win_and_follow_the_rules_of_the_file(load):
    campaign = load("stop: {rhw: 0.1}", "stop.rhw=0.2", "stop={rhw: 0.3}", "stop.rhw=4e-1", "description=12:30")
    assert (campaign.stop.rhw, campaign.description) == (0.4, "12:30")
    assert load("stop: {rhw: 0.1}", "stop.rhw=null").stop.rhw is None


@pytest.mark.parametrize(
    ("typed", "rhw", "below"),
    [
        (("stop.episodes=1000", "testing.method=shells"), 0.3, 0.3),
        (("stop.rhw=0.1",), 0.1, None),
        (("testing.method=forced",), 0.3, None),
        (("stop.below_reference=0.5", "stop.rhw=0.1"), 0.1, 0.5),
    ],
)
def test_what_is_asked_for_by_hand_is_what_ends_a_run(load, typed, rhw, below):
    for found in (load("stop: {rhw: 0.3, below_reference: 0.3}", *typed), load_campaign("idm", typed)):
        assert (found.stop.rhw, found.stop.below_reference) == (rhw, below)


def test_a_precision_by_hand_and_a_limit_of_the_file_do_not_go_together(load):
    gate = "accept: {crash_rate_below: 1e-7}"
    with pytest.raises(CampaignError, match="a precision, in a campaign with a limit") as caught:
        load(gate, "stop.rhw=0.1")
    assert (caught.value.where, caught.value.mend) == ("--set stop.rhw=0.1", "Add --set accept=null.")
    assert load(gate, "stop.rhw=0.1", "accept=null").stop.rhw == 0.1
    assert load(gate, "stop.rhw=0.1", "accept.crash_rate_below=2e-7").accept.crash_rate_below == 2e-7


@pytest.mark.parametrize(
    "override",
    [
        *("testing.epsilom=0.2", "testing.epsilon=no", "testing.epsilon=", "testing.epsilon", "=1", "name.first=x"),
        *("environment.parameters=gone.yaml", "surrogates.A.parameters.x=1", "a={b: 1, b: 2}"),
    ],
)
def test_errors_name_the_option(load, override):
    with pytest.raises(CampaignError) as caught:
        load("", override)
    assert f"--set {override}" in caught.value.where


# -- the panel and --av --


def test_a_vehicle_replaces_the_campaigns_and_overrides_are_laid_over_it(load, tmp_path):
    text = "av: {model: fvdm, parameters: {kappa_per_s: 0.5}}\nsurrogates: {S: {model: idm}}"
    by_name = load(text, av="brakes-3")
    assert (by_name.av, by_name.surrogates) == (load_panel().avs["brakes-3"], {"S": Surrogate(model="idm")})
    file, mine = tmp_path / "mine.yaml", "{model: idm, parameters: {time_headway_s: 2}, reaction: {delay_s: 0.2}}"
    file.write_text(f"format: av-panel\nversion: 1\navs: {{mine: {mine}}}\n")
    mine = load(text, "av.parameters.min_acceleration_mps2=-7", av=f"{file}:mine").av
    assert mine.parameters == IDMParameters(time_headway_s=2.0, min_acceleration_mps2=-7.0)
    assert mine.reaction.delay_s == 0.2


OWN = """
class MyAV:
    def step(self, seen): ...

def step(seen): ...
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A folder with a vehicle and a campaign, in which the harness is started."""
    monkeypatch.chdir(tmp_path)
    Path("my_av.py").write_text(OWN)
    Path("mine.yaml").write_text("name: mine\n")
    Path("my.fmu").touch()
    Path("campaigns").mkdir()
    return tmp_path


NAMED = {
    "my_av.py:MyAV": ("my_av-MyAV", {"controller": "{}/my_av.py:MyAV"}),
    "package.module:Class": ("package.module-Class", {"controller": "package.module:Class"}),
    "my.fmu": ("my", {"fmu": {"file": "{}/my.fmu"}}),
    "sumo:ACC": ("sumo-ACC", {"sumo": {"carFollowModel": "ACC"}}),
    "late-600ms": ("late-600ms", {"model": "idm", "reaction": {"delay_s": 0.6}}),
}


@pytest.mark.parametrize(("vehicle", "name", "av"), [(key, *value) for key, value in NAMED.items()], ids=NAMED)
def test_a_vehicle_is_a_campaign_by_the_recommended_method(vehicle, name, av, own):
    campaign = load_campaign(vehicle, ["seed=2"])
    av, testing = json.loads(json.dumps(av).replace("{}", str(own))), {"method": "shells"}
    assert campaign == Campaign(name=name, av=av, seed=2, testing=testing, stop=QUICK, records={"traces": "crash"})
    assert load_campaign("mine.yaml", av=vehicle).av == campaign.av


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("my_av.py", "Name its class or function: my_av.py:MyAV or my_av.py:step"),
        ("my_av.MyAV", "Write my_av.py:MyAV."),
        ("my_aw.py:MyAV", r"^av\.controller \(my_aw.py:MyAV\): found no file \S*my_aw.py;.* Did you mean 'my_av.py'"),
        ("mime.yaml", "no such file.* Did you mean 'mine.yaml'"),
        ("late-60ms", "or one of idm, [^;]{9,99}, ….* Did you mean 'late-600ms'"),
        ("mine.yaml:idm", "format"),  # which is no panel
        ("late-idm", "Name one of them: idm, .*, r157-cc, .*, late-600ms"),  # 'late-600ms' is no misspelling away
    ],
)
def test_what_is_neither_campaign_nor_vehicle_says_what_was_meant(given, said, own):
    with pytest.raises(CampaignError, match=said) as caught:
        load_campaign(given)
    assert given.partition(":")[0] in f"{caught.value}"


BOTH_HAVE, IDM_HAS = {"max_acceleration_mps2": 1}, "{time_headway_s: 2, max_acceleration_mps2: 1}"
ANOTHER_DRIVER = [
    ("model: idm, parameters: {time_headway_s: 2}, reaction: {delay_s: 0.2}", "controller=my_av.py:MyAV", {}),
    (f"model: idm, parameters: {IDM_HAS}", "model=fvdm", BOTH_HAVE),
    ("controller: 'a:B', parameters: {x: 1}", "controller=a:C", {"x": 1}),
    ("fmu: {file: x.fmu}", "sumo.tau=2", {}),
]


def test_a_whole_vehicle_replaces_what_was_said_of_one_before(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("name: c\n")
    said = ["av.parameters.min_acceleration_mps2=-1.5", "av={model: idm, parameters: {min_acceleration_mps2: -8}}"]
    av = load_campaign(file, said).av
    assert (av.model, av.parameters.min_acceleration_mps2) == ("idm", -8.0)
    assert load_campaign(file, [said[1], "av.model=fvdm"]).av.model == "fvdm"
    assert load_campaign(file, said[::-1]).av.parameters.min_acceleration_mps2 == -1.5


@pytest.mark.parametrize(("written", "option", "parameters"), ANOTHER_DRIVER)
def test_one_override_changes_the_vehicle(written, option, parameters, own):
    file = own / "campaigns" / "c.yaml"
    file.write_text(f"name: c\nav: {{{written}, limits: {{step_time_s: 3}}}}\n")
    campaign = load_campaign(file, [f"av.{option}"])  # a file is looked for beside the campaign, then where one is
    of_option = load_campaign("mine.yaml", [f"av.{option}"]).av.model_dump(exclude_unset=True)
    kept = {"parameters": parameters, "limits": {"step_time_s": 3}}
    assert campaign.av == AutomatedVehicle.model_validate(of_option | kept)


def test_a_file_counts_as_the_module_that_it_is(own):
    hashes = {load_campaign(each).content_hash("p") for each in ("my_av:MyAV", "my_av.py:MyAV")}
    Path("moved").mkdir()
    moved = Path("my_av.py").rename("moved/my_av.py")
    assert {load_campaign(f"{moved}:MyAV").content_hash("p")} == hashes


def test_the_commands_take_a_vehicle(tmp_path, capsys, monkeypatch):
    file = tmp_path / "c.yaml"
    file.write_text("name: c\n")
    assert main(["check", str(file), "--av", "late-300ms"]) == 0
    assert "delay_s: 0.3" in capsys.readouterr().out
    seen = []
    monkeypatch.setattr("harness.runner.compare.compare_campaigns", lambda a, b, *_, **__: seen.extend([a, b]) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["compare", str(file), "SM-II", "--out", str(tmp_path / "c"), "--av", "idm", "--quiet"])
    assert [campaign.av for campaign in seen] == [AutomatedVehicle(), load_panel().avs["SM-II"]]
    assert main(["run", str(file), "--out", str(tmp_path / "r"), "--av", "nobody"]) == 2
    assert capsys.readouterr().err.startswith("error: --av nobody\n")


def test_a_surrogate_named_forced_is_told_from_forced_cut_ins():
    given = {"name": "x", "testing": {"method": "episode_mixture"}, "surrogates": {"forced": {"model": "idm"}}}
    assert Campaign.model_validate(given).importance_names == ("forced cut-ins", "forced")
