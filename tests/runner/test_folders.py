"""Folders that are not what a command needs: exit code 2, the place named, nothing harmed, never a traceback."""

from __future__ import annotations

import errno
import shutil

import pyarrow.parquet as pq
import pytest

from harness.cli import main
from harness.commands.printing import system_error
from harness.errors import RunFolderError
from harness.records.folder import read_manifest, require_place, sole_use
from tests.golden.campaigns import BASE, RUNS
from tests.in_process import run_here
from tests.stored_runs import copy_of, edit, golden, manifest, part_files, sets, truncate, unlike_columns, unnoted

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
        assert (out, "Traceback" in err, "Errno" in err, err.count("error:")) == ("", False, False, 1)
        return " ".join(err.split())

    return complaint


# -- where a run may write --


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ((), "--resume"),
        (("--set", "seed=2"), "another campaign, golden: seed 1"),
        (("--set", "testing.epsilon=0.2", "--resume"), "another campaign, golden: testing.epsilon "),
        (("--set", "stop.episodes=150", "--resume"), "240 finished tests"),
    ],
)
def test_a_folder_of_a_run_is_not_written_over(more, said, stored, complaint_of, whole):
    complaint = complaint_of(*RUN, stored, *more)
    assert str(stored) in complaint
    assert said in complaint
    assert unlike_columns(whole, stored) == []
    assert manifest(stored) == manifest(whole)


def test_a_folder_of_somebody_else(tmp_path, complaint_of):
    (tmp_path / "thesis.tex").write_text("three years of work")
    for resume in ((), ("--resume",)):
        assert "other files" in complaint_of(*RUN, tmp_path, *resume)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    (tmp_path / "manifest.json").write_text('{"short_name": "a web page"}')
    for command in ((*RUN, tmp_path, "--resume"), ("estimate", tmp_path)):
        assert str(tmp_path) in complaint_of(*command)


def test_two_processes_do_not_run_into_one_folder(stored, complaint_of, whole):
    with sole_use(stored):
        said = complaint_of(*RUN, stored, "--resume", "--set", "stop.episodes=320")
    assert f"{stored} found: a folder into which another process is running" in said
    assert unlike_columns(whole, stored) == []


