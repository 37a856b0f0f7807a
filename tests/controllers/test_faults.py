"""A controller's fault ends its episode, with the cause in the row; nothing else changes."""

import json
import re
import signal
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from benchmarks.kills import orphans
from harness.campaign.files import load_campaign
from harness.campaign.vehicle import Limits
from harness.cli import main
from harness.controllers.find import build_host, in_words
from harness.controllers.hosts import Guard, _numbers, optional, require_ours
from harness.controllers.protocol import Neighbour
from harness.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_TOO_MANY_FAILED, CampaignError, HarnessError
from harness.printed import PRINTED
from harness.runner.workers import LocalWorkers
from tests.controllers.misbehaving import Learned
from tests.in_process import controllers_here, one_process, without_page
from tests.stored_runs import sets, stored_table
from tests.worlds.running import drive, forced

SMALL = """\
name: faults
environment: {parameters: ndd-overtaking-1}
testing: {method: forced}
world: {engine: twin, cells: 20}
records: {moments: none}
stop: {episodes: 160}
run: {shard_size: 80, max_failed_share: 0.15}
"""
SHORT = ", limits: {step_time_s: 0.2}"
LATE = "no answer within 0.2 s (av.limits.step_time_s)"
LATE_MADE = "no answer within 0.2 s (av.limits.construction_time_s)"


def _main(command, folder, av, *more):
    """Exit code of a command with the small campaign."""
    (folder / "c.yaml").write_text(SMALL)
    words, *options = command.split()
    out = ["--out", str(folder / "run"), "--workers", "1"] if words == "run" else []
    with without_page():
        return main([words, str(folder / "c.yaml"), *options, *out, *sets(f"av={av}", *more)])


def _run(folder, av, *more):
    return _main("run", folder, av, *more)


def _of(name, more="", **parameters):
    """YAML of an AV that misbehaves."""
    return f"{{controller: 'tests.controllers.misbehaving:{name}', parameters: {json.dumps(parameters)}{more}}}"


def _misbehaving(bad, more="", **parameters):
    """Of one whose episodes misbehave as ``bad`` says."""
    return _of("Misbehaving", more, bad={str(episode): fault for episode, fault in bad.items()}, **parameters)


def without_place(cause):
    return re.sub(r" \(\w+\.py:\d+\)$", "", cause)


def _episodes(folder):
    return stored_table(folder / "run", "episodes").drop_columns("braked_before").to_pylist()  # asked of own code alone


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    with one_process():
        assert _run(folder, "{model: idm}") == EXIT_DONE
    return _episodes(folder)


def quick(n, cases):
    """The first n for every run of the tests, the others for .ci/full."""
    rows = [each if isinstance(each, tuple) else (each,) for each in cases]
    return [pytest.param(*row, marks=[pytest.mark.slow] * (k >= n)) for k, row in enumerate(rows)]


MODES = "changed the processor's rounding mode or floating-point flags (fesetround, -ffast-math); restore them"
IN_PROCESS = {
    **dict.fromkeys(("rounds_down", "flushes_to_zero"), f"step: {MODES}"),
    "rounds_up_and_raises": "step: ZeroDivisionError: no such thing",
    "asks_another_traci": "step: FatalTraCIError: Not connected. Use the traci that is handed in "
    "(docs/controllers.md), not the module",
    "raises": "step: ZeroDivisionError: no such thing",
    "none": "step: returned None (is a return missing?), expected an acceleration in m/s2 as a number",
    "masked": "step: returned MaskedConstant, expected an acceleration in m/s2 as a number",
    "time": "step: returned timedelta64, expected an acceleration in m/s2 as a number",
    "raises_what_lies": "step: LyingError: so",
    "nan": "step: returned nan, expected a finite acceleration in m/s2",
    "boolean": "step: returned bool, expected an acceleration in m/s2 as a number",
    "impossible": "step: asked for -99 m/s2, outside of av.limits (-15 to 10)",
    "lies": "step: asked for -1e+06 m/s2, outside of av.limits (-15 to 10)",
    "raises_what_cannot_be_printed": "step: UnprintableError, whose text raised ValueError",
    "raises_what_is_no_utf_8": "step: FileNotFoundError: no file \\udce9.csv",
    "exits": "step: SystemExit: 5",
    "interrupts": "step: KeyboardInterrupt",
    "hangs": f"step: StepTimeoutError: {LATE}",
    "hangs_and_swallows": f"step: StepTimeoutError: {LATE}",
    "hangs_in_start": f"start: StepTimeoutError: {LATE}",
}
CLOSED = "the controller closed file descriptors that are not its own (os.close, os.closerange)"
OF_THE_PROCESS = {
    "ends_the_process": "start: the controller ended the worker process (exit code 7)",
    "ends_the_process_in_start": "start: the controller ended the worker process (exit code 7)",
    "closes_descriptors": f"start: {CLOSED}",
    "crashes": "start: the controller ended the worker process (exit code -11)",
    "is_killed": "start: the controller ended the worker process (exit code -9)",
    "hangs_for_good": f"start: {LATE}, and the call could not be interrupted",
}


