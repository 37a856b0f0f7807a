"""A folder that this user has not made on this machine runs no code unless asked to; to look at it takes none."""

import json
import pwd

import pytest

import harness
from harness.campaign.files import dump_campaign
from harness.cli import main
from harness.records.reader import signature
from harness.report.crashes import motion_of
from harness.report.summary import read_run_folder
from harness.resolved import resolve
from tests.in_process import run_here
from tests.stored_runs import copy_of, edit, golden

CODE = """from pathlib import Path
def note():
    Path(__file__).with_suffix(".ran").touch()
note()
class Av:
    def step(self, seen):
        note()
        return -2.0
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run of a vehicle whose code leaves a file where it is run, some of its tests being traced."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "av.py").write_text(CODE)
    run_here(golden("forced-twin", f"av={{controller: '{folder}/av.py:Av'}}", "records.traces=crash"), folder / "run")
    return folder / "run"


@pytest.fixture
def elsewhere(made, tmp_path, monkeypatch):
    """The same folder on another machine, where the vehicle's code has not been run yet."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    made.with_name("av.ran").unlink(missing_ok=True)
    return copy_of(made, tmp_path / "run")


def crashed(folder):
    tests = harness.read(folder).episodes(["episode", "outcome"])
    return [int(tests[of].episode.iloc[0]) for of in (tests.outcome == "crash", tests.outcome != "crash")]


def has_run(folder):
    return folder.with_name("av.ran").exists()


def test_a_run_of_ones_own_is_run_again_wherever_it_was_moved_to(made, tmp_path, capsys):
    folder = copy_of(made, tmp_path / "moved")
    call = ["replay", str(folder), str(crashed(folder)[0])]
    assert main(call) == 0
    out, err = capsys.readouterr()
    assert "bit for bit" in out
    assert err == (told := f"The vehicle is {made.parent}/av.py:Av.\n")
    code = (file := made.with_name("av.py")).read_text()
    try:
        file.write_text(f"{code}# another version\n")
        assert main(call) == 0
    finally:
        file.write_text(code)
    changed = f"note: {file}:Av, or a file that it is made of, has been changed since the run.\n"
    assert capsys.readouterr().err == told + changed


@pytest.mark.slow
def test_of_somebody_else_it_takes_trust(made, elsewhere, capsys, tmp_path):
    traced, untraced = crashed(elsewhere)
    for episode in (traced, untraced):
        assert main(["replay", str(elsewhere), str(episode), "--out", str(tmp_path / "x.csv")]) == 2
        assert "--trust" in (said := capsys.readouterr().err)
        assert f"{made.parent}/av.py:Av" in said
    for kind in ("csv", "html", "xosc"):
        assert main(["replay", str(elsewhere), str(traced), "--stored", "--out", str(tmp_path / f"y.{kind}")]) == 0
    assert capsys.readouterr().out.startswith(f"test {traced}: crash; the motion that the run has kept")
    assert main(["replay", str(elsewhere), str(untraced), "--stored"]) == 2
    for command in ("estimate", "report"):
        assert main([command, str(elsewhere)]) == 0
    assert motion_of(read_run_folder(elsewhere), untraced, harness.replay)[1] is None  # for the page of a comparison
    assert not has_run(made)
    assert main(["replay", str(elsewhere), str(traced), "--trust", "--out", str(tmp_path / "z.csv")]) == 0
    assert has_run(made)
    assert (tmp_path / "y.csv").read_bytes() == (tmp_path / "z.csv").read_bytes()
    assert harness.replay(elsewhere, traced, trust=True).trace == harness.replay(elsewhere, traced, stored=True).trace


def test_another_vehicle_in_a_folder_of_ones_own_is_not_ones_own(made, tmp_path):
    """Of the same name, by which alone a campaign's hash knows it."""
    folder, other = copy_of(made, tmp_path / "run"), tmp_path / "av.py"
    other.write_text(CODE)
    text = (folder / "campaign.yaml").read_text().replace(f"{made.parent}/av.py:", f"{other}:")
    (folder / "campaign.yaml").write_text(text)
    edit(folder, campaign_crc32=None)
    with pytest.raises(harness.HarnessError, match=f"{other}:Av, which would be run"):
        harness.replay(folder, 0)
    assert not other.with_suffix(".ran").exists()


def test_a_program_is_never_started_by_a_replay_whatever_the_manifest_says(stored_run, tmp_path):
    """Its folder could say that it is reproducible."""
    folder, started = copy_of(stored_run("shells-sumo"), tmp_path / "run"), tmp_path / "started"
    resolved = resolve(golden("shells-sumo", f"av={{traci: {{command: 'touch {started}'}}}}"))
    (folder / "campaign.yaml").write_text(dump_campaign(resolved.campaign))
    edit(folder, campaign_crc32=None, campaign_hash=resolved.content_hash)
    with pytest.raises(harness.HarnessError, match="a program outside of the harness"):
        harness.replay(folder, 0, trust=True)
    assert not started.exists()


def test_a_stored_run_of_somebody_else_is_not_compared_with_unasked(made, elsewhere, capsys, tmp_path):
    command = ["compare", str(elsewhere), "idm", "--out", str(tmp_path / "out")]
    assert main(command) == 2
    assert f"{elsewhere}/campaign.yaml" in capsys.readouterr().err
    assert not has_run(made)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("file", ["manifest.json", "estimates.json"])
@pytest.mark.parametrize("seal", [None, "0", 0])
def test_a_seal_that_is_missing_is_damage(file, seal, stored_run, tmp_path):
    folder = copy_of(stored_run("forced-twin"), tmp_path / "run")
    content = json.loads((folder / file).read_text())
    content.pop("crc32")
    (folder / file).write_text(json.dumps(content if seal is None else {**content, "crc32": seal}))
    with pytest.raises(harness.HarnessError, match=rf"{file}.*checksum"):
        harness.write_report(folder)


def test_a_user_without_a_home_signs_nothing_and_leaves_nothing(tmp_path, monkeypatch):
    """Neither by its environment nor by the system, as a user of a container that nobody has made."""

    def unknown(_uid):
        raise KeyError

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    for name in ("HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    assert signature(b"campaign") is None
    assert list(tmp_path.iterdir()) == []
