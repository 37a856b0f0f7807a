"""Where a campaign stops, what it says then, and going on to another precision with the same records."""

from __future__ import annotations

import json

import pytest

from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, RunFolderError
from harness.progress import Progress
from harness.runner.resume import Prefix
from tests.runner.conftest import TWIN
from tests.stored_runs import copy_of, manifest, shard_files, stored_table, unlike_columns

LOOSE, TIGHT = "stop.rhw=0.3", "stop.rhw=0.15"
COMMON = (
    "world.engine=twin",
    "stop.episodes=4000",
    "stop.min_crashes=20",
    "run.shard_size=50",
    "testing.method=forced",
    "av={model: fvdm}",  # crashes often: the largest weight is a hundred times the rate
)


@pytest.fixture(scope="module")
def runs(run_here, campaign, tmp_path_factory):
    """The same campaign, run afresh to either precision."""
    folder, results = tmp_path_factory.mktemp("stop"), {}
    for name, rhw in (("loose", LOOSE), ("tight", TIGHT)):
        results[name] = run_here(campaign(*COMMON, rhw), folder / name)
        assert results[name].stopped_by == "rhw"
        assert results[name].exit_code == EXIT_DONE
    return results


def test_the_asked_precision_is_reached_and_nothing_beyond_it_is_kept(runs):
    loose, tight = runs["loose"].folder, runs["tight"].folder
    for folder, rhw in ((loose, 0.3), (tight, 0.15)):
        content = manifest(folder)
        assert len(shard_files(folder)) == len(content["shards"]) == content["n_episodes"] // 50
        assert stored_table(folder, "episodes").num_rows == content["n_episodes"]
        estimates = json.loads((folder / "estimates.json").read_text())
        assert estimates["estimates"][estimates["headline"]]["rhw"] <= rhw
    assert manifest(loose)["n_episodes"] < manifest(tight)["n_episodes"] < 4000


class Bar(Progress):
    """Where the bar of tests begins and ends."""

    def stage(self, name, total, *, done=0):
        if name == "episodes":
            self.begin = self.end = done

    def advance(self, n):
        self.end += n


def test_a_run_resumed_to_a_smaller_rhw_extends_the_same_records(runs, run_here, campaign, tmp_path):
    out = copy_of(runs["loose"].folder, tmp_path / "run")
    before = {path.name: path.stat().st_mtime_ns for path in shard_files(out)}
    bar = Bar()
    result = run_here(campaign(*COMMON, TIGHT), out, resume=True, progress=bar)
    assert result.exit_code == EXIT_DONE
    assert (bar.begin, bar.end) == tuple(manifest(runs[name].folder)["n_episodes"] for name in ("loose", "tight"))
    after = {path.name: path.stat().st_mtime_ns for path in shard_files(out)}
    assert {name: after[name] for name in before} == before, "finished shards are not written again"
    assert len(after) > len(before)
    assert unlike_columns(runs["tight"].folder, out) == []


def test_a_larger_rhw_than_was_reached_is_refused_and_costs_nothing(runs, run_here, campaign, tmp_path):
    out = copy_of(runs["tight"].folder, tmp_path / "run")
    with pytest.raises(RunFolderError, match="finished tests, of which the campaign as it is asked for now would keep"):
        run_here(campaign(*COMMON, LOOSE), out, resume=True)
    assert unlike_columns(runs["tight"].folder, out) == []
    assert manifest(out) == manifest(runs["tight"].folder)
    assert (out / "campaign.yaml").read_bytes() == (runs["tight"].folder / "campaign.yaml").read_bytes()


def test_a_refused_resumption_costs_no_shorter_shard_either(run_here, campaign, tmp_path):
    """The last shard of a spent budget would be replaced by a longer one; but the rule is content before it."""
    out = tmp_path / "run"
    run_here(campaign(*COMMON, "stop.rhw=null", "stop.episodes=130"), out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(RunFolderError, match="130 finished tests, of which"):
        run_here(campaign(*COMMON, "stop.rhw=5", "stop.min_crashes=1"), out, resume=True)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_a_spent_budget_is_exit_code_4_and_can_be_enlarged(runs, run_here, campaign, tmp_path):
    out = tmp_path / "run"
    small = [*COMMON[:1], "stop.episodes=130", *COMMON[2:], LOOSE]
    result = run_here(campaign(*small, "stop.rhw=0.01"), out)
    assert (result.exit_code, result.stopped_by) == (EXIT_BUDGET_SPENT, "episodes")
    assert stored_table(out, "episodes").num_rows == 130
    assert (out / "estimates.json").exists()

    result = run_here(campaign(*COMMON, LOOSE), out, resume=True)
    assert (result.exit_code, result.stopped_by) == (EXIT_DONE, "rhw")
    assert unlike_columns(runs["loose"].folder, out) == []


def test_a_shard_is_written_when_all_before_it_are_in(campaign, run_here, tmp_path, monkeypatch):
    """Whatever ends the run, the folder holds a prefix of its shards: here the worker is ahead by one."""
    counted, on_disk, add = [], [], Prefix.add

    def noted(prefix, done, files):
        add(prefix, done, files)
        counted.append(len(prefix.shards))
        on_disk.append(len(shard_files(tmp_path / "run")))

    monkeypatch.setattr(Prefix, "add", noted)
    run_here(campaign(*TWIN), tmp_path / "run")
    assert on_disk == counted == [1, 2, 3, 4, 5]
