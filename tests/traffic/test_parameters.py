"""The parameter file: every number has a source, a wrong one is named, and none passes that dynamics cannot bear."""

import copy
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from harness.campaign.campaign import Campaign
from harness.campaign.files import read_yaml
from harness.campaign.sections import EnvironmentSettings
from harness.errors import CampaignError
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.traffic.loading import load_environment, load_parameters, parameter_file, require_sound_laws
from harness.traffic.parameters import EnvironmentParameters
from harness.vocabulary import STATE_COLUMNS
from harness.worlds.twin import TwinWorld

SHIPPED = parameter_file("ndd-overtaking-1")
TEXT = SHIPPED.read_text(encoding="utf-8")
DATA, _ = read_yaml(SHIPPED)
NUMBERS = [(section, name) for section, numbers in DATA.items() if isinstance(numbers, dict) for name in numbers]
NOT_NUMBERS = [".nan", ".inf", "-.inf", "abc", "'1'", "true", "null", "[1]", "1" + "0" * 400]
DF = "  df: {value: 16.0, source: ndd}"
EPISODES = 40
FORCED = resolve(Campaign(name="mutant", testing={"method": "forced"}, world={"engine": "twin"}))


@pytest.fixture
def mine(tmp_path):
    """An environment of the user's own, from the text of its file."""

    def environment(text):
        path = tmp_path / "mine.yaml"
        path.write_text(text, encoding="utf-8")
        return EnvironmentSettings(parameters=str(path))

    return environment


def edited(old, new):
    """The shipped file with some other text."""
    assert old in TEXT
    return TEXT.replace(old, new, 1)


def changed(*changes):
    """The shipped file in which each (section, name, value) is changed."""
    text = TEXT
    for section, name, value in changes:
        begin = text.index(f"\n  {name}: ", text.index(f"\n{section}:")) + 1
        text = text[:begin] + f"  {name}: {{value: {value}, source: user}}" + text[text.index("\n", begin) :]
    return text


def refusal(section):
    try:
        load_parameters(section)
    except CampaignError as error:
        return str(error)
    return None


def test_the_page_and_the_file_tag_the_share_that_ignores_the_av_alike():
    page = (Path(__file__).parents[2] / "docs/environment.md").read_text(encoding="utf-8")
    (tag,) = re.findall(r"`ignore_share`\) is the share of lane changes that ignore the vehicle behind \[(\w+)\]", page)
    assert tag == DATA["cut_in"]["ignore_share"]["source"]


def test_every_number_says_where_it_comes_from():
    assert len(NUMBERS) > 70
    tags = {DATA[section][name]["source"] for section, name in NUMBERS}
    assert tags <= set(re.findall(r"^#   (\w+) ", TEXT, re.MULTILINE))  # each is explained in the file's head
    assert tags >= {"paper", "ndd", "openacc", "assumed"}


def test_every_number_reaches_the_kernels():
    record = load_environment(EnvironmentSettings(lane_change_level=350.0, acceleration_hold_s=0.1)).numbers
    for section, name in NUMBERS:
        assert record[f"{section}__{name}"] == DATA[section][name]["value"]
    assert record[["level", "hold_steps", "max_steps"]].item() == (350.0, 1, 200)


def test_a_users_number_is_used(mine):
    own = mine(edited(DF, "  df: {value: 1e1, source: user, note: ours}"))
    assert load_environment(own).numbers["free_driving__df"] == 10.0


def test_the_hash_is_that_of_the_numbers_alone(mine):
    assert load_parameters(EnvironmentSettings()).content_hash() == "838b5235175d4be5"  # as of the first version
    noted = load_parameters(mine(edited(DF, "  df: {value: 16.0, source: user, note: checked}")))
    assert noted.content_hash() == "838b5235175d4be5"
    other = load_parameters(mine(edited(DF, "  df: {value: 16.000000001, source: ndd}")))
    assert other.content_hash() != "838b5235175d4be5"


# -- what is refused --


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (DF, "  df: {value: 16.0}", "free_driving.df.source"),
        (DF, "  df: {value: 16.0, source: rumour}", "free_driving.df.source"),
        (DF, "  df: {value: sixteen, source: ndd}", "free_driving.df.value"),
        (DF, '  df: {value: "16.0", source: ndd}', "free_driving.df.value"),
        (DF, "  df: {value: .nan, source: ndd}", "free_driving.df.value"),
        (DF, "  df: 16.0", "free_driving.df"),
        ("  margin_m:", "  margin_mm:", "guard.margin_mm"),
        ("guard:\n", "gard:\n", "gard"),
        ("version: 1", "version: 2", "version"),
        ("  intercept: {value: -8.744, source: ndd}\n", "", "cut_in.intercept"),
        (TEXT[TEXT.index("\ncut_in:") :], "", "cut_in"),
    ],
)
def test_a_wrong_file_names_the_place(mine, old, new, named):
    assert named in refusal(mine(edited(old, new)))


