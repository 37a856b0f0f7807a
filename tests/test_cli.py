"""The command line: what goes where, which exit code, and errors in plain words."""

import errno
import json
import os
import sys
from dataclasses import dataclass, field
from itertools import filterfalse
from pathlib import Path
from types import SimpleNamespace

import click
import pyarrow as pa
import pytest
from click.testing import CliRunner
from pyarrow import csv, parquet

from harness.campaign.files import load_campaign
from harness.cli import cli, main
from harness.commands.printing import in_folder, say
from harness.errors import EXIT_BAD_INPUT, EXIT_REFUTED, RunFolderError, TooManyFailedError
from harness.progress import ShownProgress
from tests.stored_runs import estimates

SCENARIOS = Path(__file__).parents[1] / "scenarios"
SMOKE = str(SCENARIOS / "smoke.yaml")

NADE = {
    "crash_rate": 1.2e-7,
    "std_error": 4e-9,
    "ci_low": 1.14e-7,
    "ci_high": 1.26e-7,
    "upper_bound": 1.25e-7,
    "confidence": 0.9,
    "rhw": 0.05,
    "n_episodes": 40_000,
    "n_crashes": 3_210,
    "n_effective": 1_234.5,
    "largest_weight_share": 0.012,
    "method": "mean of weights",
    "warnings": ["a remark on the weights"],
}
ESTIMATES = {
    "campaign": "smoke",
    "confidence": 0.9,
    "n_episodes": 40_000,
    "n_crashes": 3_210,
    "headline": "nade",
    "estimates": {"nade": NADE, "nde": {"crash_rate": None, "reason": "weights are not 1"}},
    "statement": "The vehicle crashes once in 8.3 million tests.",
    "statements": {
        "nade": "The vehicle crashes once in 8.3 million tests.",
        "nde": "No crash rate from these records: weights are not 1.",
    },
    "boundary_statements": {"library": "REFUTED, first in episode 3 (`harness replay FOLDER 3`)."},
    "scope": "Sampling error only.",
}


@dataclass
class Result:
    folder: Path
    report: Path
    estimates: dict = field(default_factory=lambda: ESTIMATES)
    stopped_by: str = "rhw"
    ending: str = "Stopped after 200 tests: the last condition to be met was stop.rhw (0.3)."
    exit_code: int = 0


@dataclass
class Replay:
    bit_equal: bool | None
    outcome: str = "crash"
    suspects: str = "The controller's source file has been changed since the run."
    row: dict[str, object] = field(default_factory=dict)
    trace: pa.Table = field(default_factory=lambda: pa.table({"step": [0, 1], "vehicle": ["LV", "BV"]}))


@pytest.fixture
def calls(monkeypatch, tmp_path):
    """Stands in for what the commands call, and notes how they were called."""
    seen = {}

    def stand_in(target, answer):
        def called(*arguments, **options):
            seen[target] = (arguments, options)
            result = answer(*arguments) if callable(answer) else answer
            if isinstance(result, BaseException):
                raise result
            return result

        monkeypatch.setattr(target, called, raising=False)

    stand_in(
        "harness.runner.look.plan_campaign", {"episodes": 400_000, "tables": "to build (about 20 s)", "disk_mb": 12.5}
    )
    stand_in("harness.runner.run.run_campaign", lambda _, folder: Result(folder, folder / "report.html"))
    stand_in("harness.report.page.write_report", lambda folder: folder / "report.html")
    stand_in("harness.runner.stored.estimate_run", ESTIMATES)
    stand_in("harness.runner.stored.replay_episode", Replay(bit_equal=True))
    seen["stand_in"] = stand_in
    return seen


def test_help_teaches():
    for command in ([], *([name] for name in cli.commands)):
        result = CliRunner().invoke(cli, [*command, "--help"])
        assert result.exit_code == 0
        assert "Examples:\n    harness " in result.output


