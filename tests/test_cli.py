"""The command line: what goes where, which exit code, and errors in plain words."""

import errno
import json
import os
import shutil
import signal
import sys
from contextlib import suppress
from pathlib import Path
from unittest.mock import Mock

import click
import pytest
from junitparser import JUnitXml

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.cli import main
from harness.commands.options import run_folder
from harness.commands.printing import say
from harness.errors import EXIT_REFUTED, RunFolderError, TooManyFailedError
from harness.families import family_named
from harness.progress import Progress
from harness.report.words import run_lines
from tests.golden.campaigns import BASE, RUNS
from tests.in_process import one_process, without_page
from tests.stored_runs import SCENARIOS, copy_of, estimates, golden, manifest, sets

SMOKE = str(SCENARIOS / "smoke.yaml")

CAMPAIGN = [str(BASE), *sets(*RUNS["shells-refuted"])]


@pytest.fixture
def folder(stored_run, tmp_path):
    """A copy of a finished run, which a test may write into; pages are others' concern."""
    with one_process(), without_page():
        out = copy_of(stored_run("shells-refuted"), tmp_path / "an out")
        (out / "report.html").touch()
        yield out


def test_check_prints_a_campaign_file(capsys, tmp_path, monkeypatch):
    assert main(["check", SMOKE, "--set", "stop.rhw=0.2"]) == 0
    output = capsys.readouterr().out
    (tmp_path / "resolved.yaml").write_text(output)
    resolved = load_campaign(tmp_path / "resolved.yaml")
    assert resolved == load_campaign(SMOKE, ["stop.rhw=0.2", f"pool.library={family_named('cut_in').ladders[True]}"])
    assert main(["check", SMOKE, "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["stop"] == {**output["stop"], "rhw": 0.3, "episodes": 400_000}
    (tmp_path / "my_av.py").write_text(
        "class MyAV:\n    def __init__(self, file): ...\n    def step(self, seen): return 0.0\n"
    )
    asked = f"{tmp_path}/my_av.py:MyAV", "--set", f"av.parameters.file={tmp_path}/my_av.py"
    monkeypatch.chdir(tmp_path)  # what is relative to a campaign file may move with it; parameters are not
    assert main(["check", *asked]) == 0
    assert f'file: "{tmp_path}/my_av.py"' in capsys.readouterr().out


def test_run_prints_the_answer_and_where_more_is(folder, capsys):
    command = ["run", *CAMPAIGN, "--out", str(folder), "--workers", "1", "--resume"]
    assert main(command) == 0
    out, content = capsys.readouterr().out.splitlines(), estimates(folder)
    short = run_lines(golden("shells-refuted"), manifest(folder), content, folder / "report.html")
    assert (out, len(out)) == (short, 7)
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == content


def test_an_estimator_that_the_records_do_not_allow_is_a_reason_and_no_row(folder, capsys):
    assert main(["estimate", str(folder), "-e", "dr", "-e", "nade"]) == 2
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == ["dr", "nade"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["run"],
        ["estimat"],
        ["--nothing"],
        ["pool", SMOKE, "--quite"],
        ["estimate", ".", "--confidence", "1"],
        ["run", SMOKE, "--junit", ""],
        ["run", SMOKE, "--workers", "9" * 20],
        [],
    ],
)
def test_wrong_calls_end_with_2(capsys, arguments):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    if arguments:
        assert err.startswith("error: ")
        assert [line.split()[0] for line in err.splitlines()[1:]] == ["found:", "expected:", "fix:"]
        assert ("Did you mean" in err) == (arguments[-1] in ("estimat", "--quite"))
    else:
        assert "Usage: harness" in err


@pytest.mark.parametrize(
    ("asked", "fix"),
    [
        ("run --episodes 100", "Write --set stop.episodes=…"),
        ("run --seed 2", "Write --set seed=…"),
        ("run --output x", "Did you mean '--out'?"),
        ("run --stop.rhw 0.1", "Write --set stop.rhw=…"),
        ("run --set stop.rhw 0.1", "A setting is one word, as in --set stop.rhw=0.1"),
        ("compare", "Write harness compare idm OTHER_AV, or say with --against"),
    ],
)
def test_what_is_no_option_or_has_no_value_is_told_with_what_to_write(asked, fix, tmp_path, capsys):
    command, *options = asked.split()
    assert main([command, "idm", *options, "--out", str(tmp_path / "out")]) == 2
    assert fix in capsys.readouterr().err.splitlines()[-1]


def test_an_option_without_its_value_is_told_by_its_command(capsys):
    assert main(["run", "idm", "--junit"]) == 2
    assert capsys.readouterr().err.startswith("error: harness run\n  found:    Option '--junit' requires an arg")


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("run --scenario lead_brake", "fix:      Write --scenario lead_brakes."),
        ("run --scenario cut-in,lead_brake", "fix:      Write --scenario cut_in,lead_brakes."),
        *((f"run --accept {wrong}", "accept.times_reference") for wrong in ("0.5xr157-cc", "0,5*r157-cc")),
        ("run --av r157-cc", "found:    a second vehicle, beside idm"),
        ("run --accept 1e-7/h", "fix:      Write one of these."),
        ("run --accept 50%", "expected: crashes per test (3e-7), or a driver (r157-cc, 0.5*r157-cc)"),
        ("run --accept r157cc", "fix:      Did you mean 'r157-cc'?"),
        ("run --accept -1", "fix:      Correct it; the key means: crashes per test"),
        (
            "run --exposure lead_brakes=abc",
            "found:    'abc'\n  expected: a scenario and its events per hour of driving, 1e-09 to",
        ),
        ("run --independent x", "found:    Invalid value for '--independent': 'x' is not a whole number"),
        ("run --scenario all --exposure leadbrakes=1", "fix:      Write --exposure lead_brakes=1."),
        ("run --set seed=2 --exposure cut_out=1", "Add --scenario all"),
        *((f"compare idm --margin {wrong}", "margin") for wrong in ("1e308", "inf", "nan")),
    ],
)
def test_a_wrong_option_is_told_as_it_was_typed(asked, said, tmp_path, capsys):
    command, *options = asked.split()
    assert main([command, "idm", *options, "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert len(options) > 2 or options[0] != "--scenario" or err.startswith(f"error: {' '.join(options)}\n")
    assert not (tmp_path / "out").exists()


@pytest.fixture
def raising(monkeypatch, tmp_path):
    """Exit code of a command in a folder, while what it calls raises."""

    def call(error, target, *command, more=()):
        monkeypatch.setattr(target, Mock(side_effect=error))
        return main([*command, str(tmp_path), *more])

    return call


WRONG = "episodes/0.parquet", "half a file", "a whole one", "Delete it."


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (RunFolderError(*WRONG), 2, "\n  found:    half a file\n  expected: a whole one\n  fix:      Delete it.\n"),
        (TooManyFailedError(*WRONG), 3, "half a file"),
        (KeyboardInterrupt(), 130, "the same command with --resume goes on"),
        (errno.ENOSPC, 2, "Free some space"),
        (errno.EDQUOT, 2, "--resume"),
        (errno.EACCES, 2, "permissions"),
        (errno.EFBIG, 2, "limit"),
        (errno.ELOOP, 2, "symbolic links"),
        (errno.ENAMETOOLONG, 2, "too long"),
    ],
)
def test_errors_that_can_be_mended_are_told_in_words_and_keep_their_exit_code(raising, capsys, error, code, said):
    if isinstance(error, int):
        error = OSError(error, os.strerror(error), "episodes/0.parquet")
    assert raising(error, "harness.runner.run.run_campaign", "run", SMOKE, "--out") == code
    err = capsys.readouterr().err
    assert said in err
    assert err.startswith("error: episodes/0.parquet\n") == (code != 130)