FIRST = {fault: OF_THE_PROCESS[fault] for fault in ("is_killed", "hangs_for_good")}


@pytest.mark.parametrize(
    "faults", quick(2, [IN_PROCESS, FIRST, OF_THE_PROCESS]), ids=["in it", "a kill and a hang", "of it"]
)
def test_a_fault_ends_its_episode_and_changes_no_other(faults, tmp_path, undisturbed):
    bad = {3 + 7 * i: fault for i, fault in enumerate(faults)}
    assert _run(tmp_path, _misbehaving(bad, SHORT)) == EXIT_DONE
    for row, without in zip(_episodes(tmp_path), undisturbed, strict=True):
        if row["episode"] in bad:
            fault = bad[row["episode"]]
            assert (row["outcome"], without_place(row["failure"])) == ("failed", faults[fault])
            assert fault not in ("raises", "hangs_and_swallows") or re.search(r"misbehaving\.py:\d+\)$", row["failure"])
            assert row["n_steps"] == (0 if faults[fault].startswith("start") else without["event_step"] + 3)
            assert row["log_weight"] == row["log_p_event"] == without["log_p_event"]  # in start as well
        else:
            assert row == without
    assert not list((tmp_path / "run").glob(".*"))
    estimates = json.loads((tmp_path / "run/estimates.json").read_text())
    headline = estimates["estimates"][estimates["headline"]]
    assert headline["details"]["n_failed"] == len(faults)
    assert headline["details"]["crash_rate_if_failed_had_crashed"] > headline["crash_rate"]


