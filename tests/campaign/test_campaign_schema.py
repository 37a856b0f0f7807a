"""The committed JSON schema is current, and says the same as the loader."""

from pathlib import Path

import jsonschema
import pytest

from harness.campaign.schema import campaign_schema, schema_text

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def test_committed_schema_is_current():
    committed = (SCENARIOS / "campaign.schema.json").read_text(encoding="utf-8")
    assert committed == schema_text(), "write it anew: harness schema > scenarios/campaign.schema.json"


def test_schema_is_a_schema():
    jsonschema.Draft202012Validator.check_schema(campaign_schema())


@pytest.mark.parametrize(
    "wrong",
    [
        {"testin": {}},
        {"testing": {"epsilon": "0.1"}},
        {"av": {"parameters": {"desired_speed_mps": 300}}},
        {"av": {"model": "fvdm", "parameters": {"time_headway_s": 1}}},
        {"av": {"parameters": {"kappa_per_s": 1}}},
        {"av": {"model": "idm", "controller": "a:B"}},
        {"av": {"sumo": {}, "traci": {"command": "x"}}},
        {"av": {"controller": None}},
        {"av": {"controller": "a b"}},
        {"av": {"sumo": {"minGap": True}}},
        {"av": {"sumo": {"tau": 1}, "parameters": {"tau": 1}}},
        {"av": {"fmu": {"file": "a.fmu", "output": "a"}}},
        {"surrogates": {"a.b": {"model": "idm"}}},
        {"surrogates": {"A": {"model": "fvdm", "parameters": {"time_headway_s": 1}}}},
        {"stop": {"episodes": 1.5}},
        {"name": "a b"},
    ],
)
def test_schema_refuses_what_the_loader_refuses(wrong):
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({"name": "x", **wrong}, campaign_schema())
