"""Loading a campaign: every mistake is named with YAML path and line, several at once."""

import re
import shutil
from pathlib import Path

import pytest

from harness.campaign.files import load_campaign, shipped_parameters
from harness.campaign.problems import InvalidFileError
from harness.errors import EXIT_BAD_INPUT, CampaignError


@pytest.fixture
def load(tmp_path):
    def load_text(text, *overrides, **options):
        file = tmp_path / "bad.yaml"
        file.write_text("name: bad\n" + text)
        return load_campaign(file, overrides, **options)

    return load_text


@pytest.mark.parametrize(
    ("text", "path", "line", "words"),
    [
        ("testin:\n  epsilon: 0.2", "testin", 2, "Did you mean 'testing'?"),
        ("testing:\n  epsilom: 0.2", "testing.epsilom", 3, "Did you mean 'epsilon'?"),
        ("epsilon: 0.2", "epsilon", 2, "belongs under testing"),
        ("zzz: 0.2", "zzz", 2, "Delete it"),
        ("testing:\n  epsilon: '0.2'", "testing.epsilon", 3, "Remove the quotes"),
        ("testing:\n  epsilon: true", "testing.epsilon", 3, "truth value"),
        ("testing:\n  epsilon: .nan", "testing.epsilon", 3, "nan"),
        ("testing: 5", "testing", 2, "a section with keys such as method"),
        ("world:", "world", 2, "delete the key for its default"),
        ("run: [1]", "run", 2, "a list of 1"),
        ("description: 5", "description", 2, "in quotes"),
        ("stop:\n  episodes: 1.5", "stop.episodes", 3, "a whole number"),
        ("stop:\n  episodes: 1e300", "stop.episodes", 3, "a whole number"),
        ("seed: " + "9" * 4299, "seed", 2, "999…"),
        ("stop:\n  rhw: true", "stop.rhw", 3, "above 0 and below 10, or null"),
        ("stop:\n  rhw: " + "9" * 400, "stop.rhw", 3, "999…"),
        ("testing:\n  method: ndee", "testing.method", 3, "Did you mean 'nde'?"),
        ("av:\n  parameters:\n    desired_speed_mps: 300", "av.parameters.desired_speed_mps", 4, "at most 60 (m/s)"),
        ("av:\n  model: fvdm\n  parameters:\n    max_speed_mps: 300", "av.parameters.max_speed_mps", 5, "at most 60"),
        ("av:\n  model: fvdm\n  parameters: {time_headway_s: 1}", "av.parameters.time_headway_s", 4, "kappa_per_s"),
        ("av:\n  parameters: {kappa_per_s: 1}", "av.parameters.kappa_per_s", 3, "surrogates.NAME.parameters"),
        ("av:\n  parameters: 5", "av.parameters", 3, "a section"),
        ("av: {model: krauss, parameters: {tau: 1}}", "av.model", 2, "idm, fvdm"),
        ("surrogates:\n  A: {model: idm, parameters: {v0: 1}}", "surrogates.A.parameters.v0", 3, "time_headway_s"),
        ("surrogates:\n  A:\n    parameters: {}", "surrogates.A", 3, "no key 'model'"),
        ("surrogates:\n  A:\n    model: zz", "surrogates.A.model", 4, "'idm', 'fvdm'"),
        ("surrogates:\n  A: 5", "surrogates.A", 3, "a section"),
        ("surrogates:\n  a.b: {model: idm}", "surrogates.a.b", 3, "another name"),
        ("surrogates: {}", "surrogates", 2, "at least one surrogate"),
        ("testing:\n  alpha: {SM-I: 0.5, SM-II: 0.4, SM-III: 0.2}", "testing.alpha", 3, "sum to 1.1"),
        ("testing:\n  alpha: {SM-I: 0.5, SM-II: 0.5}", "testing.alpha", 3, "SM-I, SM-II, SM-III"),
        ("testing:\n  alpha:\n    SM-I: x", "testing.alpha.SM-I", 4, "a number of at least 0 and at most 1"),
        ("environment:\n  acceleration_hold_s: 0.25", "environment.acceleration_hold_s", 3, "multiple of the 0.1 s"),
        ("environment:\n  parameters: gone.yaml", "environment.parameters", 3, "ndd-overtaking-1"),
        ("environment:\n  parameters: ndd-overtaking-2", "environment.parameters", 3, "Did you mean"),
        ("stop:\n  estimator: nde", "stop.estimator", 3, "testing.method nde"),
        ("stop:\n  estimator: scv\nrecords: {moments: none}", "stop.estimator", 3, "records.moments"),
        ("stop:\n  estimator: scv\ntesting: {method: forced}", "stop.estimator", 3, "testing.method step_mixture and"),
        ("av:\n  controler: a:B", "av.controler", 3, "Did you mean 'controller'?"),
        ("av:\n  command: ./a", "av.command", 3, "belongs under av.traci"),
        ("av:\n  minGap: 2", "av.minGap", 3, "model, controller, sumo, traci, fmu"),
        ("av:\n  model: idm\n  controller: a:B", "av", 2, "An AV has one driver"),
        ("av:\n  controller:", "av.controller", 3, "Write a value after 'controller:'"),
        ("av:\n  controller: my module.py", "av.controller", 3, "text such as my_package.my_module:MyController"),
        ("av:\n  controller: 5", "av.controller", 3, "in quotes"),
        ("av:\n  controller: a:B\n  parameters: [1]", "av.parameters", 4, "names, each with its value"),
        ("av:\n  sumo: ACC", "av.sumo", 3, "names, each with its value"),
        ("av:\n  sumo:\n    carFollowModel: ACC\n    minGap: true", "av.sumo.minGap", 5, "text or a number"),
        ("av:\n  controller: a:B\n  parameters: {x: 1}\n  epsilom: 1", "av.epsilom", 5, "Delete it"),
        ("av:\n  sumo: {tau: 1}\n  parameters: {tau: 1}", "av.parameters", 4, "under av.sumo itself"),
        ("av:\n  sumo: {tau: 1}\nworld: {engine: twin}", "world.engine", 4, "Write engine: sumo"),
        ("av:\n  traci: {command: ''}", "av.traci.command", 3, "starts the program"),
        ("av:\n  traci:\n    command: x\n    restart: 1", "av.traci.restart", 5, "Did you mean 'restarts'?"),
        ("av:\n  traci: {command: x, restarts: 1.5}", "av.traci.restarts", 3, "a whole number"),
        ("av:\n  fmu: {file: a.fmu, output: a}", "av.fmu.inputs", 3, "Add 'inputs: …'"),
        ("av:\n  fmu: {file: a.fmu, output: a, inputs: {v: 1}}", "av.fmu.inputs.v", 3, "text"),
        ("av:\n  limits: {step_time_s: 0}", "av.limits.step_time_s", 3, "above 0"),
        ("av:\n  before_cut_in: controller", "av.before_cut_in", 3, "shells (or forced)"),
        ("stop:\n  rhw: 1\n  rhw: 2", "stop.rhw", 4, "first written on line 3"),
        ("world: {cells: 257}", "world.cells", 2, "at most 256"),
        ("testing: {method: step_mixture}\nstop:\n  rhw: 0.3", "stop.rhw", 4, "a fixed number of tests"),
    ],
)
def test_a_mistake_is_named(load, text, path, line, words):
    with pytest.raises(CampaignError) as caught:
        load(text)
    error = caught.value
    assert error.where.startswith(f"{path} (")
    assert re.search(rf"bad\.yaml:{line}(:\d+)?\)$", error.where)
    assert words in str(error)
    assert error.exit_code == EXIT_BAD_INPUT
    assert all((error.found, error.expected, error.mend))