def test_a_shell_completes_commands(monkeypatch, capsys):
    for name, value in {"_HARNESS_COMPLETE": "bash_complete", "COMP_WORDS": "harness r", "COMP_CWORD": "1"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        main([])
    assert capsys.readouterr().out.split() == ["plain,replay", "plain,report", "plain,run"]


def test_check_prints_a_campaign_file(calls, capsys, tmp_path):
    assert main(["check", SMOKE, "--set", "stop.rhw=0.2"]) == 0
    output = capsys.readouterr().out
    (tmp_path / "resolved.yaml").write_text(output)
    assert load_campaign(tmp_path / "resolved.yaml") == load_campaign(SMOKE, ["stop.rhw=0.2"])
    assert "#   episodes: 400,000" in output
    assert "#   tables: to build (about 20 s)" in output
    assert "#   disk mb: 12.5" in output
    assert main(["check", SMOKE, "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert (output["campaign"]["stop"]["rhw"], output["plan"]["disk_mb"]) == (0.05, 12.5)


def test_run_prints_the_answer_and_where_more_is(calls, capsys, tmp_path):
    folder = tmp_path / "an out"
    assert main(["run", SMOKE, "--out", str(folder), "--workers", "2", "--resume", "--set", "seed=7"]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        ESTIMATES["statement"],
        f"Statement library: REFUTED, first in episode 3 (`harness replay '{folder}' 3`).",
        ESTIMATES["scope"],
        Result.ending,
        str(folder / "report.html"),
        str(folder / "estimates.json"),
    ]
    assert err == ""
    (campaign, to), options = calls["harness.runner.run.run_campaign"]
    assert (campaign.seed, to) == (7, folder)
    assert isinstance(options.pop("progress"), ShownProgress)
    assert options == {"workers": 2, "resume": True}


def test_run_as_json_and_with_the_budget_spent(calls, capsys, tmp_path):
    calls["stand_in"](
        "harness.runner.run.run_campaign", lambda _, folder: Result(folder, folder / "report.html", exit_code=4)
    )
    assert main(["run", SMOKE, "--out", str(tmp_path / "out"), "--json"]) == 4
    assert json.loads(capsys.readouterr().out) == in_folder(ESTIMATES, tmp_path / "out")


def test_wrong_campaign_leaves_nothing_behind(calls, capsys, tmp_path):
    (tmp_path / "bad.yaml").write_text("name: bad\ntestin: {}\n")
    assert main(["check", str(tmp_path / "bad.yaml")]) == 2
    assert capsys.readouterr().err.startswith(f"error: testin ({tmp_path / 'bad.yaml'}:2)\n")
    assert main(["run", SMOKE, "--out", str(tmp_path / "out"), "--set", "testing.epsilom=1"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[0] == "error: --set testing.epsilom=1"
    assert [line.split()[0] for line in err.splitlines()[1:]] == ["found:", "expected:", "mend:"]
    assert "Did you mean 'epsilon'?" in err
    assert "harness.runner.run.run_campaign" not in calls
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", SMOKE],
        ["run", SMOKE, "--out", "x", "--workers", "0"],
        ["nothing"],
        ["check", SMOKE, "--nothing"],
        ["estimate", "no-such-folder"],
        ["estimate", ".", "--confidence", "1"],
        ["replay", ".", "-1"],
        ["replay", ".", "1", "--out", "trace.txt"],
        [],
    ],
)
def test_wrong_calls_end_with_2(calls, capsys, arguments):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    if arguments and arguments != ["nothing"]:
        assert err.startswith("error: ")
        assert [line.split()[0] for line in err.splitlines()[1:]] == ["found:", "expected:", "mend:"]
    else:
        assert "Usage: harness" in err


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["check", "{}.yaml"], 2),
        (["check", SMOKE, "--set", "{}=1"], 2),
        (["check", SMOKE, "--av", "{}"], 2),
        (["replay", ".", "{}"], 2),
        (["{}"], 2),
        (["run", SMOKE, "--out", "{}"], 0),
        (["report", "{}"], 0),
        (["estimate", "{}"], 0),
        (["replay", "{}", "1", "--fcd", "{}.xml"], 0),
        (["run", SMOKE, "--out", "{}", "--json"], 0),
    ],
)
def test_names_move_no_cursor(calls, capsys, tmp_path, monkeypatch, arguments, code):
    """Escape sequences, in seven and in eight bits, and names that are not UTF-8."""
    name = "runs\x1b[31m\x9b2J\udcff"
    monkeypatch.chdir(tmp_path)
    Path(name).mkdir()
    assert main([each.format(name) for each in arguments]) == code
    shown = "".join(capsys.readouterr())
    assert shown.isprintable() or set(filterfalse(str.isprintable, shown)) == {"\n"}
    assert "[31m" in shown