NO_FAULT = {
    "a worker killed from outside": _misbehaving({57: "is_killed"}, once="NOTE"),
    "a function that is the vehicle": _of("only_a_function", min_acceleration_mps2=-4.0),
    "a default timeout of sockets, and a signal ignored": _of("ChangesItsProcess"),
    "one with nothing but step_batch": _of("OnlyStepBatch"),
    "one that stops its process": _of("Stops", min_acceleration_mps2=-4.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("av", NO_FAULT.values(), ids=NO_FAULT)
def test_what_is_no_fault_of_an_episode_changes_none(av, tmp_path, undisturbed):
    assert _run(tmp_path, av.replace("NOTE", str(tmp_path / "note"))) == EXIT_DONE
    assert _episodes(tmp_path) == undisturbed


@pytest.mark.slow
@pytest.mark.parametrize(("episodes", "n", "share"), [(400, 200, 0.005), (40, 40, 0.04)])
def test_too_many_failures_are_no_answer(episodes, n, share, tmp_path, capsys):
    """They end a campaign halfway; one with fewer tests than that takes has no answer either."""
    sizes = f"stop.episodes={episodes}", "run.shard_size=200", f"run.max_failed_share={share}"
    assert _run(tmp_path, _misbehaving({5: "raises", 6: "raises"}), *sizes) == EXIT_TOO_MANY_FAILED
    err = capsys.readouterr().err
    assert "run.max_failed_share" in err
    assert f"2 of {n} tests failed, 2 of them with: step: ZeroDivisionError: no such thing" in err
    assert not (tmp_path / "run/estimates.json").exists()
    assert f"harness replay {tmp_path / 'run'} 5" in " ".join(err.split())
    assert main(["replay", str(tmp_path / "run"), "5"]) == EXIT_DONE
    assert re.search(r"AV +FAILS at [\d.]+ s: step: ZeroDivisionError: no such thing", capsys.readouterr().out)


SHORT_MADE = ", limits: {construction_time_s: 0.2}"
POPEN = "{controller: 'subprocess:Popen', parameters: {args: touch called, shell: true}}"
IN_CONSTRUCTOR = {
    "raises": "ZeroDivisionError: no such thing",
    "hangs_for_good": f"{LATE_MADE}, and the call could not be interrupted",
    "ends_the_process": "the controller ended the worker process (exit code 7)",
}
REFUSED = [
    ("{controller: 'no_such_module:X'}", "av.controller", "cannot be imported"),
    ("{controller: 'misbehavin:X'}", "av.controller", "Name its file"),
    (_of("OnlyStepp"), "av.controller", "Did you mean 'OnlyStep'?"),
    (_of("Misbehaving", badd="x"), "av.parameters", "Did you mean 'bad'?"),
    (_of("OnlyStep", ttc=3), "av.parameters", "fix:      Leave out av.parameters.ttc.\n"),
    (_of("only_a_function"), "av.parameters", "min_acceleration_mps2"),
    (_of("LoadsByItself"), "av.parameters", "fix:      Write @staticmethod above load.\n"),
    *(
        (_of("Always", SHORT_MADE, where="constructor", how=how), "av.controller", words)
        for how, words in IN_CONSTRUCTOR.items()
    ),
    (_of("RaisesForOtherNames"), "av.controller", "cannot be made: RuntimeError: step_batch (misbehaving.py:"),
    (_of("says_nothing"), "av.controller", "without step"),
    (_of("an_object"), "av.controller", "fix:      It has: "),
    (_of("StepMisspelt"), "av.controller", "fix:      Rename stp to step.\n"),
    (_of("StepOfProperty"), "av.controller", "fix:      Write def step(self, seen): return 0.0"),
    (_of("StepOfNothing"), "av.controller", "fix:      Write def step(self, seen): in it.\n"),
    (_of("StartOfNothing"), "av.controller", "fix:      Write def start(self, episode): in it.\n"),
    (POPEN, "av.controller", "Popen without step"),
]


@pytest.mark.parametrize(
    ("av", "where", "words"),
    [pytest.param(*each, marks=[pytest.mark.slow] * ("hangs_for_good" in each[0])) for each in REFUSED],
)
def test_check_refuses_what_run_refuses_and_makes_nothing_but_controllers(av, where, words, tmp_path, capsys):
    complaints, harmless = [], "construct" not in av
    for command in ("check", "run", "av-check") if words.startswith("Popen") else ("check", "run"):
        with controllers_here() if harmless else nullcontext():
            assert _main(command, tmp_path, av) == EXIT_BAD_INPUT
        complaints.append(capsys.readouterr())
    assert set(complaints) == {complaints[0]}
    assert complaints[0].err.startswith(f"error: {where}\n")
    assert words in complaints[0].err
    assert not (tmp_path / "run").exists()
    assert not Path("called").exists()


@pytest.mark.parametrize("at", quick(1, ["constructor", "step"]))
@pytest.mark.parametrize(
    "what",
    [
        "math.isfinite",
        "pyarrow.parquet.write_table",
        "numpy",
        "harness",
        "harness.controllers.hosts.Guard",
        "harness.controllers.hosts.Guard.acceleration",
        "harness.loop.loop.judge",
        "harness.controllers.hosts.math",
        "io.BytesIO",
        "hashlib.sha256",
        "pathlib.Path.read_bytes",
        "pathlib.PurePath.__truediv__",
        "sys.exc_info",
        "multiprocessing.reduction.ForkingPickler.dumps",
        "multiprocessing.connection.Connection.recv",
        "threading.Condition",
        "numpy.random.Generator",
        "selectors.PollSelector.select",
        "sys.excepthook",
    ],
)
def test_one_that_replaces_what_the_harness_calls_is_named(what, at, tmp_path, capsys):
    assert _run(tmp_path, _of("Replaces", what=what, at=at)) == EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert err.startswith("error: av.controller\n")
    assert f"a vehicle that has replaced {what}, which the harness calls, too" in err
    assert (tmp_path / "run").exists() == (at == "step")


def test_what_the_users_code_raises_between_its_calls_is_named_and_our_own_errors_are_not():
    """As the handler of a timer that it has left."""

    def late(*_):
        raise OSError("too late")

    with pytest.raises(OSError, match="too late") as raised:
        late()
    with pytest.raises(CampaignError, match=r"that raises between its calls: OSError: too late \(test_faults"):
        require_ours(raised.value)
    require_ours(ValueError("of the harness, without a line of theirs"))


@pytest.mark.parametrize(
    ("av", "error", "told"),
    [
        (_of("Global"), TypeError("spoilt"), CampaignError),
        (_of("Global"), OSError("disk full"), OSError),
        (_of("Global"), HarnessError("a", "b", "c", "d"), HarnessError),
        ("{model: idm}", TypeError("a defect"), TypeError),
    ],
)
def test_what_foreign_code_breaks_of_the_harness_is_told_in_words(av, error, told, capsys):
    """In a worker: as a plain value that the harness reads, set to None. A defect beside a built-in model is one."""
    with pytest.raises(told) as raised:
        in_words(load_campaign("idm", [f"av={av}"]).av, Mock(side_effect=error))
    assert (told is type(error)) == (raised.value is error)
    if told is CampaignError:
        assert "after whose code the harness fails in its process: TypeError: spoilt" in str(raised.value)
        assert "TypeError: spoilt" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("code", "cause"),
    [
        ("import asyncio\n\nraise asyncio.CancelledError\n", "CancelledError (my.py:3)"),
        ("while True:\n    pass\n", "StepTimeoutError: no answer within 0.2 s (av.limits.construction_time_s) (my.py:"),
    ],
)
def test_a_module_that_raises_what_is_no_exception_or_goes_on_for_good_is_named(code, cause, tmp_path, capsys):
    (tmp_path / "my.py").write_text(code, "utf-8")
    assert _run(tmp_path, f"{{controller: '{tmp_path}/my.py:A'{SHORT_MADE}}}") == EXIT_BAD_INPUT
    assert f"my.py:A, whose module cannot be imported ({cause}" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    "call", ["close()", "simulationStep()", "vehicle.setSpeed('AV0', 3.0)", "vehicle.remove('LV0')"]
)
def test_one_that_changes_the_simulation_that_it_is_tested_in_is_named(call, tmp_path, capsys):
    assert _run(tmp_path, _of("CallsSumo", call=f"libsumo.{call}"), "world.engine=sumo") == EXIT_BAD_INPUT
    assert "a vehicle that has changed the simulation that it is tested in" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:coroutine")
