"""Folders that are not what a command needs: exit code 2, the place named, nothing harmed, never a traceback."""

from __future__ import annotations

import copy
import json
from functools import partial
from pathlib import Path

import pytest

from harness.cli import main
from harness.errors import RunFolderError
from harness.records.folder import read_as, read_manifest, require_place, sole_use, write_json
from harness.report.summary import read_run_folder
from harness.resolved import resolve
from harness.runner.resume import require_own_folder
from harness.strata import StoredDesign
from tests.golden.campaigns import BASE, RUNS
from tests.in_process import run_here
from tests.stored_runs import copy_of, golden, manifest, sets, shard_files, truncate, unlike_columns

NAME = "mixture-twin"
RUN = ("run", BASE, *sets(*RUNS[NAME]), "--out")


@pytest.fixture
def whole(stored_run):
    """240 tests in three shards."""
    return stored_run(NAME)


@pytest.fixture
def stored(whole, tmp_path):
    """A copy, to be damaged."""
    return copy_of(whole, tmp_path / "run")


@pytest.fixture
def complaint_of(capsys):
    """What a call that must end with exit code 2 says."""

    def complaint(*arguments: object) -> str:
        assert main([str(argument) for argument in arguments]) == 2
        out, err = capsys.readouterr()
        assert (out, "Traceback" in err, err.count("error:")) == ("", False, 1)
        return " ".join(err.split())

    return complaint


# -- where a run may write --


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ((), "--resume"),
        (("--set", "seed=2"), "another campaign (golden,"),
        (("--set", "testing.epsilon=0.2", "--resume"), "another campaign"),
        (("--set", "stop.episodes=150", "--resume"), "240 finished tests"),
    ],
)
def test_a_folder_of_a_run_is_not_written_over(more, said, stored, complaint_of, whole):
    complaint = complaint_of(*RUN, stored, *more)
    assert str(stored) in complaint
    assert said in complaint
    assert unlike_columns(whole, stored) == []
    assert manifest(stored) == manifest(whole)


def test_a_part_of_a_run_as_earlier_versions_divided_it(stored, complaint_of):
    for kind in ("part", "plan"):
        (stored / "manifest.json").write_text(json.dumps({**manifest(stored), kind: {"number": 1}}))
        for command in (("estimate", stored), (*RUN, stored, "--resume")):
            assert f"a {kind} of a run" in complaint_of(*command)
        (stored / "manifest.json").write_text(json.dumps({k: v for k, v in manifest(stored).items() if k != kind}))


@pytest.mark.parametrize("resume", [(), ("--resume",)])
def test_a_folder_of_somebody_else(resume, tmp_path, complaint_of):
    (tmp_path / "thesis.tex").write_text("three years of work")
    assert "other files" in complaint_of(*RUN, tmp_path, *resume)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    (tmp_path / "manifest.json").write_text('{"short_name": "a web page"}')
    for command in (
        (*RUN, tmp_path, "--resume"),
        ("estimate", tmp_path),
        ("report", tmp_path),
        ("replay", tmp_path, 0),
    ):
        assert str(tmp_path) in complaint_of(*command)


