"""The parameter file: every number says where it comes from, and a wrong file is an error that names the place."""

import re
from pathlib import Path

import pytest

from harness.campaign.models import Environment
from harness.campaign.yaml_text import read_yaml
from harness.environment.loading import load_environment, load_parameters, parameter_file
from harness.environment.parameters import EnvironmentParameters
from harness.errors import CampaignError

SHIPPED = parameter_file("ndd-overtaking-1")
TEXT = SHIPPED.read_text(encoding="utf-8")
DATA, _ = read_yaml(parameter_file("ndd-overtaking-1"))
NUMBERS = [(section, name) for section, numbers in DATA.items() if isinstance(numbers, dict) for name in numbers]


def user_file(tmp_path, old, new, count=1):
    assert TEXT.count(old) >= 1
    path = tmp_path / "mine.yaml"
    path.write_text(TEXT.replace(old, new, count), encoding="utf-8")
    return Environment(parameters=str(path))


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
    record = load_environment(Environment(lane_change_level=350.0, acceleration_hold_s=0.1)).numbers
    for section, name in NUMBERS:
        assert record[f"{section}__{name}"] == DATA[section][name]["value"]
    assert record[["level", "hold_steps", "max_steps"]].item() == (350.0, 1, 200)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("  df: {value: 16.0, source: ndd}", "  df: {value: 16.0}", "free_driving.df.source"),
        ("  df: {value: 16.0, source: ndd}", "  df: {value: 16.0, source: rumour}", "free_driving.df.source"),
        ("  df: {value: 16.0, source: ndd}", "  df: {value: sixteen, source: ndd}", "free_driving.df.value"),
        ("  df: {value: 16.0, source: ndd}", '  df: {value: "16.0", source: ndd}', "free_driving.df.value"),
        ("  df: {value: 16.0, source: ndd}", "  df: {value: .nan, source: ndd}", "free_driving.df.value"),
        ("  df: {value: 16.0, source: ndd}", "  df: 16.0", "free_driving.df"),
        ("  margin_m:", "  margin_mm:", "guard.margin_mm"),
        ("guard:\n", "gard:\n", "gard"),
        ("version: 1", "version: 2", "version"),
        ("  intercept: {value: -8.744, source: ndd}\n", "", "cut_in.intercept"),
    ],
)
def test_a_wrong_file_names_the_place(tmp_path, old, new, named):
    with pytest.raises(CampaignError) as error:
        load_parameters(user_file(tmp_path, old, new))
    assert named in str(error.value)


def test_a_missing_section_is_an_error(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(TEXT[: TEXT.index("\ncut_in:")], encoding="utf-8")
    with pytest.raises(CampaignError, match="cut_in"):
        load_parameters(Environment(parameters=str(path)))


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(CampaignError, match="no such file"):
        load_parameters(Environment(parameters=str(tmp_path / "none.yaml")))


def test_a_users_number_is_used(tmp_path):
    changed = user_file(tmp_path, "  df: {value: 16.0, source: ndd}", "  df: {value: 1e1, source: user, note: ours}")
    assert load_environment(changed).numbers["free_driving__df"] == 10.0


def test_the_hash_is_that_of_the_numbers_alone(tmp_path):
    shipped = EnvironmentParameters.model_validate(DATA)
    old = "  df: {value: 16.0, source: ndd}"
    noted = load_parameters(user_file(tmp_path, old, "  df: {value: 16.0, source: user, note: checked}"))
    assert noted.content_hash() == shipped.content_hash()
    changed = load_parameters(user_file(tmp_path, old, "  df: {value: 16.000000001, source: ndd}"))
    assert changed.content_hash() != shipped.content_hash()
