"""The shipped campaigns: valid for loader and editor, written out as they are, and however broken, a clear error."""

import hashlib
import json
from pathlib import Path

import jsonschema
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from harness.campaign.campaign import Campaign
from harness.campaign.files import dump_campaign, load_campaign, load_panel, schema_text, written_out
from harness.campaign.yaml_text import read_yaml, yaml_text
from harness.errors import CampaignError
from harness.resolved import resolve

FOLDER = Path(__file__).parents[2] / "scenarios"
SCENARIOS = sorted(file for file in FOLDER.glob("*.yaml") if file.name != "av_panel.yaml")
TEXTS = [file.read_text() for file in SCENARIOS]
SCHEMA = json.loads(schema_text())
jsonschema.Draft202012Validator.check_schema(SCHEMA)
CHANGES = [
    "av={controller: 'a:B', parameters: {x: [1, {y: null}], time_headway_s: true}}",
    "av={traci: {command: './a --port {port}', restarts: 0}}",
    "av={sumo: {carFollowModel: ACC, minGap: 2.5}}",
    "av={model: r157-fsm, parameters: {hard_braking_mps2: 7}, reaction: {max_jerk_mps3: 5, delay_s: 0.3}}",
    "av={parameters: {time_headway_s: 2}, limits: {step_time_s: 1}}",
    "surrogates={A: {model: fvdm, parameters: {c2: 1}}, b-2: {model: idm}}",
    "testing={method: nde, alpha: null}",
    "testing.shells={statement: library, first_tests: 5}",
    "environment={lane_change_level: 350, cut_in_lead_s: 0.5}",
    "run={executor: ray, ray: {address: auto, resources: {cpus: 2}, runtime_env: {env_vars: {A: '1'}}}}",
    "records={moments: all, traces: critical, trace_share: 0.25}",
    "description='no: #'",
]


@pytest.fixture(scope="module")
def load(tmp_path_factory):
    file = tmp_path_factory.mktemp("mutated") / "mutated.yaml"

    def load_data(data, *changes, **options):
        file.write_text(yaml_text(data) if isinstance(data, dict) else data, encoding="utf-8")
        return load_campaign(file, changes, **options)

    return load_data


@pytest.mark.parametrize("file", SCENARIOS, ids=lambda file: file.stem)
def test_scenario_is_valid(file):
    assert file.read_text().startswith("# yaml-language-server: $schema=campaign.schema.json\n")
    assert load_campaign(file).description
    jsonschema.validate(read_yaml(file)[0], SCHEMA)


# -- written out, and the editor's schema --


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    file=st.sampled_from(SCENARIOS),
    changes=st.lists(st.sampled_from(CHANGES), unique_by=lambda change: change.partition("=")[0], max_size=4),
    av=st.none() | st.sampled_from(sorted(load_panel().avs)),
)
def test_what_loads_is_allowed_by_the_schema_and_reads_back_as_itself(load, file, changes, av):
    try:
        campaign = load_campaign(file, changes, av=av)
    except CampaignError:
        assume(False)
    text = dump_campaign(campaign)
    again = load(text)
    assert again == campaign
    assert list(again.surrogates) == list(campaign.surrogates)
    assert again.content_hash("x") == campaign.content_hash("x")
    data = read_yaml(FOLDER / file)[0]
    jsonschema.validate(data, SCHEMA)
    written = written_out(campaign)
    if campaign.av.model is None:
        del written["av"]["reaction"]
    jsonschema.validate(written, SCHEMA)
    assert load(json.dumps(written)) == campaign  # JSON is YAML


@pytest.mark.parametrize("text", ["no", "12:30", "1e5", "2024-01-01", "~", "", " x", "a: b", "# x", "\0\x85\ufeff☃"])
def test_texts_that_other_readers_misread_are_quoted(load, text):
    dumped = dump_campaign(Campaign(name="x", description=text))
    assert 'description: "' in dumped
    assert load(dumped).description == text


# -- broken --


@settings(max_examples=75, deadline=None)
@given(text=st.sampled_from(TEXTS), draw=st.data())
def test_damaged_text_loads_or_is_a_clear_error(load, text, draw):
    start = draw.draw(st.integers(0, len(text)))
    end = draw.draw(st.integers(start, min(start + 20, len(text))))
    inserted = draw.draw(st.text(st.sampled_from("a1 :-{}[]'\"\n\t#&*!|>%@`,?e.\0\u2028"), max_size=6))
    assume(inserted or end > start)
    said = "mutated.yaml"
    try:
        load(text[:start] + inserted + text[end:])
    except CampaignError as error:
        said = str(error)
    assert "mutated.yaml" in said


# -- hashes stay: runs on disk go on, and a changed default is noticed --


ALSO = [
    *("crash.counts_above_mps=5", "environment.cut_in_lead_s=0.5", "av={controller: 'a:B', warm_up_s: 0}"),
    *("av={controller: 'a:B', parameters: {x: 1}, before_event: controller}", "accept.crash_rate_below=1e-7"),
    *("run.shard_size=7", "pool.library=ladder-lateral-1"),
]
SHELLS = FOLDER / "overtaking_shells.yaml"
HASHES = "f3f49576061560f2"


def test_hashes_stay():
    """Of the shipped campaigns, of one of them with one change each, and with each vehicle of the panel."""
    one = {file.stem: load_campaign(file) for file in SCENARIOS if file.stem != "r157"}  # which is of three
    shipped = {name: resolve(campaign).content_hash for name, campaign in one.items()}
    changed = {change: load_campaign(SHELLS, [change]).content_hash("p") for change in (*CHANGES, *ALSO)}
    driven = {name: load_campaign(SHELLS, av=name).content_hash("p") for name in load_panel().avs}
    found = json.dumps([shipped, changed, driven], sort_keys=True)
    assert hashlib.sha256(found.encode()).hexdigest()[:16] == HASHES, found