def test_a_missing_file_is_an_error(tmp_path):
    assert "no such file" in refusal(EnvironmentSettings(parameters=str(tmp_path / "none.yaml")))


@pytest.mark.parametrize("text", NOT_NUMBERS)
def test_what_is_no_finite_number_is_refused(mine, text):
    assert "cut_in.ignore_share.value" in refusal(mine(changed(("cut_in", "ignore_share", text))))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ([("cut_in", "ignore_share", "7")], "cut_in.ignore_share.value"),
        ([("cut_in", "ignore_share", "-1")], "cut_in.ignore_share.value"),
        ([("free_driving", "df", "-1")], "free_driving.df.value"),
        ([("initial_state", "v_scale_mps", "-5")], "initial_state.v_scale_mps.value"),
        ([("initial_state", "r2_min_m", "100"), ("initial_state", "r2_max_m", "20")], "initial_state.r2_min_m"),
        ([("initial_state", "r2dot_min_mps", "-5"), ("initial_state", "r2dot_max_mps", "-10")], "r2dot_min_mps"),
        ([("fit_range", "v_min_mps", "40"), ("fit_range", "v_max_mps", "20")], "fit_range.v_min_mps"),
        ([("fit_range", "r1_min_m", "115"), ("fit_range", "r1_max_m", "0")], "fit_range.r1_min_m"),
        ([("fit_range", "v_max_mps", "55")], "speeds of the AV"),
        ([("scenario", "duration_s", "10.05")], "scenario.duration_s.value"),
        ([("cut_in", "intercept", "-999")], "cut_in"),
        ([("cut_in", "intercept", "999")], "a wish to change lanes of inf"),
        ([("cut_in", "ignore_share", "0"), ("cut_in", "accept_scale_s", "0.001")], "cut_in.accept_scale_s"),
        ([("initial_state", "v_location_mps", "900")], "initial_state.v_location_mps"),
        ([("initial_state", "r1_shift_m", "300")], "initial_state.r1_*"),
        ([("initial_state", "r1dot_log_scale", "5")], "initial_state.r1dot_*"),
        ([("free_driving", "log_scale", "-20")], "noise of scale"),
    ],
)
def test_what_does_not_fit_together_names_the_place(mine, changes, named):
    said = refusal(section := mine(changed(*changes)))
    assert named in said
    assert section.parameters in said


@pytest.mark.parametrize(("name", "value"), [("step_s", "0.2"), ("step_s", "0.1"), ("vehicle_length_m", "4")])
def test_a_number_that_would_change_nothing_is_refused_with_the_reason(mine, name, value):
    line = f"\n  {name}: {{value: {value}, source: paper}}"
    said = refusal(mine(edited("\nscenario:", f"\nscenario:{line}")))
    assert f"scenario.{name}" in said
    assert "would change nothing" in said


def test_the_level_of_lane_changing_is_part_of_the_laws(mine):
    rare = mine(changed(("cut_in", "intercept", "-440")))  # e^-440 is 1e-191
    assert refusal(rare) is None
    assert "a wish to change lanes" in refusal(rare.model_copy(update={"lane_change_level": 1e-10}))


# -- no number passes that the dynamics ignore or cannot bear: each is mutated, and refused or run --


def sound_environment(section, name, value):
    """The shipped environment with another number, validated as a file's content is; None if it is refused."""
    data = copy.deepcopy(DATA)
    data[section][name]["value"] = value
    try:
        environment = load_environment(EnvironmentSettings(), EnvironmentParameters.model_validate(data))
        require_sound_laws(environment, "mine.yaml")
    except (ValidationError, CampaignError):
        return None
    return environment


def require_sane_tests(environment):
    """Forced cut-ins run to a finite, sane crash rate."""
    prepared = prepare(replace(FORCED, environment=environment))
    states = prepared.states(0, EPISODES)
    assert all(np.isfinite(states[name]).all() for name in STATE_COLUMNS)
    episode = prepared.loop(TwinWorld(16)).run(0, states).results.episode
    weight = np.exp(episode["log_weight"])
    assert np.isfinite(weight).all()
    assert ((weight >= 0.0) & (weight <= 1.0)).all()
    assert np.isfinite(episode["log_p_cut_in"]).all()
    assert np.isfinite(episode["av_distance_m"]).all()
    assert (episode["cut_in_step"] >= 0).all()


def mutants(value):
    """The number's other sign, nothing, much more and less, and an exponent gone wrong."""
    shifted = (-value, value * 10.0, value / 10.0, value + 100.0, value - 100.0)
    return {*shifted, 0.0, 1.0, -1.0, 1e6, -1e6, 1e300, 1e-9} - {value}


@pytest.mark.parametrize(("section", "name"), NUMBERS)
def test_a_mutated_number_is_refused_or_runs_sanely(section, name):
    for mutant in mutants(DATA[section][name]["value"]):
        if (environment := sound_environment(section, name, mutant)) is not None:
            require_sane_tests(environment)
