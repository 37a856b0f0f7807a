"""A run repeats some of its own tests: good vehicles pass, others are found out, and replay knows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from harness.campaign.files import load_campaign
from harness.errors import CampaignError
from harness.records.folder import read_manifest
from harness.runner.stored import replay_episode, suspects
from tests.stored_runs import copy_of, edit

FORCED = Path(__file__).parents[2] / "scenarios/overtaking_forced.yaml"
SMALL = ("world.engine=twin", "stop.rhw=null", "stop.episodes=400", "run.shard_size=100", "records.traces=none")
GLOBAL = "{controller: 'tests.controllers.misbehaving:Global'}"


@pytest.fixture
def run_av(run_here, tmp_path):
    def run_one(av, *overrides, name="run", run=run_here, **options):
        return run(load_campaign(FORCED, [*SMALL, f"av={av}", *overrides]), tmp_path / name, **options).folder

    return run_one


def statement(folder):
    return json.loads((folder / "estimates.json").read_text())["statement"]


@pytest.mark.parametrize("name", ["shells-controller-twin", "forced-batch", "forced-krauss", "forced-traci-style"])
def test_a_vehicle_that_does_the_same_again_is_said_to(name, stored_run):
    manifest = read_manifest(stored_run(name))
    assert (manifest["repeated"]["differing"], manifest["reproducible"]) == ([], True)
    assert (n := manifest["repeated"]["n_episodes"]) > 5
    assert statement(stored_run(name)).endswith(f"{n} of these tests were run a second time: same bits.")


def test_a_vehicle_that_does_not_is_found_out_for_any_number_of_workers_and_after_a_resume(run_av, run, tmp_path):
    folders = [run_av(GLOBAL, name="1"), run_av(GLOBAL, name="2", run=run, workers=2)]
    one, two = (read_manifest(folder) for folder in folders)
    assert one["repeated"] == two["repeated"]
    assert len(one["repeated"]["differing"]) == one["repeated"]["n_episodes"] == 10
    assert (one["reproducible"], two["reproducible"]) == (False, False)
    assert statement(folders[0]).startswith("WARNING: 10 of 10 tests that were run a second time DIFFERED")
    with pytest.raises(CampaignError, match="10 of 10 tests that it repeated itself came out otherwise"):
        replay_episode(folders[0], 3)
    copied = copy_of(folders[0], tmp_path / "copy")
    run_av(GLOBAL, "stop.episodes=500", name=copied.name, resume=True)
    longer = read_manifest(copied)
    assert (longer["repeated"], longer["reproducible"], longer["n_episodes"]) == (one["repeated"], False, 500)


def test_a_replay_that_differs_names_what_it_knows(stored_run, tmp_path):
    folder = copy_of(stored_run("shells-controller-twin"), tmp_path / "run")
    manifest = read_manifest(folder)
    (folder / "estimates.json").unlink()
    edit(folder, repeated=None)
    assert replay_episode(folder, 3).suspects is None
    campaign = load_campaign(folder / "campaign.yaml")
    assert "the vehicle does not do the same again" in suspects(manifest, campaign)
    assert "source file has been changed" in suspects({**manifest, "controller_sha256": "0"}, campaign)
    assert "CPU Z80 (here" in suspects({**manifest, "cpu": "Z80"}, campaign)
