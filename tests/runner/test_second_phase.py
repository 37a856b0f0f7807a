"""A plan and the parts of its second phase: the run in two phases of one machine, bit for bit; what is no part of it is
refused."""

from __future__ import annotations

import json
import math
import shutil
import signal
from pathlib import Path

import pytest

from harness import estimate, replay
from harness.cli import main
from harness.errors import CampaignError, HarnessError, RunFolderError
from harness.part import Part
from harness.runner import read_plan, run_part
from harness.runner.parts import planned_specs
from tests.pool.conftest import SMALL_POOL
from tests.pool.test_vehicle_pool import ACTING
from tests.runner.conftest import MIXTURE_FILE, SMALL, one_process, sets
from tests.runner.stored_runs import copy_of, manifest, shard_files, stored_table, unlike_columns
from tests.runner.test_parts import edit, without_what_is_the_machines
from tests.runner.test_runner_same_bits import struck
from tests.runner.test_runner_wrong_folders import complaint_of

ALIKE = ("testing.method=shells", "stop.rhw=1.0", "stop.episodes=3000", "run.shard_size=20", *SMALL_POOL)
TWIN = (*ALIKE, "world.engine=twin")
TWO_PHASE = "testing.shells.stopping=two_phase"


@pytest.fixture(scope="module")
def planned(campaign, plan_here, part_here, tmp_path_factory):
    """A plan and its three parts. Never written to."""
    folder = tmp_path_factory.mktemp("planned")
    plan_here(campaign(*TWIN), folder / "plan")
    for number in (3, 1, 2):
        part_here(folder / "plan", number, 3, folder / f"part{number}")
    return [folder / name for name in ("plan", "part1", "part2", "part3")]


@pytest.fixture(scope="module")
def whole(campaign, run_here, tmp_path_factory):
    """What one machine makes of the same campaign. Never written to."""
    return run_here(campaign(*TWIN, TWO_PHASE), tmp_path_factory.mktemp("two-phase") / "run")


@pytest.fixture
def folders(planned, tmp_path):
    """The plan and its parts, to be damaged."""
    return [copy_of(folder, tmp_path / folder.name) for folder in planned]


def same_files(a: Path, b: Path) -> bool:
    """Whether all tables, shadow runs and strata are there in both, of the same bytes."""
    kept = ("*.parquet", "shells.json")
    names = [sorted(path.relative_to(folder) for name in kept for path in folder.rglob(name)) for folder in (a, b)]
    return names[0] == names[1] and all((a / name).read_bytes() == (b / name).read_bytes() for name in names[0])


# -- the same bits --


def test_a_plan_and_its_parts_are_the_run_in_two_phases(planned, whole, merged, tmp_path):
    plan, one, two, three = planned
    result = merged([three, plan, two, one], tmp_path / "merged")
    assert manifest(plan)["n_episodes"] == manifest(whole.folder)["reported_from"] > 0
    assert whole.estimates["n_crashes"] > 0
    assert unlike_columns(whole.folder, result.folder) == []
    assert same_files(whole.folder, result.folder)
    assert without_what_is_the_machines(result.folder) == without_what_is_the_machines(whole.folder)
    assert (result.estimates, result.ending) == (whole.estimates, whole.ending)
    assert (result.exit_code, result.stopped_by) == (0, "two_phase")


def test_in_sumo_with_a_plan_and_a_part_that_were_killed(whole, campaign, plan_here, part_here, merged, tmp_path):
    plan, parts = tmp_path / "plan", [tmp_path / "part1", tmp_path / "part2"]
    overrides = sets(*SMALL, *ALIKE, "world.cells=16")
    assert struck(signal.SIGKILL, 4, "plan", MIXTURE_FILE, "--out", plan, *overrides).returncode == -signal.SIGKILL
    assert len(shard_files(plan)) == 3
    with pytest.raises(RunFolderError, match="a plan that is not finished"):
        read_plan(plan)
    plan_here(campaign(*ALIKE, "world.cells=64"), plan, resume=True)
    assert struck(signal.SIGKILL, 3, "run", plan, "--part", "1/2", "--out", parts[0]).returncode == -signal.SIGKILL
    assert len(shard_files(parts[0])) == 2
    part_here(plan, 2, 2, parts[1], resume=True)  # as job scripts do
    with pytest.raises(RunFolderError, match="not finished: part 1 of 2"):
        merged([plan, *parts], tmp_path / "merged")
    part_here(plan, 1, 2, parts[0], resume=True)
    result = merged([plan, *parts], tmp_path / "merged")
    assert [name for name in unlike_columns(whole.folder, result.folder) if name != "estimates.json"] == []
    assert result.estimates["estimates"] == whole.estimates["estimates"]
    retraced = manifest(result.folder)["retraced"]
    assert retraced["n_episodes"] == manifest(result.folder)["n_episodes"] == manifest(whole.folder)["n_episodes"]


