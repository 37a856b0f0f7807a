"""Two AVs over the same episodes: what may differ, to the same length, and nothing run twice."""

import json
from pathlib import Path

import numpy as np
import pytest

from harness.campaign.files import load_campaign
from harness.cli import main
from harness.errors import CampaignError
from harness.runner.compare import compare_campaigns, require_comparable
from tests.in_process import one_process, without_page
from tests.runner.conftest import sets
from tests.runner.stored_runs import stored_table

FORCED = str(Path(__file__).parents[2] / "scenarios/overtaking_forced.yaml")
SMALL = [
    "world.engine=twin",
    "run.shard_size=2500",
    "stop.episodes=40000",
    "stop.rhw=0.9",
    "stop.min_crashes=20",
    "records.traces=none",
]
HARDER = "av.parameters.min_acceleration_mps2=-8"


@pytest.fixture(scope="module", autouse=True)
def _here():
    with one_process(), without_page():
        yield


@pytest.fixture(scope="module")
def campaigns():
    return load_campaign(FORCED, SMALL), load_campaign(FORCED, [*SMALL, HARDER])


@pytest.fixture(scope="module")
def done(campaigns, tmp_path_factory):
    return compare_campaigns(*campaigns, tmp_path_factory.mktemp("compared"), workers=1)


def episodes(folder, column):
    return stored_table(folder, "episodes")[column].to_pylist()


def test_both_have_the_same_episodes_and_meet_the_same_cut_ins(done):
    for column in ("episode", "r2_m", "cut_in_step", "log_weight"):
        of_a, of_b = (episodes(done.folder / side, column) for side in "ab")
        assert of_a == of_b
    own = [done.content["campaigns"][side]["own_stop"]["n_episodes"] for side in "ab"]
    assert done.difference.n_pairs == max(own) == len(of_a)


def test_the_difference_is_that_of_the_records(done):
    means = []
    for side in "ab":
        rows = stored_table(done.folder / side, "episodes").to_pandas()
        means.append((np.exp(rows.log_weight) * (rows.outcome == "crash")).mean())
    assert done.difference.difference == pytest.approx(means[0] - means[1], rel=1e-9)
    assert done.difference.variance_ratio > 1.0
    assert json.loads((done.folder / "compare.json").read_text()) == done.content


def test_what_is_finished_is_not_run_again(done, campaigns, monkeypatch):
    def never(*_arguments, **_options):
        raise AssertionError("ran again")

    monkeypatch.setattr("harness.runner.compare.run_campaign", never)
    assert compare_campaigns(*campaigns, done.folder).content == done.content


@pytest.mark.parametrize(
    ("override", "where"),
    [("seed=5", "seed"), ("testing.epsilon=0.2", "testing.epsilon"), ("surrogates={A: {model: idm}}", "surrogates")],
)
def test_only_the_vehicle_may_differ(campaigns, override, where):
    with pytest.raises(CampaignError) as caught:
        require_comparable(campaigns[0], load_campaign(FORCED, [*SMALL, override]))
    assert caught.value.where.startswith(where)
    assert caught.value.exit_code == 2


def test_the_command_line(done, capsys):
    assert main(["compare", FORCED, "--against", HARDER, "--out", str(done.folder), *sets(*SMALL)]) == done.exit_code
    out = capsys.readouterr().out
    assert f"B (overtaking-forced, {HARDER})" in out
    assert out.splitlines()[-1] == str(done.folder / "compare.json")
    assert main(["compare", FORCED, "--out", str(done.folder)]) == 2
    assert "--against" in capsys.readouterr().err
