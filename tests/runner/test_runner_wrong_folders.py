"""Folders that are not what a command needs: exit code 2, the place named, nothing harmed."""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path

import pytest

from harness.cli import main
from harness.errors import RunFolderError
from harness.records.folder import read_manifest, require_place, sole_use
from harness.resolved import resolve
from harness.runner.manifest import require_own_folder
from tests.in_process import one_process, without_page
from tests.runner.conftest import MIXTURE_FILE, SMALL, TWIN, sets
from tests.stored_runs import copy_of, manifest, shard_files, truncate, unlike_columns

SAME = sets(*SMALL, *TWIN)


def complaint_of(capsys, *arguments: object) -> str:
    """What a call that must end with exit code 2 says."""
    assert main([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    return " ".join(err.split())


@pytest.fixture
def stored(twin_run, tmp_path):
    """A finished run of the campaign that `SAME` describes, to be damaged."""
    return copy_of(twin_run, tmp_path / "run")


# -- where a run may write --


def test_a_folder_of_another_campaign(stored, capsys, twin_run):
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", stored, *SAME, "--set", "seed=2")
    assert str(stored) in text
    assert "another campaign (overtaking-mixture," in text
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", stored, *SAME, "--set", "testing.epsilon=0.2", "--resume")
    assert "another campaign" in text
    assert unlike_columns(twin_run, stored) == []


def test_a_run_begun_already_needs_resume(stored, capsys, twin_run):
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", stored, *SAME)
    assert str(stored) in text
    assert "--resume" in text
    assert unlike_columns(twin_run, stored) == []


def test_a_part_of_a_run_as_earlier_versions_divided_it(stored, capsys):
    whole = manifest(stored)
    for kind in ("part", "plan"):
        (stored / "manifest.json").write_text(json.dumps({**whole, kind: {"number": 1}}))
        for command in (("estimate", stored), ("run", MIXTURE_FILE, "--out", stored, *SAME, "--resume")):
            assert f"a {kind} of a run" in complaint_of(capsys, *command)


@pytest.mark.parametrize("resume", [[], ["--resume"]])
def test_a_folder_with_foreign_files(resume, tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("three years of work")
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", tmp_path, *SAME, *resume)
    assert str(tmp_path) in text
    assert "other files" in text
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_folder_with_somebody_elses_manifest(tmp_path, capsys):
    (tmp_path / "manifest.json").write_text('{"short_name": "a web page"}')
    said = complaint_of(capsys, "run", MIXTURE_FILE, "--out", tmp_path, *SAME, "--resume")
    assert "no key campaign_hash" in said
    assert "another folder with --out" in said
    for command in (("estimate", tmp_path), ("report", tmp_path), ("replay", tmp_path, 0)):
        assert str(tmp_path) in complaint_of(capsys, *command)


def test_fewer_tests_than_are_there_are_refused(stored, capsys, twin_run):
    """A forgotten --set must not cost finished tests."""
    before = (stored / "manifest.json").read_bytes()
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", stored, *SAME, "--set", "stop.episodes=150", "--resume")
    assert "400 finished tests" in text
    assert "150" in text
    assert (stored / "manifest.json").read_bytes() == before
    assert unlike_columns(twin_run, stored) == []


def test_a_refused_resumption_leaves_the_manifest(stored, capsys):
    """What was finished is still listed, so that an estimate cannot pass over a shard that was deleted meanwhile."""
    broken = shard_files(stored)[1]
    truncate(broken)
    complaint_of(capsys, "run", MIXTURE_FILE, "--out", stored, *SAME, "--resume")
    broken.unlink()
    assert str(broken) in complaint_of(capsys, "estimate", stored)


CONTROLLER = """
class Careful:
    def start(self, episode): pass
    def step(self, seen): return {acceleration}
    def close(self): pass
"""


@one_process()
@without_page()
def test_another_version_of_the_controller_is_refused(tmp_path, capsys, monkeypatch):
    file = tmp_path / "versioned_controller.py"
    file.write_text(CONTROLLER.format(acceleration=-2.0))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [str(tmp_path), *sys.path])
    changes = sets("av={}", "av.controller=versioned_controller:Careful", "stop.episodes=20")
    settings = [*SAME, *changes, "--workers", "1", "--quiet"]
    out = tmp_path / "run"
    assert main(["run", str(MIXTURE_FILE), "--out", str(out), *settings]) == 0
    capsys.readouterr()
    file.write_text(CONTROLLER.format(acceleration=-3.0))
    more = [*settings, "--set", "stop.episodes=40", "--resume"]
    assert "source file has been changed" in complaint_of(capsys, "run", MIXTURE_FILE, "--out", out, *more)
    file.write_text(CONTROLLER.format(acceleration=-2.0))
    assert main(["run", str(MIXTURE_FILE), "--out", str(out), *more]) == 0


@pytest.mark.parametrize("place", ["file/run", "file/deeper/run", "/proc/run"])
def test_a_folder_that_cannot_be_made(place, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("not a folder")
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", place, *SAME)
    assert f"error: {place} found: a place where nothing can be written" in text
    assert place in complaint_of(capsys, "compare", MIXTURE_FILE, "--against", "av.model=fvdm", "--out", place)


def test_a_place_is_tried_without_leaving_anything(tmp_path):
    require_place(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []


def test_two_processes_do_not_run_into_one_folder(stored, capsys, twin_run, tmp_path):
    more = ("--resume", "--set", "stop.episodes=480")
    with sole_use(stored):
        text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", stored, *SAME, *more)
    assert f"{stored} found: a folder into which another process is running" in text
    assert unlike_columns(twin_run, stored) == []
    assert manifest(stored) == manifest(twin_run)


def test_a_folder_in_which_nothing_was_run_goes_again(tmp_path):
    (tmp_path / "there").mkdir()
    for place in (tmp_path / "a" / "b", tmp_path / "there"):
        with pytest.raises(ZeroDivisionError), sole_use(place):
            _ = 1 / 0
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


# -- damaged records --


@pytest.mark.parametrize("damage", [truncate, Path.unlink])
def test_a_truncated_or_missing_shard(damage, stored, capsys):
    broken = shard_files(stored)[1]
    damage(broken)
    for command in (("estimate", stored), ("report", stored), ("replay", stored, 150)):
        assert str(broken) in complaint_of(capsys, *command)


@pytest.mark.parametrize("command", [["report"], ["replay", 150]])
def test_a_missing_traces_file(command, stored, capsys, run_here, campaign, twin_run):
    """Its episodes file says that the shard is finished: only without both the shard is made anew."""
    gone = shard_files(stored, "traces")[1]
    gone.unlink()
    text = complaint_of(capsys, command[0], stored, *command[1:])
    assert f"{gone} found: no such file" in text
    assert "Delete all files of this shard" in text
    for path in stored.glob(f"*/{gone.name}"):
        path.unlink()
    run_here(campaign(*TWIN), stored, resume=True)
    assert unlike_columns(twin_run, stored) == []


def test_missing_estimates_and_their_mend(stored, capsys, twin_run):
    (stored / "estimates.json").unlink()
    assert f"`harness estimate {stored} --write`" in complaint_of(capsys, "report", stored)
    assert main(["estimate", str(stored), "--write", "--json"]) == 0
    assert (stored / "estimates.json").read_text() == (twin_run / "estimates.json").read_text()


def test_a_run_without_an_episode(stored, capsys):
    path = stored / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "n_episodes": 0, "shards": []}))
    for command in (("estimate", stored), ("replay", stored, 0)):
        text = complaint_of(capsys, *command)
        assert "has not finished an episode yet" in text
        assert "--resume" in text


@pytest.mark.parametrize("table", ["episodes", "moments", "traces"])
def test_resuming_with_a_truncated_shard_names_it_and_its_mend_works(
    table, stored, capsys, run_here, campaign, twin_run
):
    broken = shard_files(stored, table)[1]
    truncate(broken)
    text = complaint_of(capsys, "run", MIXTURE_FILE, "--out", stored, *SAME, "--resume")
    assert str(broken) in text
    assert "Delete all files of this shard" in text
    for path in stored.glob(f"*/{broken.name}"):
        path.unlink()
    run_here(campaign(*TWIN), stored, resume=True)
    assert unlike_columns(twin_run, stored) == []


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *(("manifest.json", content) for content in (None, "{", "{}", "[]", '{"shards": 5}')),
        *(("campaign.yaml", content) for content in (None, "{", "{}")),
    ],
)
def test_a_missing_or_damaged_manifest_or_campaign(name, content, stored, capsys):
    path = stored / name
    path.unlink()
    if content is not None:
        path.write_text(content)
    for command in (["estimate"], ["report"], ["replay", 0]):
        text = complaint_of(capsys, command[0], stored, *command[1:])
        assert (str(path) in text, text.count("error:"), "Errno" in text) == (True, 1, False)
    if name == "manifest.json":
        assert "Give a folder that `harness run` has written" in text