def test_a_vehicle_that_acts_before_the_cut_in(campaign, run_here, plan_here, part_here, merged, tmp_path, monkeypatch):
    """It drives its shadow runs once, in the plan; a part that was begun goes on where the plan is gone."""
    acting = (*TWIN, "pool.shadow_paths=120", f"av={ACTING.format('Speeds')}", "stop.rhw=2.0")
    whole = run_here(campaign(*acting, TWO_PHASE), tmp_path / "whole")
    plan, parts = tmp_path / "plan", [tmp_path / "part1", tmp_path / "part2"]
    plan_here(campaign(*acting), plan)
    kept = copy_of(plan, tmp_path / "kept")
    with monkeypatch.context() as patch:
        patch.setattr("harness.runner.worker.run_shadows", lambda *_: pytest.fail("shadow runs are made again"))
        part_here(plan, 2, 2, parts[1])
        part_here(plan, 1, 2, parts[0])
        shard_files(parts[0])[-1].unlink()
        shutil.rmtree(plan)
        monkeypatch.chdir(tmp_path)
        with one_process():
            again = ["run", "plan", "--part", "1/2", "--out", "part1", "--workers", "1", "--quiet"]
            assert main(again) == 2
            assert main([*again, "--resume"]) == 0
    result = merged([kept, *parts], tmp_path / "merged")
    assert unlike_columns(whole.folder, result.folder) == []
    assert same_files(whole.folder, result.folder)
    assert len(list((result.folder / "shadow").iterdir())) == 3
    assert without_what_is_the_machines(result.folder) == without_what_is_the_machines(whole.folder)


@pytest.mark.parametrize("number", [1, 3, 64])
def test_parts_tile_the_second_phase(planned, number):
    plan = read_plan(planned[0])
    n_shards = len(plan.specs())
    of = min(number, n_shards)
    specs = [spec for k in range(1, of + 1) for spec in planned_specs(plan, Part(k, of))]
    assert specs == plan.specs()
    assert specs[0].first_episode == manifest(planned[0])["n_episodes"]
    assert sum(draw.n for spec in specs for draw in spec.draws) == sum(plan.second["tests"])


# -- what a plan is, and what merged parts are good for --


def test_a_plan_that_is_complete_is_only_read(folders, campaign, plan_here, monkeypatch):
    plan = folders[0]
    before, facts = {path: path.read_bytes() for path in shard_files(plan)}, manifest(plan)["plan"]
    monkeypatch.setattr("tests.runner.conftest.WorkerInThisProcess.give", lambda *_: pytest.fail("a test is run"))
    again = plan_here(campaign(*TWIN), plan, resume=True)
    assert (again.n_first, again.n_planned) == (manifest(plan)["n_episodes"], sum(facts["tests"]))
    assert (manifest(plan)["plan"], manifest(plan)["status"]) == (facts, "done")
    assert {path: path.read_bytes() for path in shard_files(plan)} == before
    with pytest.raises(RunFolderError, match="already begun"):
        plan_here(campaign(*TWIN), plan)


def test_merged_parts_can_be_estimated_replayed_and_continued(planned, merged, whole, campaign, run_here, tmp_path):
    out = merged(planned, tmp_path / "merged").folder
    n = manifest(out)["n_episodes"]
    assert estimate(out) == json.loads((out / "estimates.json").read_text())
    assert replay(out, n - 1).bit_equal
    again = run_here(campaign(*TWIN, TWO_PHASE), out, resume=True)
    assert again.estimates == whole.estimates


def test_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    overrides = sets(*SMALL, *TWIN, "stop.rhw=2.0")
    quick = ["--workers", "1", "--quiet"]
    with one_process():
        assert main(["plan", str(MIXTURE_FILE), "--out", "plan", *overrides, *quick, "--json"]) == 0
        said = json.loads(capsys.readouterr().out)
        assert (said["n_first"], said["n_planned"]) == (manifest(Path("plan"))["n_episodes"], said["n_planned"])
        assert 0 < said["expected_rhw"] <= 2.0
        assert main(["plan", str(MIXTURE_FILE), "--out", "plan", *overrides, *quick, "--resume"]) == 0
        assert capsys.readouterr().out.startswith(f"Planned {said['n_planned']} tests after a first phase of ")
        assert main(["run", "plan", "--part", "1/1", "--out", "part", *quick]) == 0
        assert capsys.readouterr().out.startswith("part 1 of 1 (tests ")
    assert main(["merge", "part", "plan", "--out", "run", "--quiet"]) == 0
    assert "as many as the first phase had planned" in capsys.readouterr().out