WRONG = "episodes/0.parquet", "half a file", "a whole one", "Delete it."


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (RunFolderError(*WRONG), 2, "\n  found:    half a file\n  expected: a whole one\n  mend:     Delete it.\n"),
        (TooManyFailedError(*WRONG), 3, "half a file"),
        (KeyboardInterrupt(), 130, "--resume"),
        (errno.ENOSPC, 2, "free some space"),
        (errno.EDQUOT, 2, "--resume"),
        (errno.EACCES, 2, "permissions"),
        (errno.EFBIG, 2, "limit"),
    ],
)
def test_errors_that_can_be_mended_are_told_in_words_and_keep_their_exit_code(
    calls, capsys, tmp_path, error, code, said
):
    if isinstance(error, int):
        error = OSError(error, os.strerror(error), "episodes/0.parquet")
    calls["stand_in"]("harness.runner.run.run_campaign", error)
    assert main(["run", SMOKE, "--out", str(tmp_path)]) == code
    err = capsys.readouterr().err
    assert said in err
    assert err.startswith("error: episodes/0.parquet\n") == (code != 130)


def test_an_interrupted_estimate_has_nothing_to_go_on_with(calls, capsys, tmp_path):
    calls["stand_in"]("harness.runner.stored.estimate_run", KeyboardInterrupt())
    assert main(["estimate", str(tmp_path)]) == 130
    assert "--resume" not in capsys.readouterr().err


@pytest.mark.parametrize("defect", [OSError(errno.EBADF, "closed too early"), ZeroDivisionError()], ids=repr)
def test_defects_are_not_hidden(defect, calls, tmp_path):
    calls["stand_in"]("harness.runner.run.run_campaign", defect)
    with pytest.raises(type(defect)) as caught:
        main(["run", SMOKE, "--out", str(tmp_path)])
    assert caught.value is defect


def test_estimate_prints_a_table(calls, capsys, tmp_path):
    assert main(["estimate", str(tmp_path), "-e", "nade", "-e", "nde", "--confidence", "0.95"]) == 0
    out = capsys.readouterr().out
    options = {"estimators": ("nade", "nde"), "confidence": 0.95}
    assert calls["harness.runner.stored.estimate_run"] == ((tmp_path,), options)
    row = next(line for line in out.splitlines() if "nade *" in line)
    assert all(text in row for text in ("1.200 × 10⁻⁷", "(1.14 to 1.26) × 10⁻⁷", "0.0500", "1,234", "1.2 %"))
    assert "nade: a remark on the weights" in out
    assert "nde: weights are not 1" in out
    assert [out.splitlines()[line] for line in (-3, -1)] == [ESTIMATES["statement"], ESTIMATES["scope"]]
    assert list(tmp_path.iterdir()) == []


def test_estimate_closes_with_what_was_asked(calls, capsys, tmp_path):
    assert main(["estimate", str(tmp_path), "-e", "nde"]) == EXIT_BAD_INPUT  # these records do not allow it
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == f"nde: {ESTIMATES['statements']['nde']}"
    assert ESTIMATES["statement"] not in out
    assert "nade" not in out
    assert out.count("weights are not 1") == 1


