"""Campaign files: the shipped ones are valid, and written out as they are; broken ones are clear errors."""

import hashlib
import json
from pathlib import Path

import jsonschema
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from harness.campaign.campaign import Campaign
from harness.campaign.files import dump_campaign, load_campaign, load_panel, schema_text, written_out
from harness.campaign.models import Places
from harness.campaign.yaml_text import parse_value, read_yaml, yaml_text
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


# -- the YAML reader --


@pytest.fixture
def read(tmp_path):
    def read_text(text):
        file = tmp_path / "some.yaml"
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        data, lines = read_yaml(file)
        return data, Places(str(file), lines)

    return read_text


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-5", 1e-5),
        ("010", 10),
        ("0x1F", 31),
        ("12:30", "12:30"),
        ("no", "no"),
        ("true", True),
        ("~", None),
        ("2024-01-01", "2024-01-01"),
        ("[1, {b: 2}]", [1, {"b": 2}]),
    ],
)
def test_values_are_what_they_look_like(read, text, value):
    data, _ = read(f"a: {text}\n")
    assert data == {"a": value}
    assert type(data["a"]) is type(value)
    assert parse_value(text or "~", "here") == value


def test_anchors_and_merges(read):
    data, lines = read("a: &x {b: 1, c: 2}\nd:\n  <<: *x\n  c: 3\ne: *x\n")
    assert data == {"a": {"b": 1, "c": 2}, "d": {"b": 1, "c": 3}, "e": {"b": 1, "c": 2}}
    assert [lines.line_of(path) for path in (["d", "c"], ["d", "b"], ["e", "c"])] == [4, 2, 1]


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("a: 1\nb:\n  c: 1\n  c: 2\n", "4:3", "b.c ("),
        ("- 1\n", 1, "list"),
        ("a: 1\n\tb: 2", "2:1", "character '\\t'"),
        ("a: 1\n---\nb: 2", "2:1", "a single document"),
        ("a: 1\nb: [1,\n", "3:1", "<stream end>"),
        ("a: 1\nb: x\0y", "2:5", "U+0000"),
        ("a: 1\nb: !!python/name:os.system x", "2:4", "tag"),
        ("a: &x [*x]", 1, "more than 100,000 values, or 50 levels"),
        ("a: *nope", 1, "nope"),
        ("a: &x [1]\nb: *x\nc: &x [2]", "3:4", "duplicate anchor 'x'"),
        ("b: 1\n1: a", 2, "not text"),
        ("<<: 5", "1:5", "for merging"),
        ("a: " + "[" * 60 + "]" * 60, 1, "50 levels"),
    ],
)
def test_errors_name_the_line(read, text, line, words):
    with pytest.raises(CampaignError) as caught:
        read(text)
    assert f"some.yaml:{line}" in caught.value.where
    assert words in str(caught.value)
    with pytest.raises(CampaignError) as caught:
        parse_value(text if words not in ("list", "single value") else "[1", "here")
    assert caught.value.where == "here"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("# only a comment\n", "empty"),
        (b"a: \xff", "UTF-8"),
        ("a: " + "9" * 5000, "limit"),
        ('a: "\\UFFFFFFFF"', "too large"),
        ("a: " + "[" * 5000, "nested too deeply"),
        ("".join(f"key_{i}: 1\n" for i in range(60_000)), "more than 100,000 bytes"),
        (Path("none.yaml"), "no such file"),
        (Path(), "a folder"),
        (Path("/dev/zero"), "more"),
    ],
)
def test_files_that_are_refused_as_a_whole(read, tmp_path, content, words):
    with pytest.raises(CampaignError, match=words):
        read_yaml(tmp_path / content) if isinstance(content, Path) else read(content)


def test_the_folder_of_a_run_is_told_by_its_campaign(tmp_path):
    (tmp_path / "campaign.yaml").touch()
    with pytest.raises(CampaignError, match=rf"a folder; .*Name {tmp_path}/campaign\.yaml"):
        read_yaml(tmp_path)


def test_a_file_of_the_clone_is_told_where_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CampaignError, match=rf"no such file; .*Name {FOLDER}/smoke\.yaml"):
        load_campaign("scenarios/smoke.yaml")


def test_byte_order_mark_is_no_content(read):
    assert read(b"\xef\xbb\xbfa: 1")[0] == {"a": 1}


@pytest.mark.parametrize(("first", "more"), [("[1]", "[{}]"), ("{x: 1}", "{{{}}}")])
@pytest.mark.parametrize("levels", [9, 2000])
def test_aliases_that_multiply_are_refused_at_once(read, first, more, levels):
    """Each level names the one below nine times, so that a few lines stand for billions of values."""
    times = 9 if levels < 10 else 1
    names = [", ".join(f"{f'k{j}: ' if first[0] == '{' else ''}*a{i - 1}" for j in range(times)) for i in range(levels)]
    lines = [f"a{i}: &a{i} {more.format(name)}" for i, name in enumerate(names) if i]
    with pytest.raises(CampaignError, match=r"some\.yaml:\d+:\d+: found more than 100,000 values, or 50 levels"):
        read("\n".join([f"a0: &a0 {first}", *lines]))


def test_traffic_of_another_scenario_is_told_which_to_write():
    with pytest.raises(CampaignError, match=r"of cut_in; expected traffic of lead_brakes.*parameters=lead-brakes-1"):
        load_campaign(FOLDER / "smoke.yaml", ["scenario=lead_brakes"])


@pytest.mark.parametrize(
    ("scenario", "content"), [("lead_brakes", "format: ndd-overtaking"), ("cut_in", "like: cut-out-1")]
)
def test_a_file_of_traffic_of_another_scenario_is_one_mistake(scenario, content, tmp_path):
    (tmp_path / "mine.yaml").write_text(
        f"{content}\nversion: 1\ninitial_state: {{r1dot_df: {{value: 3, source: x}}}}\n"
    )
    asked = [f"scenario={scenario}", f"environment.parameters={tmp_path}/mine.yaml"]
    with pytest.raises(CampaignError, match="the file of this scenario") as caught:
        resolve(load_campaign("idm", asked))
    assert caught.value.problems == ()
