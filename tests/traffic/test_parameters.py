"""The parameter file: every number reaches the kernels, and a wrong one is named."""

import pytest

from harness.campaign.sections import EnvironmentSettings
from harness.campaign.yaml_text import read_yaml
from harness.errors import CampaignError
from harness.traffic.loading import load_environment, load_parameters
from harness.traffic.parameters import SHIPPED_FOLDER

SHIPPED = SHIPPED_FOLDER / "ndd-overtaking-1.yaml"
TEXT = SHIPPED.read_text(encoding="utf-8")
DATA, _ = read_yaml(SHIPPED)
NUMBERS = [(section, name) for section, numbers in DATA.items() if isinstance(numbers, dict) for name in numbers]
NOT_NUMBERS = [".nan", "-.inf", "'1'", "true", "null", "1" + "0" * 400]
DF = "  df: {value: 16.0, source: ndd}"


@pytest.fixture
def mine(tmp_path):
    """An environment of the user's own, from the text of its file."""

    def environment(text):
        path = tmp_path / "mine.yaml"
        path.write_text(text, encoding="utf-8")
        return EnvironmentSettings(parameters=str(path))

    return environment


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


def test_every_number_reaches_the_kernels():
    record = load_environment(EnvironmentSettings(lane_change_level=350.0, acceleration_hold_s=0.1)).numbers
    assert len(NUMBERS) > 70
    for section, name in NUMBERS:
        assert record[f"{section}__{name}"] == DATA[section][name]["value"]
    assert record[["level", "hold_steps", "max_steps"]].item() == (350.0, 1, 200)


def test_the_hash_is_that_of_the_numbers_alone(mine):
    assert load_parameters(EnvironmentSettings()).content_hash() == "838b5235175d4be5"  # as of the first version
    noted = load_parameters(mine(TEXT.replace(DF, "  df: {value: 16.0, source: user, note: checked}")))
    assert noted.content_hash() == "838b5235175d4be5"
    assert DF in TEXT
    other = load_parameters(mine(TEXT.replace(DF, "  df: {value: 16.000000001, source: ndd}")))
    assert other.content_hash() != "838b5235175d4be5"


# -- what is refused --


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        *(([("cut_in", "ignore_share", text)], "cut_in.ignore_share.value") for text in ["7", *NOT_NUMBERS]),
        ([("initial_state", "v_scale_mps", "-5")], "initial_state.v_scale_mps.value"),
        ([("initial_state", "r2_min_m", "100"), ("initial_state", "r2_max_m", "20")], "initial_state.r2_min_m"),
        ([("initial_state", "r2dot_min_mps", "-5"), ("initial_state", "r2dot_max_mps", "-10")], "r2dot_min_mps"),
        ([("fit_range", "v_min_mps", "40"), ("fit_range", "v_max_mps", "20")], "fit_range.v_min_mps"),
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


def test_the_level_of_lane_changing_is_part_of_the_laws(mine):
    rare = mine(changed(("cut_in", "intercept", "-440")))  # e^-440 is 1e-191
    assert refusal(rare) is None
    assert "a wish to change lanes" in refusal(rare.model_copy(update={"lane_change_level": 1e-10}))


@pytest.mark.parametrize(
    ("numbers", "found"),
    [
        ({"distance_m": 1.7}, "neither"),
        ({"distance_m": 1.7, "lead_s": 1.0, "speed_median_mps": 0.7}, "lead_s, speed_median_mps"),
        ({"distance_m": 1.7, "lead_s": 0.55}, "0.55"),
        ({"distance_m": 0.0, "lead_s": 0.5}, "found 0"),
    ],
)
def test_a_lateral_section_that_says_too_little_or_too_much_is_refused(mine, numbers, found):
    lines = [f"  {name}: {{value: {value}, source: user}}\n" for name, value in numbers.items()]
    said = refusal(mine(TEXT + "lateral:\n" + "".join(lines)))
    assert "lateral" in said
    assert found in said
