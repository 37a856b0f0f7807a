"""A controller's fault ends its episode, with the cause in the row; nothing else changes."""

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from harness.cli import main
from harness.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_TOO_MANY_FAILED

ROOT = Path(__file__).parents[2]
SMALL = """\
name: faults
testing: {method: forced}
world: {engine: twin, cells: 40}
records: {moments: none}
stop: {episodes: 400}
run: {shard_size: 200, max_failed_share: 0.1}
"""
SHORT = ", limits: {step_time_s: 0.2}"
LATE = "no answer within 0.2 s (av.limits.step_time_s)"


@pytest.fixture(autouse=True)
def _in_the_checkout(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def _run(folder, av, *more):
    (folder / "c.yaml").write_text(SMALL)
    changes = [word for change in (f"av={av}", *more) for word in ("--set", change)]
    return main(["run", str(folder / "c.yaml"), "--out", str(folder / "run"), "--workers", "1", *changes])


def _misbehaving(bad, more="", **parameters):
    """YAML of an AV whose episodes misbehave as ``bad`` says."""
    parameters = json.dumps({"bad": {str(episode): fault for episode, fault in bad.items()}, **parameters})
    return f"{{controller: 'tests.controllers.misbehaving:Misbehaving', parameters: {parameters}{more}}}"


def _other(name, parameters="{}"):
    return f"{{controller: 'tests.controllers.misbehaving:{name}', parameters: {parameters}}}"


def _episodes(folder):
    shards = sorted((folder / "run/episodes").glob("*.parquet"))
    return pa.concat_tables([pq.read_table(shard) for shard in shards]).to_pylist()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    assert _run(folder, "{model: idm}") == EXIT_DONE
    return _episodes(folder)


IN_PROCESS = {
    "raises": "step: ZeroDivisionError: no such thing",
    "none": "step: returned NoneType, expected an acceleration in m/s2 as a number",
    "nan": "step: returned nan, expected a finite acceleration in m/s2",
    "inf": "step: returned inf, expected a finite acceleration in m/s2",
    "string": "step: returned str, expected an acceleration in m/s2 as a number",
    "boolean": "step: returned bool, expected an acceleration in m/s2 as a number",
    "shape": "step: returned Array, expected an acceleration in m/s2 as a number",
    "impossible": "step: asked for -99 m/s2, outside of av.limits (-15 to 10)",
    "exits": "step: SystemExit: 5",
    "hangs": f"step: StepTimeoutError: {LATE}",
    "hangs_and_swallows": f"step: StepTimeoutError: {LATE}",
    "hangs_in_start": f"start: StepTimeoutError: {LATE}",
}
OF_THE_PROCESS = {
    "ends_the_process": "step: the controller ended the worker process (exit code 7)",
    "ends_the_process_in_start": "start: the controller ended the worker process (exit code 7)",
    "crashes": "step: the controller ended the worker process (exit code -11)",
    "is_killed": "step: the controller ended the worker process (exit code -9)",
    "hangs_for_good": f"step: {LATE}, and the call could not be interrupted",
}


@pytest.mark.parametrize("faults", [IN_PROCESS, OF_THE_PROCESS], ids=["in_process", "of_the_process"])
def test_a_fault_ends_its_episode_and_changes_no_other(faults, tmp_path, undisturbed):
    bad = {3 + 17 * i: fault for i, fault in enumerate(faults)}
    assert _run(tmp_path, _misbehaving(bad, SHORT)) == EXIT_DONE
    for row, without in zip(_episodes(tmp_path), undisturbed, strict=True):
        if row["episode"] in bad:
            fault = bad[row["episode"]]
            assert (row["outcome"], row["failure"]) == ("failed", faults[fault])
            assert row["n_steps"] == (0 if fault.endswith("_in_start") else without["cut_in_step"] + 3)
            assert row["log_weight"] == row["log_p_cut_in"] == without["log_p_cut_in"]  # in start as well
        else:
            assert row == without
    assert not list((tmp_path / "run").glob(".*"))
    estimates = json.loads((tmp_path / "run/estimates.json").read_text())
    headline = estimates["estimates"][estimates["headline"]]
    assert headline["details"]["n_failed"] == len(faults)
    assert headline["details"]["crash_rate_if_failed_had_crashed"] > headline["crash_rate"]


def test_a_worker_killed_from_outside_is_not_the_controllers_fault(tmp_path, undisturbed):
    av = _misbehaving({57: "is_killed_once"}, path=str(tmp_path / "killed"))
    assert _run(tmp_path, av) == EXIT_DONE
    assert (tmp_path / "killed").exists()
    assert _episodes(tmp_path) == undisturbed


@pytest.mark.parametrize("fault", ["raises", "ends_the_process"])
def test_too_many_failures_end_the_campaign(fault, tmp_path, capsys):
    av = _misbehaving({5: fault, 6: fault})
    assert _run(tmp_path, av, "run.max_failed_share=0.005") == EXIT_TOO_MANY_FAILED
    err = capsys.readouterr().err
    assert "run.max_failed_share" in err
    if fault == "raises":
        assert "2 of 200 episodes failed, 2 of them with: step: ZeroDivisionError: no such thing" in err


@pytest.mark.parametrize("bad", [{5: "raises", 6: "raises"}, {5: "ends_the_process", 6: "ends_the_process"}])
def test_too_many_failures_of_a_short_campaign_are_no_answer_either(bad, tmp_path, capsys):
    """Fewer tests than it takes to end a campaign halfway."""
    short = ("stop.episodes=40", "run.max_failed_share=0.04")
    assert _run(tmp_path, _misbehaving(bad), *short) == EXIT_TOO_MANY_FAILED
    assert "2 of 40 episodes failed" in capsys.readouterr().err
    assert not (tmp_path / "run/estimates.json").exists()
    assert _run(tmp_path, _misbehaving(bad), *short[:1], "run.max_failed_share=0.05", "name=again") == EXIT_BAD_INPUT


def test_a_constructor_that_raises_is_an_error_of_the_campaign(tmp_path, capsys):
    assert _run(tmp_path, _other("RaisesWhenMade")) == EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert err.startswith("error: av.controller\n")
    assert "RuntimeError: no licence" in err
    assert not (tmp_path / "run").exists()


def test_parameters_that_a_constructor_does_not_take_are_blamed(tmp_path, capsys):
    assert _run(tmp_path, _other("RaisesInClose", "{pth: x}")) == EXIT_BAD_INPUT
    assert capsys.readouterr().err.startswith("error: av.parameters\n")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("av={controller: 'no_such_module:X'}", "cannot be imported"),
        ("av={controller: 'tests.controllers.misbehaving:X'}", "no class X"),
        (f"av={_other('RaisesWhenMade')}", "no licence"),
        (f"av={_other('RaisesInClose', '{pth: x}')}", "pth"),
        ("testing={method: shells, shells: {boundary: foo}}", "testing.shells.boundary"),
    ],
)
def test_check_refuses_what_run_refuses(change, words, tmp_path, capsys):
    (tmp_path / "c.yaml").write_text(SMALL.replace("testing: {method: forced}\n", ""))
    complaints = []
    for command in (["check"], ["run", "--out", str(tmp_path / "run")]):
        assert main([*command, str(tmp_path / "c.yaml"), "--set", change]) == EXIT_BAD_INPUT
        complaints.append(capsys.readouterr())
    assert complaints[0] == complaints[1]
    assert words in complaints[0].err
    assert not (tmp_path / "run").exists()


def test_close_is_called_and_may_raise(tmp_path, undisturbed):
    assert _run(tmp_path, _other("RaisesInClose", f"{{path: {tmp_path}/closed}}")) == EXIT_DONE
    assert (tmp_path / "closed").read_text().count("closed") >= 40
    assert _episodes(tmp_path) == undisturbed


def test_a_batch_controllers_fault_is_laid_at_one_cell_where_it_can_be(tmp_path):
    assert _run(tmp_path, _other("Batch", "{nan: 57}")) == EXIT_DONE
    failed = {row["episode"]: row["failure"] for row in _episodes(tmp_path) if row["outcome"] == "failed"}
    assert failed == {57: "step_batch: returned nan, expected a finite acceleration in m/s2"}


def test_a_batch_controllers_other_faults_fail_all_that_were_asked(tmp_path):
    assert _run(tmp_path, _other("Batch", "{wrong_shape: true}"), "run.max_failed_share=0.5") == EXIT_DONE
    causes = {row["failure"] for row in _episodes(tmp_path)} - {None}
    assert causes
    assert all("step_batch: returned an array of shape (" in cause for cause in causes)