def test_each_test_is_a_shard_of_its_own_unless_it_is_asked_for(tmp_path, monkeypatch, capsys):
    seen = []

    def taken(campaign, *_, **__):
        seen.append((campaign.run.shard_size, campaign.stop.rhw))
        raise HarnessError("here", found="enough", expected="no more", mend="")

    monkeypatch.setattr("harness.runner.plan_second_phase", taken)
    for more in ([], ["--set", "run.shard_size=16"]):
        complaint_of(capsys, "plan", MIXTURE_FILE, "--set", "testing.method=shells", "--out", tmp_path / "plan", *more)
    assert [size for size, _ in seen] == [1, 16]


# -- where the budget ends --


def test_a_first_phase_at_the_budget_plans_nothing(campaign, plan_here, tmp_path, capsys):
    found = plan_here(campaign(*TWIN, "stop.episodes=40"), tmp_path / "plan")
    assert (found.exit_code, found.n_first, found.n_planned) == (4, 40, 0)
    assert "stop.episodes was spent" in found.ending
    text = complaint_of(capsys, "run", tmp_path / "plan", "--part", "1/2", "--out", tmp_path / "part")
    assert "found: Stopped after 40 tests without stop.rhw (1.7)" in text
    more = plan_here(campaign(*TWIN), tmp_path / "plan", resume=True)
    assert (more.exit_code, manifest(tmp_path / "plan")["ending"]) == (0, None)


@pytest.mark.parametrize(("cut_ins", "planned", "expected"), [(100, False, math.inf), (250, True, 1.7)])
def test_a_pool_that_is_too_small(cut_ins, planned, expected, campaign, plan_here, tmp_path):
    """For the first phase already, or for what is asked of the second."""
    found = plan_here(campaign(*TWIN, f"pool.cut_ins_per_shell={cut_ins}"), tmp_path / "plan")
    assert (found.exit_code, found.n_planned > 0) == (4, planned)
    assert found.expected_rhw == pytest.approx(expected, rel=0.02)
    assert "raise pool.cut_ins_per_shell and use a new folder" in found.ending


@pytest.mark.parametrize("room", [0, 20])
def test_a_second_phase_that_the_budget_cuts(room, planned, campaign, run_here, plan_here, part_here, merged, tmp_path):
    """It is what one machine would have run; nobody is told that the precision is to be expected."""
    spent = (*TWIN, f"stop.episodes={manifest(planned[0])['n_episodes'] + room}")
    whole = run_here(campaign(*spent, TWO_PHASE), tmp_path / "whole")
    plan = plan_here(campaign(*spent), tmp_path / "plan")
    assert (plan.exit_code, whole.exit_code, plan.n_planned) == (4, 4, room)
    assert "raise it and go on with --resume" in plan.ending
    if room:
        part_here(tmp_path / "plan", 1, 1, tmp_path / "part")
        result = merged([tmp_path / "plan", tmp_path / "part"], tmp_path / "merged")
        assert (result.estimates, result.ending, result.exit_code) == (whole.estimates, whole.ending, 4)
        assert without_what_is_the_machines(result.folder) == without_what_is_the_machines(whole.folder)


def test_more_room_gives_another_plan(folders, campaign, plan_here, merged, tmp_path):
    """The first phase stands; parts of the plan before are refused."""
    plan, *parts = folders
    n = manifest(plan)["n_episodes"]
    shutil.rmtree(plan)
    cut = plan_here(campaign(*TWIN, f"stop.episodes={n + 20}"), plan)
    grown = plan_here(campaign(*TWIN, f"stop.episodes={n + 40}"), plan, resume=True)
    assert (cut.n_first, cut.n_planned, grown.n_first, grown.n_planned) == (n, 20, n, 40)
    with pytest.raises(RunFolderError, match=r"found plan .*; expected"):
        merged([plan, *parts], tmp_path / "merged")


# -- what is refused --


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("stop.rhw=null", r"stop\.rhw: found null, .* --set stop\.rhw=0\.3"),
        ("accept.crash_rate_below=1e-7", "accept: found a limit.* Delete accept"),
        ("testing.method=forced", "testing.method: found forced.* --set stop.rhw=null --part K/N"),
    ],
)
def test_campaigns_without_a_second_phase(override, said, campaign, plan_here, tmp_path):
    with pytest.raises(CampaignError, match=said):
        plan_here(campaign(*TWIN, override), tmp_path / "plan")
    assert not (tmp_path / "plan").exists()


