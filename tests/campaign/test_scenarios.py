"""The shipped campaigns: valid for loader and editor, and no way of breaking them gives anything but a clear error."""

import copy
from pathlib import Path

import jsonschema
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from harness.campaign.files import load_campaign, yaml_text
from harness.campaign.schema import campaign_schema
from harness.campaign.yaml_text import read_yaml
from harness.errors import CampaignError

FOLDER = Path(__file__).parents[2] / "scenarios"
SCENARIOS = sorted(file for file in FOLDER.glob("*.yaml") if file.name != "av_panel.yaml")
CONTENTS = [read_yaml(file)[0] for file in SCENARIOS]
TEXTS = [file.read_text() for file in SCENARIOS]

_texts = st.text(st.characters(codec="utf-8", exclude_categories=["C"]), max_size=8).map(lambda text: f"x {text}")
_wrong_numbers = st.one_of(_texts, st.booleans(), st.lists(st.integers(), max_size=2), st.just({"a": 1}))
_wrong_texts = st.one_of(
    st.integers(), st.floats(), st.booleans(), st.lists(st.integers(), max_size=2), st.just({"a": 1})
)
_anything = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), _texts),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(_texts, inner, max_size=3)),
    max_leaves=8,
)


def _paths(value, above=()):
    for key, item in value.items():
        yield (*above, key)
        if isinstance(item, dict):
            yield from _paths(item, (*above, key))


def _get(data, path):
    for key in path:
        data = data[key]
    return data


def _with(data, path, value):
    data = copy.deepcopy(data)
    _get(data, path[:-1])[path[-1]] = value
    return data


@pytest.fixture(scope="module")
def load(tmp_path_factory):
    file = tmp_path_factory.mktemp("mutated") / "mutated.yaml"

    def load_data(data):
        file.write_text(yaml_text(data) if isinstance(data, dict) else data, encoding="utf-8")
        return load_campaign(file)

    return load_data


def _complaint(load, data):
    """What the loader says about ``data``; the name of the file when it has nothing to say."""
    try:
        load(data)
    except CampaignError as error:
        return str(error)
    return "mutated.yaml"


def test_the_promised_scenarios_are_there():
    kinds = ("forced", "mixture", "nade", "nde", "recursive")
    assert {file.name for file in SCENARIOS} >= {"smoke.yaml", *(f"overtaking_{kind}.yaml" for kind in kinds)}


@pytest.mark.parametrize("file", SCENARIOS, ids=lambda file: file.stem)
def test_scenario_is_valid(file):
    assert file.read_text().startswith("# yaml-language-server: $schema=campaign.schema.json\n")
    campaign = load_campaign(file)
    assert campaign.description
    jsonschema.validate(read_yaml(file)[0], campaign_schema())


def test_smoke_asks_for_what_the_readme_promises():
    smoke = load_campaign(FOLDER / "smoke.yaml")
    assert (smoke.testing.method, smoke.testing.shells.statement) == ("shells", "assumption_free")
    assert (smoke.stop.rhw, smoke.stop.min_crashes, smoke.stop.episodes) == (0.05, None, 400_000)
    assert (smoke.world.engine, smoke.records.moments, smoke.records.traces) == ("sumo", "none", "crash")


def test_nade_has_the_published_settings():
    nade = load_campaign(FOLDER / "overtaking_nade.yaml")
    assert (nade.testing.method, nade.testing.challenge, nade.testing.epsilon) == ("step_mixture", "immediate", 0.1)
    assert nade.alpha() == (1 / 3, 1 / 3, 1 / 3)


@settings(max_examples=150, deadline=None)
@given(data=st.sampled_from(CONTENTS), draw=st.data())
def test_a_wrong_type_is_an_error_that_names_it(load, data, draw):
    leaves = [path for path in _paths(data) if not isinstance(_get(data, path), dict)]
    path = draw.draw(st.sampled_from(leaves))
    wrong = _wrong_texts if isinstance(_get(data, path), str) else _wrong_numbers
    with pytest.raises(CampaignError) as caught:
        load(_with(data, path, draw.draw(wrong)))
    assert ".".join(path) in str(caught.value)
    assert "mutated.yaml:" in str(caught.value)


@settings(max_examples=150, deadline=None)
@given(data=st.sampled_from(CONTENTS), draw=st.data())
def test_any_value_anywhere_loads_or_is_a_clear_error(load, data, draw):
    path = draw.draw(st.sampled_from(list(_paths(data))))
    mutated = _with(data, path, draw.draw(_anything))
    assert "mutated.yaml" in _complaint(load, mutated)


@settings(max_examples=150, deadline=None)
@given(text=st.sampled_from(TEXTS), draw=st.data())
def test_damaged_text_loads_or_is_a_clear_error(load, text, draw):
    start = draw.draw(st.integers(0, len(text)))
    end = draw.draw(st.integers(start, min(start + 20, len(text))))
    inserted = draw.draw(st.text(st.sampled_from("a1 :-{}[]'\"\n\t#&*!|>%@`,?e.\0\u2028"), max_size=6))
    assume(inserted or end > start)
    assert "mutated.yaml" in _complaint(load, text[:start] + inserted + text[end:])