@pytest.mark.parametrize("then", [lambda: Progress().advance(1), Mock(side_effect=RunFolderError(*WRONG))])
@pytest.mark.parametrize(("number", "code"), [("SIGHUP", 129), ("SIGINT", 130), ("SIGTERM", 143)])
def test_what_a_signal_ends_has_its_exit_code_whatever_becomes_of_the_interruption(capsys, then, number, code):
    def work():
        with suppress(KeyboardInterrupt):
            signal.raise_signal(getattr(signal, number))
        then()

    usual = signal.default_int_handler if number == "SIGINT" else signal.SIG_DFL
    kept = signal.signal(getattr(signal, number), usual)  # in the background of a shell it is ignored
    try:
        assert main([], click.Command("run", callback=work)) == code
    finally:
        signal.signal(getattr(signal, number), kept)
    err = capsys.readouterr().err.strip()
    assert err.startswith("Interrupted")
    assert len(err.splitlines()) == 1
    assert not Progress.cancelled


@pytest.mark.parametrize("defect", [OSError(errno.EBADF, "closed too early"), ZeroDivisionError()], ids=repr)
def test_defects_are_not_hidden(raising, defect):
    with pytest.raises(type(defect)) as caught:
        raising(defect, "harness.runner.run.run_campaign", "run", SMOKE, "--out")
    assert caught.value is defect


@pytest.mark.parametrize(
    ("options", "seeds"),
    [([], (1, 1)), (["--independent", "7"], (7, 7)), (["--independent=7", "--set=seed=8"], (8, 7))],
)
def test_an_independent_repetition_meets_another_pool_too(monkeypatch, options, seeds):
    runs = Mock(side_effect=RunFolderError("", "", "", ""))
    monkeypatch.setattr("harness.runner.run.run_campaign", runs)
    assert main(["run", SMOKE, "--quiet", *options]) == 2
    campaign = runs.call_args.args[0]
    assert (campaign.seed, campaign.pool.seed) == seeds