def test_a_start_that_is_async_or_yields_has_failed_since_nothing_of_it_was_run():
    async def later(_):
        pass

    def parts(_):
        yield

    with Guard(Limits()) as guard:
        found = [guard.call(optional("start", None), SimpleNamespace(start=start)) for start in (later, parts)]
    assert found == 2 * [(None, "TypeError: start is async, or yields: nothing of it was run")]


def test_one_that_reads_what_is_seen_as_a_dictionary_is_told_how():
    with Guard(Limits()) as guard:
        _, why = guard.call(lambda seen: seen["gap_m"], Neighbour(9.0, 20.0, 0))
    assert "indices must be integers or slices, not str. What is seen has fields: seen.gap_m, not" in why


def test_a_call_whose_time_is_over_at_once_has_failed_like_any_that_is_late(monkeypatch):
    monkeypatch.setattr(signal, "setitimer", lambda *_: signal.raise_signal(signal.SIGALRM))
    with Guard(Limits()) as guard:
        _, wrong = guard.call(int)
    assert without_place(wrong) == "StepTimeoutError: no answer within 10 s (av.limits.step_time_s)"


def test_one_after_which_no_file_can_be_opened_is_told_so(tmp_path, capsys):
    assert _run(tmp_path, _of("KeepsOpen")) == EXIT_BAD_INPUT
    assert "nobody can open a file (Too many open files)" in capsys.readouterr().err


def test_what_is_loaded_is_loaded_once_a_process_and_shared_and_nothing_else_is(tmp_path):
    av = forced(f"av={_of('Learned', note=str(tmp_path / 'note'), braking=[1.0])}").av
    host = build_host(av, n_cells=3, seed=1)
    assert host.start(*3 * (np.arange(3),), np.zeros(3)) == {}
    made = Learned.made[-3:]
    assert (tmp_path / "note").read_text() == "loaded 3\n"
    assert len({id(each.loaded) for each in made}) == 1
    assert len({id(each.braking) for each in made}) == 3
    assert [each.braking for each in made] == [[1.0, 0.01]] * 3  # each changes a list of its own
    assert av.parameters["braking"] == [1.0]
    assert (len(host.construction_s), len(Learned.made)) == (3, 3)  # the first of all is that of a cell
    host.close()


@pytest.mark.parametrize(
    ("answer", "numbers", "wrong"),
    [
        (np.array([1.0, np.float32(2.0)], object), [1.0, 2.0], None),
        ([[1], [2]], [1.0, 2.0], None),
        (np.ma.array([1.0, 2.0], mask=[False, True]), [1.0, np.nan], None),
        (np.array([1.0, None], object), [1.0, np.nan], None),
        (np.array(["1", 2.0], object), None, "an array of object, expected accelerations"),
        (np.array([np.timedelta64(1, "s"), 2.0], object), None, "an array of object, expected accelerations"),
        (["1", "2"], None, "an array of <U1, expected accelerations"),
        ([1.0], None, "returned list of shape (1,), expected (2,)"),
        (None, None, "returned None (is a return missing?), expected (2,)"),
    ],
)
def test_what_a_batch_controller_may_answer(answer, numbers, wrong):
    found, why = _numbers(2, answer)
    assert (None if found is None else found.tolist()) == pytest.approx(numbers, nan_ok=True)
    assert (wrong or "None") in str(why)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"wrong_shape": True}, "ndarray of shape ("),
        ({"wrong_type": "complex"}, "an array of complex128, expected accelerations in m/s2 as numbers"),
    ],
)
def test_a_batch_controllers_fault_is_laid_at_one_cell_or_else_fails_all_that_were_asked(wrong, words, tmp_path):
    with one_process(), controllers_here():
        assert _run(tmp_path, _of("Batch", nan=137, **wrong), "run.max_failed_share=0.5") == EXIT_DONE
    failed = {row["episode"]: row["failure"] for row in _episodes(tmp_path) if row["outcome"] == "failed"}
    assert failed.pop(137) == "step_batch: returned nan, expected a finite acceleration in m/s2"
    assert failed
    assert all(f"step_batch: returned {words}" in cause for cause in failed.values())


