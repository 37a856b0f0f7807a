"""--set: laid over the file, later over earlier, and named in errors."""

import pytest

from harness.campaign.files import load_campaign
from harness.errors import CampaignError


@pytest.fixture
def load(tmp_path):
    def load_text(*overrides, text=""):
        file = tmp_path / "c.yaml"
        file.write_text("name: c\n" + text)
        return load_campaign(file, overrides)

    return load_text


def test_values_follow_the_rules_of_the_file(load):
    campaign = load("stop.rhw=1e-2", "stop.episodes=1e6", "description=12:30", "testing.method=nde")
    assert (campaign.stop.rhw, campaign.stop.episodes) == (0.01, 1_000_000)
    assert (campaign.description, campaign.testing.method) == ("12:30", "nde")


def test_later_overrides_win(load):
    assert load("stop.rhw=0.2", "stop={rhw: 0.3}", "stop.rhw=0.4").stop.rhw == 0.4
    assert load("stop.rhw=null", text="stop: {rhw: 0.1}").stop.rhw is None


def test_changing_one_default_surrogate_keeps_the_others(load):
    surrogates = load("surrogates.SM-II.parameters.min_acceleration_mps2=-2").surrogates
    assert list(surrogates) == ["SM-I", "SM-II", "SM-III"]
    assert [model.parameters.min_acceleration_mps2 for model in surrogates.values()] == [-4.0, -2.0, -6.0]


def test_shared_anchors_are_changed_apart(load):
    text = "surrogates: {A: &a {model: idm, parameters: {time_headway_s: 1}}, B: *a}"
    surrogates = load("surrogates.A.parameters.time_headway_s=2", text=text).surrogates
    assert [model.parameters.time_headway_s for model in surrogates.values()] == [2.0, 1.0]


@pytest.mark.parametrize(
    "override",
    [
        "testing.epsilom=0.2",
        "nothing=1",
        "testing.epsilon=no",
        "testing.epsilon=",
        "testing.epsilon",
        "testing.epsilon=[1",
        "testing..epsilon=1",
        "=1",
        "name.first=x",
        "stop.rhw.half=1",
        "environment.parameters=gone.yaml",
        "environment.parameters=gone",
        "surrogates.A.parameters.x=1",
        "av.parameters.desired_speed_mps=300",
        "surrogates={}",
        "a={b: 1, b: 2}",
    ],
)
def test_errors_name_the_option(load, override):
    with pytest.raises(CampaignError) as caught:
        load(override)
    assert f"--set {override}" in caught.value.where


def test_errors_in_the_file_still_name_the_line(load):
    with pytest.raises(CampaignError) as caught:
        load("stop.rhw=0.1", text="testing:\n  epsilon: x")
    assert caught.value.where.endswith("c.yaml:3)")


def test_rules_between_file_and_option_name_both(load):
    with pytest.raises(CampaignError) as caught:
        load("testing.alpha.SM-I=0.9", text="testing:\n  alpha: {SM-I: 0.5, SM-II: 0.4, SM-III: 0.1}")
    assert "c.yaml:3" in caught.value.where
    assert "--set testing.alpha.SM-I=0.9" in caught.value.where
