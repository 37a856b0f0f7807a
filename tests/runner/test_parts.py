"""Parts of a run: the tests of a whole run, bit for bit, whatever made them; what is no part of it is refused."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness import estimate, replay
from harness.cli import main
from harness.errors import CampaignError, HarnessError, RunFolderError, TooManyFailedError
from harness.part import Part
from harness.records.folder import TABLES
from harness.runner import run_part
from harness.runner.manifest import Prefix
from harness.runner.merge import ranges
from tests.runner.conftest import MIXTURE_FILE, TWIN
from tests.runner.stored_runs import copy_of, manifest, shard_files, truncate, unlike_columns
from tests.runner.test_runner_same_bits import struck_run
from tests.runner.test_runner_wrong_folders import SAME, complaint_of

METHODS = {
    "nde": ("testing.method=nde", "environment.lane_change_level=1e6", "av={model: fvdm}"),
    "forced": ("testing.method=forced", "av={model: fvdm}"),
    "published": ("testing.method=step_mixture", "testing.challenge=immediate", "stop.estimator=scv"),
}
OF_THE_MACHINE = {"created", "wall_time_s", "workers", "results"}


@pytest.fixture(scope="module")
def finished_parts(campaign, part_here, tmp_path_factory):
    """The three parts of `twin_run`. Never written to."""
    folder = tmp_path_factory.mktemp("parts")
    for number in (1, 2, 3):
        part_here(campaign(*TWIN), number, 3, folder / f"part{number}")
    return [folder / f"part{number}" for number in (1, 2, 3)]


@pytest.fixture
def parts(finished_parts, tmp_path):
    """The same, to be damaged."""
    return [copy_of(part, tmp_path / part.name) for part in finished_parts]


def edit(folder: Path, **keys) -> None:
    (folder / "manifest.json").write_text(json.dumps({**manifest(folder), **keys}))


def without_what_is_the_machines(folder: Path) -> dict:
    return {key: value for key, value in manifest(folder).items() if key not in OF_THE_MACHINE}


# -- the same bits --


@pytest.mark.parametrize("method", METHODS)
def test_merged_parts_are_the_whole_run(method, campaign, run_here, part_here, merged, tmp_path):
    of_method = campaign(*TWIN, *METHODS[method])
    whole = run_here(of_method, tmp_path / "whole")
    for number in (2, 4, 1, 3):
        part_here(of_method, number, 4, tmp_path / f"part{number}")
    result = merged([tmp_path / f"part{number}" for number in (3, 1, 4, 2)], tmp_path / "merged")
    assert whole.estimates["n_crashes"] > 0
    assert unlike_columns(whole.folder, result.folder) == []
    assert without_what_is_the_machines(result.folder) == without_what_is_the_machines(whole.folder)
    files, merged_files = (
        [path.relative_to(folder) for table in TABLES for path in shard_files(folder, table)]
        for folder in (whole.folder, result.folder)
    )
    assert merged_files == files
    assert all((whole.folder / file).read_bytes() == (result.folder / file).read_bytes() for file in files)
    assert (result.estimates, result.ending, result.exit_code) == (whole.estimates, whole.ending, whole.exit_code)


def test_in_sumo_with_a_part_that_was_killed(sumo_run, campaign, part_here, merged, tmp_path):
    parts = [tmp_path / f"part{number}" for number in (1, 2, 3)]
    killed = struck_run(parts[1], signal.SIGKILL, 2, "--part", "2/3")
    assert killed.returncode == -signal.SIGKILL
    assert len(shard_files(parts[1])) == 1
    for number in (1, 3):
        part_here(campaign("world.cells=64"), number, 3, parts[number - 1], resume=True)  # as job scripts do
    with pytest.raises(RunFolderError, match="not finished: part 2 of 3"):
        merged(parts, tmp_path / "merged")
    part_here(campaign("world.cells=32"), 2, 3, parts[1], resume=True)
    merged(parts, tmp_path / "merged")
    assert unlike_columns(sumo_run, tmp_path / "merged") == []


def test_a_vehicle_that_fails_now_and_then(campaign, run_here, part_here, merged, tmp_path):
    """2 of 400 tests fail, which the whole may, but 2 of 160 in the second part; the first repeats some tests."""
    vehicle = (
        "av={controller: 'tests.controllers.misbehaving:Misbehaving', parameters: {bad: {'100': nan, '101': nan}}}"
    )
    of_vehicle = campaign(*TWIN, "testing.method=forced", vehicle)
    whole = run_here(of_vehicle, tmp_path / "whole")
    parts = [tmp_path / f"part{number}" for number in (1, 2, 3)]
    done = [part_here(of_vehicle, number, 3, part) for number, part in enumerate(parts, 1)]
    assert [part.n_failed for part in done] == [0, 2, 0]
    result = merged(parts, tmp_path / "merged")
    assert unlike_columns(whole.folder, result.folder) == []
    assert without_what_is_the_machines(result.folder) == without_what_is_the_machines(whole.folder)
    assert manifest(result.folder)["repeated"]["n_episodes"] > 0


@given(st.integers(1, 500).flatmap(lambda of: st.tuples(st.just(of), st.integers(of, 5000))))
def test_parts_tile_the_shards_evenly(sizes):
    of, n_shards = sizes
    bounds = [Part(number, of).bounds(n_shards) for number in range(1, of + 1)]
    assert (bounds[0][0], bounds[-1][1]) == (0, n_shards)
    assert all(a[1] == b[0] for a, b in pairwise(bounds))
    assert {end - begin for begin, end in bounds} <= {n_shards // of, -(-n_shards // of)}


@given(st.sets(st.integers(1, 60), min_size=1))
def test_ranges_as_a_job_array_takes_them(numbers):
    told = [each.split("-") for each in ranges(sorted(numbers)).split(",")]
    assert [n for each in told for n in range(int(each[0]), int(each[-1]) + 1)] == sorted(numbers)
    assert ranges([1, 2, 3, 7, 9, 10]) == "1-3,7,9-10"


# -- what merged parts are good for --


def test_merged_parts_can_be_continued_replayed_and_estimated(parts, merged, campaign, run_here, tmp_path):
    out = merged(parts, tmp_path / "merged").folder
    shutil.rmtree(parts[0])  # links: nobody needs the parts any more
    assert estimate(out) == json.loads((out / "estimates.json").read_text())
    assert replay(out, 250).bit_equal is True
    kept = {path.name: path.read_bytes() for path in shard_files(out)}
    more = run_here(campaign(*TWIN, "stop.episodes=480"), out, resume=True)
    assert more.estimates["n_episodes"] == 480
    assert {path.name: path.read_bytes() for path in shard_files(out)[:-1]} == kept
    assert len(shard_files(parts[1])) == 2


def test_the_command_line(parts, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["merge", "part3", "part2", "part1", "--out", "runs/merged"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert "Stopped after 400 tests: stop.episodes was all that was asked for." in said
    assert said[-2:] == ["runs/merged/report.html", "runs/merged/estimates.json"]
    page = Path("runs/merged/report.html").read_text()
    assert "harness replay runs/merged " in page
    assert ".part/" not in page
    assert [path.name for path in Path("runs").iterdir()] == ["merged"]


def test_a_part_says_what_it_has_done(part_here, campaign, tmp_path, capsys):
    done = part_here(campaign(*TWIN), 2, 3, tmp_path / "part")
    assert done.kind == "part 2 of 3 (tests 80 to 239)"
    rows = manifest(tmp_path / "part")
    assert (rows["n_episodes"], rows["status"], len(rows["shards"])) == (160, "done", 2)
    assert done.n_crashes > 0 == done.n_failed
    assert not (tmp_path / "part" / "estimates.json").exists()


def test_parts_are_copied_where_there_are_no_links(parts, merged, twin_run, tmp_path, monkeypatch):
    def no_links(*_):
        raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))

    monkeypatch.setattr(os, "link", no_links)
    merged(parts, tmp_path / "merged")
    assert unlike_columns(twin_run, tmp_path / "merged") == []
    assert all(path.stat().st_nlink == 1 for path in shard_files(tmp_path / "merged"))


# -- what is refused --


@pytest.mark.parametrize("place", ["harness.records.folder.shutil.copyfile", "harness.runner.merge.write_json"])
def test_a_full_disk_leaves_no_folder(place, parts, tmp_path, capsys, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "link", full)
    monkeypatch.setattr(place, full)
    text = complaint_of(capsys, "merge", *parts, "--out", tmp_path / "merged")
    assert "no space left" in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["part1", "part2", "part3"]


def other_rows(part: Path) -> None:
    edit(part, shards=[{**shard, "n_episodes": 79} for shard in manifest(part)["shards"]])


def another_stop(part: Path) -> None:
    text = (part / "campaign.yaml").read_text()
    (part / "campaign.yaml").write_text(text.replace("confidence: 0.9", "confidence: 0.8"))


def of_four(part: Path) -> None:
    edit(part, part={**manifest(part)["part"], "of": 4})


WRONG = {
    "campaign": (lambda part: edit(part, campaign_hash="0" * 16), "campaign 0000000000000000; expected {hash}"),
    "harness": (lambda part: edit(part, versions={**manifest(part)["versions"], "harness": "0.0"}), "harness 0.0"),
    "controller": (lambda part: edit(part, controller_sha256="abc"), "a controller's source file with hash abc"),
    "of": (of_four, "a number of parts of 4"),
    "no_campaign": (lambda part: (part / "campaign.yaml").unlink(), "campaign.yaml: found no such file"),
    "stop": (another_stop, "campaign.yaml: found stop: .*confidence=0.8"),
    "unfinished": (lambda part: edit(part, status="interrupted"), "not finished: part 2 of 3"),
    "whole": (lambda part: edit(part, part=None), "found a whole run"),
    "cut": (lambda part: truncate(part / "manifest.json"), "manifest.json: found"),
    "no_cpu": (lambda part: edit(part, cpu=None), "manifest.json: found cpu None"),
    "damaged": (lambda part: truncate(shard_files(part)[0]), "shard-000001.parquet: found a file that cannot be read"),
    "lost": (lambda part: shard_files(part, "traces")[1].unlink(), "traces/shard-000002.parquet: found no such file"),
    "rows": (other_rows, "shard-000001.parquet: found 80 rows; expected 79"),
    "gap": (lambda part: edit(part, shards=manifest(part)["shards"][1:]), "found a shard that begins at episode 160"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_part_of_something_else_is_refused_and_named(wrong, parts, merged, tmp_path):
    damage, said = WRONG[wrong]
    damage(parts[1])
    with pytest.raises(HarnessError, match=said.format(hash=manifest(parts[0])["campaign_hash"])) as refused:
        merged(parts, tmp_path / "merged")
    assert refused.value.where.startswith(str(parts[1]))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["part1", "part2", "part3"]


def test_the_version_of_sumo_counts_where_sumo_ran(parts, merged, tmp_path):
    edit(parts[1], versions={**manifest(parts[1])["versions"], "libsumo": "0.1", "numpy": "9.9"})
    versions = manifest(merged(parts, tmp_path / "merged").folder)["versions"]
    assert versions["numpy"].endswith(", 9.9")
    for part in parts:
        edit(part, engine="sumo")
    with pytest.raises(RunFolderError, match=r"found libsumo 0\.1"):
        merged(parts, tmp_path / "again")


def test_each_part_once_and_a_new_folder(finished_parts, merged, tmp_path):
    one, two, three = finished_parts
    with pytest.raises(RunFolderError, match=r"found missing: part 1,3 of 3.*numbers: 1,3\)"):
        merged([two], tmp_path / "merged")
    with pytest.raises(RunFolderError, match="given twice: part 2 of 3"):
        merged([two, one, two, three], tmp_path / "merged")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunFolderError, match="expected a new name"):
        merged(finished_parts, tmp_path / "empty")


def test_too_many_failures_in_all_parts_together(parts, merged, tmp_path, monkeypatch):
    monkeypatch.setattr("harness.runner.merge._checked", lambda *_: {"broke": 1})
    with pytest.raises(TooManyFailedError, match="5 of 400 episodes failed, 5 of them with: broke"):
        merged(parts, tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_a_part_is_not_refused_for_failures_that_chance_may_bring(campaign):
    """Of 64 parts of 100 tests with a share of 1 % a quarter have more than that; 20 % is no chance."""
    few, many = Prefix(of_part=True), Prefix(of_part=True)
    few.n_episodes, few.n_failed = 100, 4
    many.n_episodes, many.n_failed = 100, 20
    few.require_few_failed(campaign())
    with pytest.raises(TooManyFailedError, match="20 of 100"):
        many.require_few_failed(campaign())
    few.of_part = False
    with pytest.raises(TooManyFailedError, match="4 of 100"):
        few.require_few_failed(campaign())


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("stop.rhw=0.3", "stop.rhw: found 0.3, .* --set stop.rhw=null"),
        ("testing.method=shells", "testing.method: found shells"),
        (
            "stop.episodes=239",
            r"run\.shard_size: found 80, .* makes 3 in all, for 4 parts.* at most 3 parts\. Or .* run\.shard_size=59 ",
        ),
        ("stop.episodes=3", r"run\.shard_size: found 80, .* makes 1 in all, for 4 parts.* at most 1 part\.$"),
    ],
)
def test_campaigns_whose_tests_are_not_known_beforehand(override, said, campaign, tmp_path):
    with pytest.raises(CampaignError, match=said):
        run_part(campaign(override), Part(1, 4), tmp_path / "part")
    assert not (tmp_path / "part").exists()


@pytest.mark.parametrize("part", ["0/4", "5/4", "3", "a/b", "-1/4", "1/0"])
def test_no_such_part(part, tmp_path, capsys):
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", tmp_path / "part", "--part", part)
    assert f"--part found: {part} " in text
    assert "from 1 to N" in text


def test_a_folder_keeps_to_its_part(parts, twin_run, tmp_path, capsys):
    two, whole = parts[1], copy_of(twin_run, tmp_path / "whole")
    held = "part 2 of 3 (tests 80 to 239)"
    for asked in ([], ["--part", "3/3"], ["--part", "2/4"]):
        text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", two, *SAME, "--resume", *asked)
        assert f"found: {held} of this campaign" in text
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", whole, *SAME, "--resume", "--part", "2/3")
    assert f"found: a whole run of this campaign expected: {held}" in text
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", two, *SAME, "--part", "2/3")
    assert "--resume" in text
    for command in ("estimate", "rnot"):
        text = complaint_of(capsys, command, two)
        assert f"found: {held} expected: a whole run" in text
        assert "harness merge" in text