@pytest.mark.parametrize(
    ("module", "named", "imports"),
    [
        ("versioned_controller", "{}.py", "import beside_it"),
        pytest.param(
            *("versioned_package", "{}/__init__.py", "from versioned_package import beside_it"), marks=pytest.mark.slow
        ),
    ],
)
def test_another_version_of_the_controller_is_refused(module, named, imports, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    file = tmp_path / named.format(module)
    file.parent.mkdir(exist_ok=True)
    beside, weights = file.parent / "beside_it.py", tmp_path / "weights.txt"
    own = {
        file: f"{imports}\nfrom examples.idm import IDM\nclass Careful(IDM):\n"
        "    def __init__(self, weights): super().__init__()\n    def step(self, seen): return beside_it.ASKED",
        beside: "ASKED = -2.0",
        weights: "2.0",
    }
    for each, text in own.items():
        each.write_text(text)
    parameters, out = f"parameters: {{weights: {weights}}}", tmp_path / "run"
    settings = (f"av={{controller: '{module}:Careful', {parameters}}}", "world.engine=twin")
    run_here(golden("forced-twin", *settings, "stop.episodes=20"), out)
    for each, text in own.items():
        each.write_text(text.replace("2.0", "3.0") + "\n")
        with pytest.raises(RunFolderError, match="made of, has been changed") as refused:
            run_here(golden("forced-twin", *settings, "stop.episodes=40"), out, resume=True)
        assert "bring that back as another file" in refused.value.mend  # as docs/compare.md says
        each.write_text(text)
    assert run_here(golden("forced-twin", *settings, "stop.episodes=40"), out, resume=True).exit_code == 0


def test_what_a_vehicle_writes_when_it_is_made_does_not_count(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "notes_it.py").write_text(
        "from examples.idm import IDM\nclass Notes(IDM):\n"
        "    def __init__(self, note):\n        super().__init__()\n"
        "        with open(note, 'a') as file: file.write('made ')"
    )
    note = tmp_path / "note.txt"
    settings = (f"av={{controller: 'notes_it:Notes', parameters: {{note: {note}}}}}", "world.engine=twin")
    for n in (20, 40):
        done = run_here(golden("forced-twin", *settings, f"stop.episodes={n}"), tmp_path / "run", resume=n > 20)
        assert (done.exit_code, "made" in note.read_text()) == (0, True)


# -- records that are not as they were left --

SECOND = "000000080-000000160.parquet"
READERS = ("estimate",), ("report",), ("replay", 100)


def written(file: str, text: str | None):
    return lambda run: (run / file).unlink() if text is None else (run / file).write_text(text)


def rewritten(change):
    def damage(run):
        path = part_files(unnoted(run))[1]
        pq.write_table(change(pq.read_table(path, partitioning=None)), path)

    return damage


def told(**changes):
    return lambda run: edit(run, "estimates.json", **changes)


POINT_WITHOUT_RATE = {"n": 1, "ci_low": 0, "ci_high": 1, "rhw": 1}  # which must not be drawn as zero


@pytest.mark.parametrize(
    ("damage", "commands", "said"),
    [
        (lambda run: run.rename(run.parent / "gone"), READERS, "run"),
        (lambda run: None, [("replay", 400)], "from 0 to 239"),
        (lambda run: truncate(part_files(run)[1]), (*READERS, ("replay",)), f"episodes/{SECOND}"),
        (lambda run: truncate(part_files(unnoted(run))[1]), READERS[:1], f"{SECOND} found: a file that cannot"),
        (lambda run: part_files(run)[1].unlink(), READERS, f"episodes/{SECOND} found: no such file"),
        (lambda run: part_files(run, "traces")[1].unlink(), READERS[1:], f"traces/{SECOND} found"),
        (lambda run: (run / "estimates.json").unlink(), READERS[1:2], "harness estimate"),
        (lambda run: edit(run, n_episodes=0, parts=[]), (*READERS[::2], ("replay",)), "has not finished a test yet"),
        (lambda run: edit(run, n_episodes=500), READERS[:1], "240 tests"),
        (lambda run: edit(run, parts=manifest(run)["parts"][::2]), READERS[:1], "begins at test 160"),
        (lambda run: edit(run, campaign_hash="0" * 16), READERS[2:], "campaign.yaml"),
        (lambda run: truncate(run / "manifest.json"), READERS[:1], "manifest.json"),
        *((written("manifest.json", text), READERS[:1], "manifest.json") for text in (None, '{"parts": 5}')),
        *((written("campaign.yaml", text), READERS[:1], "campaign.yaml") for text in (None, "{}")),
        (written("plots", ""), READERS[1:2], "plots found: a file expected: a folder"),
        (rewritten(lambda table: table.slice(0, 70)), READERS[1:2], "found: 70 rows expected: 80 rows"),
        (rewritten(lambda table: table.drop_columns(["log_weight"])), READERS[1:2], "no column 'log_weight'"),
        (lambda run: truncate(run / "estimates.json"), READERS[1:2], "estimates.json"),
        (told(campaign_hash="feedfeedfeedfeed"), READERS[1:2], "feedfeedfeedfeed"),
        (told(n_episodes=80), READERS[1:2], "estimates of 80 tests"),
        (told(headline="oracle"), READERS[1:2], "oracle"),
        (lambda run: shutil.copy(run / "estimates.json", run / "families.json"), READERS[:2], "no key families"),
        (lambda run: shutil.copy(run / "estimates.json", run / "compare.json"), READERS[1:2], "no key difference"),
        (told(convergence=[POINT_WITHOUT_RATE]), READERS[1:2], "convergence.0.crash_rate"),
    ],
)
def test_what_is_not_as_it_was_left(damage, commands, said, stored, complaint_of):
    """An earlier report stays."""
    (stored / "report.html").write_text("of an earlier report")
    damage(stored)
    for name, *more in commands:
        complaint = complaint_of(name, stored, *more)
        assert str(stored) in complaint
        assert said in complaint
    assert not stored.exists() or (stored / "report.html").read_text() == "of an earlier report"


def test_shells_of_another_run_are_refused(stored_run, tmp_path, complaint_of):
    run = copy_of(stored_run("shells-twin"), tmp_path / "run")
    edit(run, "shells.json", p_event=0.5)
    assert "shells.json found: events of probability 0.5 per test" in complaint_of("report", run)


def test_a_file_that_cannot_be_copied_is_named(tmp_path):
    """As those of a stored run are by ``harness compare``."""
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "loop").symlink_to("loop")
    with pytest.raises(shutil.Error) as raised:
        shutil.copytree(tmp_path / "a", tmp_path / "b")
    told = system_error(raised.value)
    assert told is not None
    assert told.where == str(tmp_path / "a" / "loop")
    assert told.found.startswith("Too many levels of symbolic links")


def test_a_limit_of_open_files_that_is_reached_is_named():
    told = system_error(OSError(errno.EMFILE, "Too many open files", "manifest.json"))
    assert told is not None
    assert (told.where, told.found) == ("manifest.json", "no more files (Too many open files)")


def test_values_that_no_run_has_written_are_refused(stored):
    part = manifest(stored)["parts"][0]
    elsewhere = {"episodes": {**part["files"]["episodes"], "path": "../../etc/passwd"}}
    for key, wrong in (
        *(("n_episodes", wrong) for wrong in (-1, 10**400, True, "240")),
        *(("parts", [{**part, "files": elsewhere}]), ("stopped_by", "the moon"), ("versions", ["x"])),
    ):
        content = (stored / "manifest.json").read_text()
        edit(stored, **{key: wrong})
        with pytest.raises(RunFolderError, match=r"manifest\.json") as raised:
            read_manifest(stored)
        assert len(str(raised.value)) < 1500
        (stored / "manifest.json").write_text(content)


def test_a_place_is_tried_without_leaving_anything(tmp_path):
    require_place(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "there").mkdir()
    for place in (tmp_path / "a" / "b", tmp_path / "there"):
        with pytest.raises(ZeroDivisionError), sole_use(place):
            _ = 1 / 0
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
