"""The resolved campaign says everything, and reads back as itself."""

import json

import jsonschema
import pytest
from campaign_strategies import SCHEMA, campaigns
from hypothesis import Phase, given, settings

from harness.campaign.campaign import Campaign
from harness.campaign.files import dump_campaign, load_campaign, written_out
from harness.campaign.yaml_text import read_yaml


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("dumped") / "campaign.yaml"


WITHOUT_SHRINKING = (Phase.explicit, Phase.generate)  # a campaign is too large to be shrunk in useful time


@settings(max_examples=150, deadline=None, phases=WITHOUT_SHRINKING)
@given(data=campaigns())
def test_round_trip(file, data):
    campaign = Campaign.model_validate(data)
    file.write_text(dump_campaign(campaign), encoding="utf-8")
    again = load_campaign(file)
    assert again == campaign
    assert list(again.surrogates) == list(campaign.surrogates)
    assert again.content_hash("x") == campaign.content_hash("x")


@settings(max_examples=50, deadline=None, phases=WITHOUT_SHRINKING)
@given(data=campaigns())
def test_what_the_schema_allows_loads(file, data):
    jsonschema.validate(data, SCHEMA)
    file.write_text(json.dumps(data), encoding="utf-8")  # JSON is YAML
    assert load_campaign(file) == Campaign.model_validate(data)


def test_every_value_is_written_out(file):
    campaign = Campaign(name="short")
    file.write_text(dump_campaign(campaign))
    data = read_yaml(file)[0]
    assert data == written_out(campaign)
    assert data.pop("av").items() <= campaign.model_dump()["av"].items()
    assert data == campaign.model_dump(exclude={"av"})


def test_sources_that_do_not_drive_are_not_written(file):
    file.write_text(dump_campaign(Campaign(name="x", av={"sumo": {"carFollowModel": "ACC", "minGap": 2.5}})))
    av = read_yaml(file)[0]["av"]
    assert av.keys() == {"sumo", "parameters", "reaction", "before_cut_in", "limits"}
    assert av["sumo"] == {"carFollowModel": "ACC", "minGap": 2.5}


@pytest.mark.parametrize(
    "text",
    [
        "no",
        "12:30",
        "1e5",
        "0",
        "0x1F",
        "1_000",
        "2024-01-01",
        "null",
        "~",
        "",
        " x",
        "a: b",
        "# x",
        "- x",
        "\0\x85\ufeff☃",
    ],
)
def test_texts_that_other_readers_misread_are_quoted(file, text):
    file.write_text(dump_campaign(Campaign(name="x", description=text)), encoding="utf-8")
    assert 'description: "' in file.read_text()
    assert load_campaign(file).description == text