@pytest.mark.parametrize("place", ["file/run", "file/deeper/run", "/proc/run"])
def test_a_folder_that_cannot_be_made(place, tmp_path, complaint_of, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("not a folder")
    assert f"error: {place} found: a place where nothing can be written" in complaint_of(*RUN, place)
    assert place in complaint_of(
        "compare", BASE, "--set", "testing.method=shells", "--against", "av.model=fvdm", "--out", place
    )


def test_a_place_is_tried_without_leaving_anything(tmp_path):
    require_place(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "there").mkdir()
    for place in (tmp_path / "a" / "b", tmp_path / "there"):
        with pytest.raises(ZeroDivisionError), sole_use(place):
            _ = 1 / 0
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_two_processes_do_not_run_into_one_folder(stored, complaint_of, whole):
    with sole_use(stored):
        said = complaint_of(*RUN, stored, "--resume", "--set", "stop.episodes=320")
    assert f"{stored} found: a folder into which another process is running" in said
    assert unlike_columns(whole, stored) == []


CONTROLLER = """
class Careful:
    def start(self, episode): pass
    def step(self, seen): return {acceleration}
    def close(self): pass
"""


def test_another_version_of_the_controller_is_refused(tmp_path, complaint_of, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    file, out = tmp_path / "versioned_controller.py", tmp_path / "run"
    settings = ("av={controller: 'versioned_controller:Careful'}", "world.engine=twin", "stop.episodes=20")
    file.write_text(CONTROLLER.format(acceleration=-2.0))
    run_here(golden("forced-twin", *settings), out)
    file.write_text(CONTROLLER.format(acceleration=-3.0))
    with pytest.raises(RunFolderError, match="source file has been changed"):
        run_here(golden("forced-twin", *settings, "stop.episodes=40"), out, resume=True)
    file.write_text(CONTROLLER.format(acceleration=-2.0))
    assert run_here(golden("forced-twin", *settings, "stop.episodes=40"), out, resume=True).exit_code == 0


# -- damaged records --


@pytest.mark.parametrize("damage", [truncate, Path.unlink])
def test_a_truncated_or_missing_shard(damage, stored, complaint_of):
    broken = shard_files(stored)[1]
    damage(broken)
    for command in (("estimate", stored), ("report", stored), ("replay", stored, 100)):
        assert str(broken) in complaint_of(*command)


@pytest.mark.parametrize("table", ["episodes", "moments", "traces"])
def test_resuming_with_a_truncated_shard_names_it_and_its_mend_works(table, stored, complaint_of, whole):
    """Finished tests stay in the manifest, so that no estimate passes over a shard that was deleted meanwhile."""
    broken = shard_files(stored, table)[1]
    truncate(broken)
    said = complaint_of(*RUN, stored, "--resume")
    assert str(broken) in said
    assert "Delete all files of this shard" in said
    for path in stored.glob(f"*/{broken.name}"):
        path.unlink()
    assert broken.name in complaint_of("estimate", stored)
    run_here(golden(NAME), stored, resume=True)
    assert unlike_columns(whole, stored) == []


def test_a_missing_traces_file(stored, complaint_of):
    """Its episodes file says that the shard is finished."""
    gone = shard_files(stored, "traces")[1]
    gone.unlink()
    for command in (("report", stored), ("replay", stored, 100)):
        assert f"{gone} found: no such file" in complaint_of(*command)


def test_missing_estimates_and_their_mend(stored, complaint_of, whole):
    (stored / "estimates.json").unlink()
    assert f"`harness estimate {stored} --write`" in complaint_of("report", stored)
    assert main(["estimate", str(stored), "--write", "--json"]) == 0
    assert (stored / "estimates.json").read_text() == (whole / "estimates.json").read_text()


def test_a_run_without_an_episode(stored, complaint_of):
    (stored / "manifest.json").write_text(json.dumps({**manifest(stored), "n_episodes": 0, "shards": []}))
    for command in (("estimate", stored), ("replay", stored, 0)):
        assert "has not finished an episode yet" in complaint_of(*command)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *(("manifest.json", content) for content in (None, "{", "{}", "[]", '{"shards": 5}')),
        *(("campaign.yaml", content) for content in (None, "{", "{}")),
    ],
)
def test_a_missing_or_damaged_manifest_or_campaign(name, content, stored, complaint_of):
    path = stored / name
    path.unlink()
    if content is not None:
        path.write_text(content)
    for command in (("estimate", stored), ("report", stored), ("replay", stored, 0)):
        said = complaint_of(*command)
        assert (str(path) in said, "Errno" in said) == (True, False)