def test_a_file_that_cannot_be_written_is_refused_first(raising, capsys, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    never = ZeroDivisionError(), "harness.runner.stored.replay_episode", "replay"
    assert raising(*never, more=["17", "--out", str(tmp_path / "file" / "x.html")]) == 2
    assert "nothing can be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "work"),
    [
        (["sensitivity"], "harness.runner.other_traffic.StoredShells.of"),
        (["estimate", "--write"], "harness.estimate"),
        (["estimate", "--write", "--environment", "ndd-overtaking-1"], "harness.estimate_in_other_traffic"),
    ],
)
def test_a_folder_that_cannot_be_written_is_refused_before_work_is_spent(raising, capsys, monkeypatch, command, work):
    monkeypatch.setattr("tempfile.TemporaryFile", Mock(side_effect=PermissionError(errno.EACCES, "Permission denied")))
    assert raising(ZeroDivisionError(), work, *command) == 2
    assert "nothing can be written (Permission denied)" in capsys.readouterr().err


def test_schema_prints_what_is_committed(capsys):
    assert main(["schema"]) == 0
    committed = (SCENARIOS / "campaign.schema.json").read_text(encoding="utf-8")
    assert capsys.readouterr().out == committed, "write it anew: harness schema > scenarios/campaign.schema.json"


def test_a_closed_stdout_is_no_error_and_its_number_is_nobody_elses(monkeypatch):
    """As after ``>&-``: a file or a pipe that took number 1 would receive what is printed."""
    kept = os.dup(1)
    try:
        os.close(1)
        monkeypatch.setattr(sys, "stdout", None)
        assert main(["schema"]) == 0
        assert os.fstat(1).st_rdev == Path(os.devnull).stat().st_rdev
        sys.stdout.close()  # which the harness has opened in its place
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def test_a_reader_that_has_gone_does_not_change_the_exit_code(monkeypatch):
    """As ``| head -1``: a gate that rejects must fail its job all the same."""
    reading, writing = os.pipe()
    os.close(reading)

    def rejected() -> int:
        say("This vehicle crashes too often.")
        return EXIT_REFUTED

    with os.fdopen(writing, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert main([], click.Command("run", callback=rejected)) == EXIT_REFUTED


def test_a_run_without_a_folder_gets_a_new_one_and_resumes_the_last(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    campaign = Campaign(name="mine")
    for last, new in (("mine-all", "mine-all"), ("mine-all", "mine-all-2"), ("mine-all-2", "mine-all-3")):
        assert [run_folder(campaign, "all", resume=resume).name for resume in (True, False)] == [last, new]
        Path("runs", new).mkdir(parents=True)


def test_what_resuming_does_not_find_is_noted(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("harness.run", Mock(side_effect=ZeroDivisionError))
    with pytest.raises(ZeroDivisionError):
        main(["run", *CAMPAIGN, "--resume", "--out", str(tmp_path / "mistyped")])
    assert "nothing to resume in" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("asked", "at_most"), [("r157-cc", 1.0), ("0.5*r157-cc", 0.5), ("0.5r157-cc", 0.5), ("r157-cc*0.5", 0.5)]
)
def test_a_limit_by_hand_replaces_that_of_the_campaign(asked, at_most, tmp_path, monkeypatch):
    run = Mock(side_effect=ZeroDivisionError)
    monkeypatch.setattr("harness.run", run)
    own = "accept={times_reference: {driver: r157-cc, at_most: 0.1}}"
    with pytest.raises(ZeroDivisionError):
        main(["run", "idm", "--out", str(tmp_path / "run"), "--set", own, "--accept", asked])
    assert run.call_args.args[0].accept.times_reference.at_most == at_most


@pytest.mark.parametrize("beside", ["manifest.json", "families.json", None])
def test_a_runs_own_campaign_resumes_that_run(beside, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("harness.run", run := Mock(side_effect=ZeroDivisionError))
    (folder := tmp_path / "of_a_run").mkdir()
    shutil.copy(SMOKE, folder / "campaign.yaml")
    if beside is not None:
        (folder / beside).write_text("{}")
    with pytest.raises(ZeroDivisionError):
        main(["run", str(folder / "campaign.yaml"), "--resume"])
    assert run.call_args.args[1] == (Path("runs/smoke") if beside is None else folder)


def test_estimate_writes_only_when_asked(folder, capsys):
    before, command = estimates(folder), ["estimate", str(folder), "--confidence", "0.5", "--json"]
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out) != before == estimates(folder)
    assert main([*command, "--write"]) == 0
    assert json.loads(capsys.readouterr().out) == estimates(folder)
    assert estimates(folder)["confidence"] == 0.5


@pytest.mark.parametrize(
    ("command", "named"),
    [
        (["run", "tests.controllers.misbehaving:OnlyStepp", "--accept", "r157-cc"], "OnlyStepp"),
        (["run", "no_such.yaml", "--accept", "r157-cc"], "no_such.yaml"),
        (["compare", "idm", "no_such.yaml"], "no_such.yaml"),
    ],
)
def test_a_run_that_comes_to_no_verdict_is_an_error_in_place_of_an_earlier_one(command, named, tmp_path, capsys):
    (verdict := tmp_path / "gate.xml").write_text("<testsuites/>")
    assert main([*command, "--junit", str(verdict), "--out", str(tmp_path / "run")]) == 2
    (case,) = JUnitXml.fromfile(str(verdict))
    (error,) = next(iter(case)).result
    assert named in f"{error.message} {case.name}"
    assert "error: " in capsys.readouterr().err
