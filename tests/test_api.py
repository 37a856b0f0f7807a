"""The Python API does what its docstring says: load, run, estimate, report, replay, in a few lines."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import harness
from harness.errors import CampaignError, RunFolderError
from tests.stored_runs import estimates

MIXTURE_FILE = Path(__file__).parents[1] / "scenarios" / "overtaking_mixture.yaml"
BUDGET = ("stop.episodes=3000", "stop.rhw=0.5", "stop.min_crashes=20", "run.shard_size=60")
SMALL = ["world.engine=twin", "testing.method=forced", "av={model: fvdm}", *BUDGET]


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    campaign = harness.load_campaign(MIXTURE_FILE, SMALL)
    return harness.run(campaign, str(tmp_path_factory.mktemp("api") / "run"), workers=1)


def test_all_that_is_promised_is_there():
    assert dir(harness) == harness.__all__
    assert all(inspect.getdoc(getattr(harness, name)) for name in harness.__all__)
    with pytest.raises(AttributeError, match="nothing"):
        _ = harness.nothing


def test_importing_it_loads_nothing_slow():
    slow = {"numba", "scipy", "libsumo", "pandas", "pyarrow", "matplotlib"}
    command = [sys.executable, "-c", f"import harness.cli, sys; print({slow} & set(sys.modules))"]
    done = subprocess.run(command, cwd=MIXTURE_FILE.parents[1], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_a_campaign_is_loaded_with_overrides():
    campaign = harness.load_campaign(str(MIXTURE_FILE), ["stop.rhw=0.1", "seed=7"])
    assert campaign.stop.rhw == 0.1
    assert campaign.seed == 7
    with pytest.raises(CampaignError, match=r"stop\.rwh"):
        harness.load_campaign(MIXTURE_FILE, ["stop.rwh=0.1"])


def test_a_run_returns_what_the_folder_holds(result):
    assert result.exit_code == 0
    assert result.stopped_by == "rhw"
    assert result.estimates == estimates(result.folder)
    assert "crash" in result.estimates["statement"]
    headline = result.estimates["estimates"][result.estimates["headline"]]
    assert headline["ci_low"] < headline["crash_rate"] < headline["ci_high"]
    files = {"campaign.yaml", "manifest.json", "estimates.json", "report.html", "episodes", "moments", "traces"}
    assert {path.name for path in result.folder.iterdir()} >= files


def test_the_resolved_campaign_of_a_run_is_the_campaign(result):
    assert harness.load_campaign(result.folder / "campaign.yaml") == harness.load_campaign(MIXTURE_FILE, SMALL)


def test_estimating_again(result):
    assert harness.estimate(str(result.folder)) == result.estimates
    only = harness.estimate(result.folder, estimators=["nade"], confidence=0.5)
    assert "nade" in only["estimates"]
    assert only["confidence"] == 0.5


def test_replaying(result, tmp_path):
    replayed = harness.replay(str(result.folder), 17, fcd=str(tmp_path / "fcd.xml"))
    assert replayed.bit_equal is True
    assert replayed.outcome == replayed.row["outcome"]
    assert replayed.trace.num_rows == 3 * (replayed.row["n_steps"] + 1)
    assert (tmp_path / "fcd.xml").stat().st_size > 0
    with pytest.raises(RunFolderError, match="no episode 10000"):
        harness.replay(result.folder, 10_000)


def test_a_run_is_not_written_over(result):
    campaign = harness.load_campaign(MIXTURE_FILE, SMALL)
    with pytest.raises(harness.HarnessError, match="--resume"):
        harness.run(campaign, result.folder)