@pytest.mark.slow
@pytest.mark.parametrize("av", [_of("Always", where="step"), _of("EndsAtTheStart")], ids=["step", "batch"])
def test_one_that_always_ends_its_process_is_named_after_a_few_workers(av, tmp_path, capsys, monkeypatch):
    started, start = [], LocalWorkers.new_worker
    monkeypatch.setattr(LocalWorkers, "new_worker", lambda self: (started.append(self), start(self))[1])
    assert _run(tmp_path, av, "run.max_failed_share=0.01") == EXIT_TOO_MANY_FAILED
    err = capsys.readouterr().err
    assert "ended the worker process" in err
    assert 2 <= len(started) <= 7
    assert "run.max_failed_share" in err


@pytest.mark.slow
def test_what_a_controller_starts_does_not_outlive_the_run(tmp_path):
    assert _run(tmp_path, _of("StartsPrograms", note=f"{tmp_path}/started")) == EXIT_DONE
    started = (tmp_path / "started").read_text().split()
    assert len(started) >= 40
    assert orphans(list(map(int, started)), 5.0) == []


def test_what_a_controller_prints_does_not_reach_stdout(tmp_path, capfd):
    assert _main("run --json", tmp_path, _of("Prints")) == EXIT_DONE
    printed = capfd.readouterr()
    json.loads(printed.out)
    text, told = (tmp_path / "run" / PRINTED).read_text(), printed.err.splitlines()[-2:]
    assert told[0].startswith(f"{len(text.splitlines()):,} lines printed by the vehicle")
    assert told[1] == f"  the first: {text.splitlines()[0]}"  # of some hundred lines the terminal shows one
    assert "made, in Python" in text
    assert "made, below Python" in text


@pytest.mark.slow
def test_nor_does_what_it_prints_in_a_replay_or_a_check(tmp_path, capfd):
    assert _run(tmp_path, _of("Prints")) == EXIT_DONE
    capfd.readouterr()
    assert main(["replay", str(tmp_path / "run"), "3", "--json"]) == EXIT_DONE
    printed = capfd.readouterr()
    assert json.loads(printed.out)["bit_equal"] is True
    assert "started, below Python" in printed.err
    assert _main("av-check --tests 4 --json", tmp_path, _of("Prints")) == EXIT_DONE
    printed = capfd.readouterr()
    json.loads(printed.out)
    assert re.search(r"^[\d,]+ lines printed by the vehicle.*\n  the first: .+$", printed.err, re.MULTILINE)
    assert len(printed.err.splitlines()) < 10


@pytest.mark.slow
def test_of_much_that_is_printed_the_first_and_the_last_are_passed_on(tmp_path, capfd):
    assert _run(tmp_path, _of("PrintsMuch"), "stop.episodes=100") == EXIT_DONE
    assert len(capfd.readouterr().err) < 1_000
    printed = (tmp_path / "run" / PRINTED).read_text()
    assert re.search(r"^\[\d\d[\d,]+ bytes more that a worker has printed\]$", printed, re.MULTILINE)
    assert 2 * 65_536 < len(printed) < 9 * 65_536
    assert re.match(r"[-\d.]+ s x", printed)
    assert printed.endswith("x\n")


@pytest.mark.parametrize("field", ["cell", "lv_speed_mps", "episodes"])
def test_nothing_that_a_batch_controller_is_handed_can_be_written_into(field):
    failures = drive(f"av={_of('Batch', overwrites=field)}", cells=8, n=24).failures
    failures = {k: without_place(cause) for k, cause in failures.items()}
    call = "start_batch" if field in ("cells", "episodes") else "step_batch, warming up"
    assert failures == dict.fromkeys(range(24), f"{call}: ValueError: assignment destination is read-only")