def test_a_manifest_cut_anywhere_is_named_and_nothing_is_touched(stored):
    """Nothing of it is taken for the whole: neither read nor gone on with."""
    path, resolved = stored / "manifest.json", resolve(golden(NAME))
    content, files = path.read_bytes(), sorted(stored.rglob("*"))
    for n in (*range(0, len(content) - len(b"}\n"), 17), len(content) - len(b"}\n")):
        path.write_bytes(content[:n])
        for read in (read_manifest, partial(require_own_folder, resolved=resolved, resume=True)):
            with pytest.raises(RunFolderError) as raised:
                read(stored)
            assert raised.value.where == str(path)
    path.write_bytes(content.rstrip())
    assert require_own_folder(stored, resolved, resume=True) == json.loads(content)
    assert sorted(stored.rglob("*")) == files


@pytest.mark.parametrize(
    ("change", "command", "said"),
    [
        (lambda folder: folder.rename(folder.parent / "gone"), ("estimate",), "run"),
        (lambda folder: None, ("replay", 400), "from 0 to 239"),
        (lambda folder: _replace(folder / "campaign.yaml", "seed: 1", "seed: 2"), ("replay", 3), "campaign.yaml"),
        (lambda folder: _replace(folder / "manifest.json", 's": 240', 's": 500'), ("estimate",), "240 episodes"),
    ],
    ids=["no folder", "no such test", "another campaign", "fewer tests than counted"],
)
def test_what_is_not_as_it_was_left(change, command, said, stored, complaint_of):
    change(stored)
    complaint = complaint_of(command[0], stored, *command[1:])
    assert str(stored) in complaint
    assert said in complaint


def _replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


# -- JSON with wrong types --

WRONG = [True, -1, 0.5, 10**400, "text", "\0", [1], {"x": 1}, [None], float("nan")]
UNREAD = {"format", "n_equal"}
"""Keys that no reader looks at."""


def places(content, path=()):
    """Paths to all values, at any depth, with the values; of a list only the first."""
    items = list(content.items()) if isinstance(content, dict) else list(enumerate(content))[:1]
    for key, value in items:
        yield (*path, key), value
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


def replaced(content, path, value):
    changed = copy.deepcopy(content)
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return changed


def is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)


def of_one_kind(a, b):
    return type(a) is type(b) or (is_number(a) and is_number(b)) or None in (a, b)


def test_every_value_of_another_kind_is_refused(stored):
    path, content, n_refused = stored / "manifest.json", manifest(stored), 0
    others = [
        *((("n_episodes",), wrong) for wrong in (-1, 0.5, 10**400)),
        *((("shards", 0, "files", "episodes"), wrong) for wrong in ("../../etc/passwd", "episodes/\0.parquet", None)),
        *((("distance_per_test_m",), float("nan")), (("shards",), None), (("stopped_by",), "the moon")),
    ]
    of_kinds = [(place, value) for place, value in places(content) if place[-1] not in UNREAD]
    others += [(place, wrong) for place, value in of_kinds for wrong in WRONG if not of_one_kind(value, wrong)]
    for place, wrong in others:
        path.write_text(json.dumps(replaced(content, place, wrong)), encoding="utf-8")
        with pytest.raises(RunFolderError) as raised:
            read_manifest(stored)
        assert str(path) in str(raised.value), (place, wrong)
        assert len(str(raised.value)) < 1500
        n_refused += 1
    assert n_refused > 200


def test_estimates_of_wrong_types_are_refused(stored):
    path = stored / "estimates.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    for key in ("campaign", "headline", "estimates", "confidence", "lane_change_level", "convergence", "diagnostics"):
        for wrong in ([1], "text" if key not in ("campaign", "headline") else 1, True):
            path.write_text(json.dumps({**content, key: wrong}), encoding="utf-8")
            with pytest.raises(RunFolderError, match=r"estimates\.json"):
                read_run_folder(stored)


def test_shells_are_checked(stored_run, tmp_path):
    shells = json.loads((stored_run("shells-twin") / "shells.json").read_text())
    read_as(StoredDesign, stored_run("shells-twin") / "shells.json", mend="")
    for wrong in (*({key: {}} for key in shells), {"cell_p": [0.1]}, {"statements": []}, {"reference_rate": []}):
        write_json(tmp_path / "shells.json", {**shells, **wrong})
        with pytest.raises(RunFolderError):
            read_as(StoredDesign, tmp_path / "shells.json", mend="")