def test_a_manifest_cut_anywhere_is_named_and_nothing_is_touched(stored, campaign):
    """Nothing of it is taken for the whole: neither read nor gone on with."""
    path, resolved = stored / "manifest.json", resolve(campaign(*TWIN))
    whole = path.read_bytes()
    files = sorted(stored.rglob("*"))
    for n in (*range(0, len(whole) - len(b"}\n"), 7), len(whole) - len(b"}\n")):
        path.write_bytes(whole[:n])
        for read in (read_manifest, partial(require_own_folder, resolved=resolved, resume=True)):
            with pytest.raises(RunFolderError) as raised:
                read(stored)
            assert raised.value.where == str(path)
    path.write_bytes(whole.rstrip())
    assert require_own_folder(stored, resolved, resume=True) == json.loads(whole)
    assert sorted(stored.rglob("*")) == files


def test_a_folder_that_is_not_there(tmp_path, capsys):
    for command in (("estimate", tmp_path / "no"), ("report", tmp_path / "no"), ("replay", tmp_path / "no", 0)):
        assert str(tmp_path / "no") in complaint_of(capsys, *command)


def test_an_episode_that_was_not_run(twin_run, capsys):
    text = complaint_of(capsys, "replay", twin_run, 400)
    assert "no episode 400" in text
    assert "from 0 to 399" in text


def test_a_campaign_that_was_changed_after_the_run(stored, capsys):
    path = stored / "campaign.yaml"
    path.write_text(path.read_text().replace("seed: 1", "seed: 2"))
    assert str(path) in complaint_of(capsys, "replay", stored, 3)


def test_a_manifest_that_counts_more_than_there_is(stored, capsys):
    path = stored / "manifest.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "n_episodes": 500}))
    assert "400 episodes on record" in complaint_of(capsys, "estimate", stored)
