"""No number of a parameter file passes that the dynamics ignore or cannot bear: each is mutated, and refused or run."""

import numpy as np
import pytest

from harness.campaign.models import Campaign
from harness.campaign.models import Environment as EnvironmentSection
from harness.campaign.yaml_text import read_yaml
from harness.environment.loading import load_parameters, parameter_file
from harness.errors import CampaignError
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.state import STATE_COLUMNS
from harness.twin import TwinWorld

TEXT = parameter_file("ndd-overtaking-1").read_text(encoding="utf-8")
DATA, _ = read_yaml(parameter_file("ndd-overtaking-1"))
NUMBERS = [(section, name) for section, numbers in DATA.items() if isinstance(numbers, dict) for name in numbers]
EPISODES = 40
NOT_NUMBERS = [".nan", ".inf", "-.inf", "abc", "'1'", "true", "null", "[1]", "1" + "0" * 400]


def written(tmp_path, *changes):
    """A copy of the shipped file in which each (section, name, value) is changed."""
    text = TEXT
    for section, name, value in changes:
        begin = text.index(f"\n  {name}: ", text.index(f"\n{section}:")) + 1
        line = f"  {name}: {{value: {value}, source: user}}"
        text = text[:begin] + line + text[text.index("\n", begin) :]
    path = tmp_path / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return EnvironmentSection(parameters=str(path))


def refusal(section):
    try:
        load_parameters(section)
    except CampaignError as error:
        return str(error)
    return None


def require_sane_tests(section):
    """Forced cut-ins run to a finite, sane crash rate."""
    campaign = Campaign(name="mutant", environment=section, testing={"method": "forced"}, world={"engine": "twin"})
    prepared = prepare(resolve(campaign))
    states = prepared.states(0, EPISODES)
    assert all(np.isfinite(states[name]).all() for name in STATE_COLUMNS)
    world = TwinWorld(16)
    episode = prepared.loop(world).run(0, states).results.episode
    weight = np.exp(episode["log_weight"])
    assert np.isfinite(weight).all()
    assert ((weight >= 0.0) & (weight <= 1.0)).all()
    assert np.isfinite(episode["log_p_cut_in"]).all()
    assert np.isfinite(episode["av_distance_m"]).all()
    assert (episode["cut_in_step"] >= 0).all()


def mutants(value):
    """The number's other sign, nothing, much more and less, and an exponent gone wrong."""
    candidates = (
        -value,
        0.0,
        1.0,
        -1.0,
        value * 10.0,
        value / 10.0,
        value + 100.0,
        value - 100.0,
        1e6,
        -1e6,
        1e300,
        1e-9,
    )
    return [x for x in dict.fromkeys(candidates) if x != value]


@pytest.mark.parametrize(("section", "name"), NUMBERS)
def test_a_mutated_number_is_refused_or_runs_sanely(tmp_path, section, name):
    value = DATA[section][name]["value"]
    for mutant in mutants(value):
        changed = written(tmp_path, (section, name, repr(mutant)))
        if (said := refusal(changed)) is None:
            require_sane_tests(changed)
        else:
            assert f"{tmp_path}/mine.yaml" in said


@pytest.mark.parametrize("text", NOT_NUMBERS)
def test_what_is_no_finite_number_is_refused(tmp_path, text):
    assert "cut_in.ignore_share.value" in refusal(written(tmp_path, ("cut_in", "ignore_share", text)))


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
    ],
)
def test_what_does_not_fit_together_names_the_place(tmp_path, changes, named):
    assert named in refusal(written(tmp_path, *changes))


@pytest.mark.parametrize(("name", "value"), [("step_s", "0.2"), ("step_s", "0.1"), ("vehicle_length_m", "4")])
def test_a_number_that_would_change_nothing_is_refused_with_the_reason(tmp_path, name, value):
    path = tmp_path / "mine.yaml"
    line = f"\n  {name}: {{value: {value}, source: paper}}"
    path.write_text(TEXT.replace("\nscenario:", f"\nscenario:{line}"), encoding="utf-8")
    said = refusal(EnvironmentSection(parameters=str(path)))
    assert f"scenario.{name}" in said
    assert "would change nothing" in said


def test_hashes_are_those_of_the_first_version():
    assert load_parameters(EnvironmentSection()).content_hash() == "838b5235175d4be5"


def test_the_level_of_lane_changing_is_part_of_the_laws(tmp_path):
    changed = written(tmp_path, ("cut_in", "intercept", "-440"))  # e^-440 is 1e-191
    assert refusal(changed) is None
    assert "a wish to change lanes" in refusal(changed.model_copy(update={"lane_change_level": 1e-10}))
