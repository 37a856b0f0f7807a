"""A controller's fault ends its episode, with the cause in the row; nothing else changes."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from harness.campaign.files import load_campaign
from harness.cli import main
from harness.controllers.find import build_host
from harness.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_TOO_MANY_FAILED
from harness.resolved import resolve
from harness.runner.look import plan_campaign
from harness.runner.prepare import prepare
from harness.runner.workers import LocalWorkers
from harness.worlds.twin import TwinWorld
from tests.controllers.misbehaving import ChangesItsParameters

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
LATE_MADE = "no answer within 0.2 s (av.limits.construction_time_s)"


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
    "lies": "step: asked for -1e+06 m/s2, outside of av.limits (-15 to 10)",
    "raises_what_cannot_be_printed": "step: UnprintableError, whose text raised ValueError",
    "raises_what_is_no_utf_8": "step: FileNotFoundError: no file \\udce9.csv",
    "exits": "step: SystemExit: 5",
    "interrupts": "step: KeyboardInterrupt: ",
    "generator_exit": "step: GeneratorExit: ",
    "copies_the_process": "step: copied the process (os.fork); start programs with subprocess",
    "copies_the_process_for_good": "step: copied the process (os.fork); start programs with subprocess",
    "hangs": f"step: StepTimeoutError: {LATE}",
    "hangs_and_swallows": f"step: StepTimeoutError: {LATE}",
    "hangs_in_start": f"start: StepTimeoutError: {LATE}",
}
OF_THE_PROCESS = {
    "ends_the_process": "step: the controller ended the worker process (exit code 7)",
    "ends_the_process_in_start": "start: the controller ended the worker process (exit code 7)",
    "copies_and_ends_the_process": "step: the controller ended the worker process (exit code 7)",
    "closes_descriptors": "step: the controller closed file descriptors that are not its own (os.close, os.closerange)",
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


def test_too_many_failures_end_the_campaign(tmp_path, capsys):
    av = _misbehaving({5: "raises", 6: "raises"})
    assert _run(tmp_path, av, "run.max_failed_share=0.005") == EXIT_TOO_MANY_FAILED
    err = capsys.readouterr().err
    assert "run.max_failed_share" in err
    assert "2 of 200 episodes failed, 2 of them with: step: ZeroDivisionError: no such thing" in err


def test_too_many_failures_of_a_short_campaign_are_no_answer_either(tmp_path, capsys):
    """Fewer tests than it takes to end a campaign halfway."""
    bad, short = {5: "raises", 6: "ends_the_process"}, ("stop.episodes=40", "run.max_failed_share=0.04")
    assert _run(tmp_path, _misbehaving(bad), *short) == EXIT_TOO_MANY_FAILED
    assert "2 of 40 episodes failed" in capsys.readouterr().err
    assert not (tmp_path / "run/estimates.json").exists()
    assert _run(tmp_path, _misbehaving(bad), *short[:1], "run.max_failed_share=0.05", "name=again") == EXIT_BAD_INPUT


@pytest.mark.parametrize(
    ("change", "where", "words"),
    [
        ("av={controller: 'no_such_module:X'}", "av.controller", "cannot be imported"),
        ("av={controller: 'tests.controllers.misbehaving:X'}", "av.controller", "no class X"),
        (f"av={_other('RaisesWhenMade')}", "av.controller", "RuntimeError: no licence"),
        (f"av={_other('RaisesInClose', '{pth: x}')}", "av.parameters", "pth"),
        (f"av={_other('HangsWhenMade', '{}, limits: {construction_time_s: 0.2}')}", "av.controller", LATE_MADE),
        (
            f"av={_other('HangsWhenMade', '{swallows: true}, limits: {construction_time_s: 0.2}')}",
            "av.controller",
            f"{LATE_MADE}, and the call could not be interrupted, in its constructor",
        ),
        (f"av={_other('says_nothing')}", "av.controller", "without start, step, close"),
        (
            "av={controller: 'subprocess:Popen', parameters: {args: touch called, shell: true}}",
            "av.controller",
            "Popen",
        ),
        ("testing={method: shells, shells: {boundary: foo}}", "testing.shells.boundary", "foo"),
        ("testing={method: shells, shells: {statement: foo}}", "testing.shells.statement", "foo"),
        (
            "testing={method: shells, shells: {statements: {a: {boundary: foo}}}}",
            "testing.shells.statements.a.boundary",
            "foo",
        ),
    ],
)
def test_check_refuses_what_run_refuses(change, where, words, tmp_path, capsys):
    (tmp_path / "c.yaml").write_text(SMALL.replace("testing: {method: forced}\n", ""))
    complaints = []
    for command in (["check"], ["run", "--out", str(tmp_path / "run")]):
        assert main([*command, str(tmp_path / "c.yaml"), "--set", change]) == EXIT_BAD_INPUT
        complaints.append(capsys.readouterr())
    assert complaints[0] == complaints[1]
    assert complaints[0].err.startswith(f"error: {where}\n")
    assert words in complaints[0].err
    assert not (tmp_path / "run").exists()
    assert not Path("called").exists()


def test_av_check_makes_nothing_but_a_controller(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("c.yaml").write_text(SMALL)
    av = "{controller: 'subprocess:Popen', parameters: {args: touch called, shell: true}}"
    assert main(["av-check", "c.yaml", "--set", f"av={av}"]) == EXIT_BAD_INPUT
    assert "Popen without start, step, close" in capsys.readouterr().err
    assert not Path("called").exists()


def test_a_function_may_say_which_controller_it_makes(tmp_path, undisturbed):
    assert _run(tmp_path, _other("idm_of_a_function")) == EXIT_DONE
    assert _episodes(tmp_path) == undisturbed


def test_a_constructor_has_a_time_limit_of_its_own_in_tests_too(tmp_path):
    """The first of a process, that says whether there is a controller at all, is made in time."""
    limits = "limits: {step_time_s: 5, construction_time_s: 0.2}"
    av = _other("HangsWhenMade", f"{{first: 40}}, {limits}")
    assert _run(tmp_path, av, "stop.episodes=40") == EXIT_DONE
    failed = [row["failure"] for row in _episodes(tmp_path) if row["outcome"] == "failed"]
    assert set(failed) == {f"start: StepTimeoutError: {LATE_MADE}"}


def test_close_is_called_and_may_raise(tmp_path, undisturbed):
    assert _run(tmp_path, _other("RaisesInClose", f"{{path: {tmp_path}/closed}}")) == EXIT_DONE
    assert (tmp_path / "closed").read_text().count("closed") >= 40
    assert _episodes(tmp_path) == undisturbed


def test_a_batch_controllers_fault_is_laid_at_one_cell_or_else_fails_all_that_were_asked(tmp_path):
    av = _other("Batch", "{nan: 357, wrong_shape: true}")
    assert _run(tmp_path, av, "run.max_failed_share=0.5") == EXIT_DONE
    failed = {row["episode"]: row["failure"] for row in _episodes(tmp_path) if row["outcome"] == "failed"}
    assert failed.pop(357) == "step_batch: returned nan, expected a finite acceleration in m/s2"
    assert failed
    assert all("step_batch: returned an array of shape (" in cause for cause in failed.values())


@pytest.mark.parametrize("where", ["constructor", "step", "step_batch"])
@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("EndsTheProcess", "the controller ended the worker process (exit code 7)"),
        ("ClosesDescriptors", "the controller closed file descriptors that are not its own"),
    ],
)
def test_a_controller_that_always_ends_its_process_is_named_after_a_few_workers(
    how, words, where, tmp_path, capsys, monkeypatch
):
    started = []
    start = LocalWorkers.new_worker
    monkeypatch.setattr(LocalWorkers, "new_worker", lambda self: (started.append(self), start(self))[1])
    code = _run(tmp_path, _other(how, f"{{where: {where}}}"), "run.max_failed_share=0.01")
    err = capsys.readouterr().err
    assert words in err
    assert "memory limit" not in err
    if where == "constructor":
        assert (code, "in its constructor" in err, len(started)) == (EXIT_BAD_INPUT, True, 0)
        assert not (tmp_path / "run").exists()
    else:
        assert code == EXIT_TOO_MANY_FAILED
        assert 2 <= len(started) <= 7
        assert f"in {where}" in err or "run.max_failed_share" in err


@pytest.mark.parametrize("command", [["run"], ["check"], ["av-check", "--episodes", "4"]], ids=lambda words: words[0])
def test_what_a_controller_starts_does_not_outlive_the_command(command, tmp_path):
    (tmp_path / "c.yaml").write_text(SMALL)
    out = ["--out", str(tmp_path / "run"), "--workers", "2"] if command == ["run"] else []
    av = _other("StartsPrograms", f"{{note: {tmp_path}/started}}")
    assert main([*command, str(tmp_path / "c.yaml"), *out, "--set", f"av={av}"]) == EXIT_DONE
    started = (tmp_path / "started").read_text().split()
    assert len(started) >= (160 if command == ["run"] else 2)
    assert not [pid for pid in started if Path(f"/proc/{pid}").exists()]


def test_a_process_that_ends_in_close_has_done_its_work(tmp_path, undisturbed):
    assert _run(tmp_path, _other("EndsTheProcess", "{where: close}")) == EXIT_DONE
    assert _episodes(tmp_path) == undisturbed


@pytest.mark.parametrize("field", ["cell", "episode", "gap_m", "lv_speed_mps", "cells", "episodes"])
def test_nothing_that_a_batch_controller_is_handed_can_be_written_into(field):
    av = _other("BatchThatWrites", f"{{field: {field}}}")
    prepared = prepare(
        resolve(load_campaign(ROOT / "scenarios/overtaking_forced.yaml", [f"av={av}", "world.engine=twin"]))
    )
    loop = prepared.loop(TwinWorld(8))
    shard = loop.run(0, prepared.states(0, 24))
    loop.close()
    call = "start_batch" if field in ("cells", "episodes") else "step_batch, warming up"
    assert set(shard.failures.values()) == {f"{call}: ValueError: assignment destination is read-only"}


def test_controllers_do_not_share_the_lists_among_their_parameters():
    av = load_campaign(
        ROOT / "scenarios/overtaking_forced.yaml", [f"av={_other('ChangesItsParameters', '{braking: [1.0]}')}"]
    ).av
    hosts = [build_host(av, n_cells=3, seed=1) for _ in range(2)]
    for host in hosts:
        assert host.start(*3 * (np.arange(3),)) == {}
        host.close()
    assert ChangesItsParameters.made[-6:] == [[1.0, 0.01]] * 6
    assert av.parameters == {"braking": [1.0]}


@pytest.mark.parametrize("command", [["run"], ["check"], ["av-check", "--episodes", "4"]], ids=lambda words: words[0])
def test_what_a_controller_prints_does_not_reach_stdout(command, tmp_path, capfd):
    (tmp_path / "c.yaml").write_text(SMALL)
    out = ["--out", str(tmp_path / "run"), "--workers", "1"] if command == ["run"] else []
    assert main([*command, str(tmp_path / "c.yaml"), *out, "--json", "--set", f"av={_other('Prints')}"]) == EXIT_DONE
    printed = capfd.readouterr()
    json.loads(printed.out)
    assert "made, in Python" in printed.err
    assert "made, below Python" in printed.err
    if command == ["run"]:
        assert main(["replay", str(tmp_path / "run"), "3", "--json"]) == EXIT_DONE
        printed = capfd.readouterr()
        assert json.loads(printed.out)["bit_equal"] is True
        assert "started, below Python" in printed.err


def test_check_survives_a_controller_that_does_not(tmp_path, capsys):
    (tmp_path / "c.yaml").write_text(SMALL)
    av = f"av={_other('EndsTheProcess', '{where: step}')}"
    assert main(["check", str(tmp_path / "c.yaml"), "--json", "--set", av]) == EXIT_DONE
    assert "in the call of step" in json.loads(capsys.readouterr().out)["plan"]["av_ms_per_test"]


def test_check_says_how_a_slow_controller_keeps_many_workers_busy(tmp_path, monkeypatch):
    monkeypatch.setattr("harness.runner.look.seconds_per_test", lambda _: 12.0)
    (tmp_path / "c.yaml").write_text(SMALL)
    settings = [f"av={_other('Prints')}", "run.shard_size=100"]
    plan = plan_campaign(load_campaign(tmp_path / "c.yaml", settings))
    assert plan["slow_av"].startswith("with run.shard_size 1 a task is one test of 12 s, and now up to 1,200 s")
    assert "slow_av" not in plan_campaign(load_campaign(tmp_path / "c.yaml", [settings[0], "run.shard_size=1"]))