def test_estimate_writes_only_when_asked(calls, capsys, tmp_path):
    assert main(["estimate", str(tmp_path), "--write", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == in_folder(ESTIMATES, tmp_path)
    assert estimates(tmp_path) == ESTIMATES
    assert [file.name for file in tmp_path.iterdir()] == ["estimates.json"]


def test_replay_writes_the_trace(calls, capsys, tmp_path):
    as_csv, as_parquet = tmp_path / "trace.csv", tmp_path / "trace.parquet"
    assert main(["replay", str(tmp_path), "17", "--out", str(as_csv), "--fcd", "fcd.xml"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines() == ["episode 17: crash; bit for bit as stored", str(as_csv), "fcd.xml"]
    assert calls["harness.runner.stored.replay_episode"] == ((tmp_path, 17), {"gui": False, "fcd": Path("fcd.xml")})
    assert csv.read_csv(as_csv)["vehicle"].to_pylist() == ["LV", "BV"]
    assert main(["replay", str(tmp_path), "17", "--out", str(as_parquet), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bit_equal"] is True
    assert parquet.read_table(as_parquet)["step"].to_pylist() == [0, 1]


@pytest.mark.parametrize("option", ["--out", "--fcd"])
def test_a_file_that_cannot_be_written_is_refused_first(calls, capsys, tmp_path, option):
    (tmp_path / "file").write_text("not a folder")
    assert main(["replay", str(tmp_path), "17", option, str(tmp_path / "file" / "x.csv")]) == 2
    assert "nothing can be written" in capsys.readouterr().err
    assert "harness.runner.stored.replay_episode" not in calls


POOL = {
    "pool": "abc",
    "n_paths": 10,
    "surrogates": [{"name": "a", "crash_rate": 1e-6, "std_error": 1e-8, "shell_probability": 1e-6}],
    "boundary": "a",
    "envelope": "b",
    "delays_after_cut_in_s": {"a": 0.469},
    "no_surrogate_crashes": 1e-5,
    "p_cut_in": 1e-5,
    "p_cut_in_std_error": 1e-8,
}


def test_pool_prints_what_it_wrote(calls, capsys, tmp_path):
    calls["stand_in"]("harness.pool.build.campaign_pool", SimpleNamespace(to_json=lambda: POOL))
    calls["stand_in"]("harness.pool.cut_ins.write_pool", None)
    file = tmp_path / "pool.parquet"
    assert main(["pool", SMOKE, "--out", str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "delays after cut in s.a: 0.4690" in lines
    assert lines[-1] == str(file)
    assert calls["harness.pool.cut_ins.write_pool"][0][0] == file
    assert main(["pool", SMOKE, "--out", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["file"] == str(file)


COMES_OVER = {"onset_step": 41, "cut_in_step": 53, "onset_r2_m": 7.25, "contact": "side"}


@pytest.mark.parametrize(
    ("replayed", "code", "said"),
    [
        (Replay(bit_equal=False), 3, "mend:     The controller's source file has been changed"),
        (Replay(bit_equal=False), 3, "episode 17: crash; NOT as stored\n"),
        (Replay(bit_equal=None), 0, "no stored trace"),
        (
            Replay(bit_equal=True, row=COMES_OVER),
            0,
            "BV comes over from 4.2 s on, 7.2 m ahead of the AV, and overlaps at 5.4 s; side contact",
        ),
    ],
)
def test_replay_says_how_it_compares_and_when_a_cut_in_began(calls, tmp_path, capsys, replayed, code, said):
    calls["stand_in"]("harness.runner.stored.replay_episode", replayed)
    assert main(["replay", str(tmp_path), "17"]) == code
    assert said in "".join(capsys.readouterr())


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