def test_more_parts_than_shards(planned, tmp_path):
    plan = read_plan(planned[0])
    n_shards, n_tests = len(plan.specs()), sum(plan.second["tests"])
    said = rf"{n_tests} tests in {n_shards} shards, for {n_shards + 1} parts.*at most {n_shards} parts\. Or plan again"
    with pytest.raises(RunFolderError, match=f"{said}.* run.shard_size={n_tests // (n_shards + 1)}"):
        run_part(plan, Part(1, n_shards + 1), tmp_path / "part")
    assert not (tmp_path / "part").exists()


def test_a_plan_and_its_parts_each_once(planned, twin_run, merged, tmp_path):
    plan, one, two, three = planned
    for given, said in (
        ([one, two, three], "of plan .*expected its plan beside it"),
        ([plan, plan, one, two, three], "found 2 plans"),
        ([plan], "a plan by itself"),
        ([plan, two], r"found missing: part 1,3 of 3.*numbers: 1,3\)"),
        ([plan, one, one, two, three], "given twice: part 1 of 3"),
        ([plan, one, two, twin_run], "found a whole run"),
    ):
        with pytest.raises(RunFolderError, match=said):
            merged(given, tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def another_plan(plan: Path, part: Path) -> None:
    edit(part, plan={**manifest(part)["plan"], "drawn": [0] * len(manifest(part)["plan"]["drawn"])})


WRONG = {
    "unfinished": (lambda plan, part: edit(plan, status="interrupted"), "not finished: the plan"),
    "another_plan": (another_plan, "found plan "),
    "campaign": (lambda plan, part: edit(plan, campaign_hash="0" * 16), "expected 0000000000000000, as in"),
    "gap": (lambda plan, part: edit(plan, shards=manifest(plan)["shards"][:-1]), "a shard that begins at episode"),
    "lost": (lambda plan, part: shard_files(plan)[0].unlink(), "shard-000000.parquet: found no such file"),
    "strata": (lambda plan, part: (plan / "shells.json").unlink(), "shells.json"),
    "no_plan": (lambda plan, part: edit(plan, plan={"tests": [1], "drawn": []}), "manifest.json: found plan"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_does_not_belong_together_is_refused(wrong, folders, merged, tmp_path):
    damage, said = WRONG[wrong]
    damage(folders[0], folders[2])
    with pytest.raises((RunFolderError, FileNotFoundError), match=said):
        merged(folders, tmp_path / "merged")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["part1", "part2", "part3", "plan"]


def test_a_part_tests_what_was_planned_for(folders, part_here, tmp_path):
    plan, one, *_ = folders
    second = manifest(plan)["plan"]
    edit(plan, plan={**second, "pool": "f" * 24})
    with pytest.raises(RunFolderError, match="a plan for cut-ins of pool ffff"):
        part_here(plan, 1, 3, tmp_path / "part")
    with pytest.raises(RunFolderError, match=r"of plan .* of this campaign; expected part 1 of 3 .* of plan"):
        part_here(plan, 1, 3, one, resume=True)
    edit(plan, plan=second, controller_sha256="abc")
    with pytest.raises(RunFolderError, match="controller_sha256 abc"):
        part_here(plan, 1, 3, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_plan_says_what_it_is(planned, tmp_path, capsys):
    plan, one, *_ = map(str, planned)
    n_first, n_planned = manifest(planned[0])["n_episodes"], sum(manifest(planned[0])["plan"]["tests"])
    for command in ("estimate", "report"):
        text = complaint_of(capsys, command, plan)
        assert f"found: a plan of {n_planned} tests, after a first phase of {n_first} expected: a whole run" in text
        assert "--part K/N" in text
    assert "found: part 1 of 3" in complaint_of(capsys, "report", one)
    same = sets(*SMALL, *TWIN, TWO_PHASE)
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", plan, "--resume", *same)
    assert "found: a plan of this campaign expected: a whole run" in text
    for words, said in (
        (("run", plan), "a plan, without --part"),
        (("run", plan, "--part", "1/3", "--set", "stop.rhw=2"), "Leave out --set, or plan again"),
        (("run", plan, "--part", "1/3", "--av", "late-600ms"), "Leave out --av"),
        (("run", tmp_path, "--part", "1/3"), "this is no run folder"),
        (("run", plan, "--part", "1/3", "--junit", tmp_path / "a.xml"), "a part has no result"),
        (("plan", MIXTURE_FILE, "--resume", *same), "part 1 of 3"),
    ):
        out = one if words[0] == "plan" else tmp_path / "out"
        assert said in complaint_of(capsys, *words, "--out", out)
    assert replay(planned[0], 3).bit_equal
    assert stored_table(planned[0], "episodes").num_rows == n_first