def test_a_name_is_explained_in_words(tmp_path):
    (tmp_path / "bad.yaml").write_text("name: a b\n")
    with pytest.raises(CampaignError) as caught:
        load_campaign(tmp_path / "bad.yaml")
    assert caught.value.expected.startswith("a name of letters, digits, _ . and -, without spaces")


def test_a_controller_keeps_its_parameters_as_they_are(load):
    # These fit the built-in IDM as well; tried as a union they would become its parameters, and be lost.
    av = load("av: {controller: 'a:B', parameters: {time_headway_s: 1.5}}").av
    assert av.parameters == {"time_headway_s": 1.5}


def test_null_takes_a_source_away(load):
    campaign = load("av: {model: idm}", "av.model=null", "av.controller=a:B")
    assert campaign.av.source == "controller"


def test_all_mistakes_are_named_at_once(load):
    with pytest.raises(InvalidFileError) as caught:
        load("stop:\n  rhw: x\ntesting:\n  alpha: {SM-I: 0.9}\n  epsilom: 1\nwordl: {}")
    where = {problem.where.partition(" ")[0] for problem in caught.value.problems}
    assert where == {"stop.rhw", "testing.alpha", "testing.epsilom", "wordl"}
    assert all(place in str(caught.value) for place in where)


def test_missing_name(tmp_path):
    (tmp_path / "c.yaml").write_text("seed: 1\n")
    with pytest.raises(CampaignError, match=r"^name \(.*c.yaml:1\): found no such key"):
        load_campaign(tmp_path / "c.yaml")


def test_numbers_without_dot_are_numbers(load):
    campaign = load("testing: {epsilon: 1e-5}\nstop: {episodes: 1e8, rhw: 1}\nenvironment: {lane_change_level: 350}")
    assert campaign.testing.epsilon == 1e-5
    assert campaign.stop.episodes == 100_000_000
    assert isinstance(campaign.stop.episodes, int)
    assert isinstance(campaign.stop.rhw, float)
    assert isinstance(campaign.environment.lane_change_level, float)


def test_how_a_number_is_written_does_not_change_the_hash(load):
    hashes = {
        load(
            f"stop: {{episodes: 10}}\nrun: {{shard_size: {size}}}\nenvironment: {{lane_change_level: {level}}}"
        ).content_hash("parameters")
        for size, level in (("1000", "10"), ("1e3", "1e1"), ("1000.0", "10.0"))
    }
    assert len(hashes) == 1


def test_fvdm_vehicle_has_fvdm_defaults(load):
    assert load("av: {model: fvdm}").av.parameters.kappa_per_s == 0.85
    assert load("av: {model: fvdm, parameters: {c2: 1.6}}").av.parameters.c2 == 1.6


def test_parameter_file_is_found_beside_the_campaign(load, tmp_path, monkeypatch):
    (tmp_path / "deep").mkdir()
    shipped = Path(load_campaign.__code__.co_filename).parent.parent / "traffic" / f"{shipped_parameters()[0]}.yaml"
    shutil.copy(shipped, tmp_path / "deep" / "mine.yaml")
    monkeypatch.chdir("/")
    assert load("environment: {parameters: deep/mine.yaml}").environment.parameters == str(tmp_path / "deep/mine.yaml")


def test_missing_parameter_file_may_be_allowed(load, tmp_path):
    campaign = load("environment: {parameters: ./gone.yaml}", check_files=False)
    assert campaign.environment.parameters == str(tmp_path / "gone.yaml")


def test_errors_survive_pickling(load):
    import pickle

    with pytest.raises(InvalidFileError) as caught:
        load("a: 1\nb: 2")
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
