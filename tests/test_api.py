"""The Python API does what its docstring says: load, run, estimate, report, replay, in a few lines."""

from __future__ import annotations

import base64
import doctest
import html
import inspect
import json
import math
import re
import subprocess
import sys
from importlib.metadata import version
from xml.etree import ElementTree

import numpy as np
import pyarrow.parquet as pq
import pytest

import harness
from harness.cli import main
from harness.resolved import resolve
from tests.in_process import one_process
from tests.stored_runs import MIXTURE_FILE, ROOT, estimates, sets

BUDGET = ("stop.episodes=3000", "stop.rhw=0.5", "stop.min_crashes=20", "run.shard_size=60")
SMALL = ["world.engine=twin", "testing.method=forced", "av={model: fvdm}", *BUDGET]


def test_all_that_is_promised_is_there():
    assert dir(harness) == harness.__all__
    assert all(inspect.getdoc(getattr(harness, name)) for name in harness.__all__)
    assert harness.__version__ == version("harness")
    with pytest.raises(AttributeError, match="nothing"):
        _ = harness.nothing


def test_importing_it_loads_nothing_slow_and_a_report_nothing_to_drive_or_to_plot_with():
    slow = {"numba", "scipy", "libsumo", "pandas", "pyarrow", "matplotlib"}
    of_report = {"matplotlib", "libsumo", "ray", "fmpy", "scipy.optimize", "rich"}
    code = f"import harness.cli, sys; print({slow} & {{*sys.modules}})"
    code += f"; import harness.report.page; print({of_report} & {{*sys.modules}})"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=MIXTURE_FILE.parents[1], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n") == ["set()", "set()", ""]


def test_load_run_estimate_and_replay_in_a_few_lines(tmp_path):
    folder = tmp_path / "run"
    result = harness.run(harness.load_campaign(str(MIXTURE_FILE), SMALL), str(folder), workers=1)
    assert (result.exit_code, result.stopped_by, result.folder) == (0, "rhw", folder)
    assert repr(result).startswith(f"fvdm · {result.estimates['n_episodes']:,} tests in SUMO")
    assert len(repr(result).splitlines()) <= 10
    assert result.estimates == estimates(folder) == harness.estimate(str(folder))
    assert harness.estimate(folder, estimators=["nade"], confidence=0.5)["confidence"] == 0.5
    files = {"campaign.yaml", "manifest.json", "estimates.json", "report.html", "plots", "episodes", "traces"}
    assert {path.name for path in folder.iterdir()} >= files
    assert (
        harness.load_campaign(folder / "campaign.yaml") == resolve(harness.load_campaign(MIXTURE_FILE, SMALL)).campaign
    )
    replayed = harness.replay(str(folder), 17)
    assert (replayed.bit_equal, replayed.outcome) == (True, replayed.row["outcome"])
    assert replayed.trace.num_rows == 3 * (replayed.row["n_steps"] + 1)
    with pytest.raises(harness.HarnessError, match="no test 10000"):
        harness.replay(folder, 10_000)
    with pytest.raises(harness.HarnessError, match="--resume"):
        harness.run(harness.load_campaign(MIXTURE_FILE, SMALL), folder)


RUN = "shells-twin"


@pytest.mark.parametrize(
    ("call", "where", "said"),
    [
        (lambda _: harness.run(3, "out"), "harness.run(campaign=", "found 3; expected a campaign (harness.load"),
        (lambda _: harness.run("idm", ""), "harness.run(out=", "the name of a file or folder"),
        (lambda _: harness.run("idm", "out", workers=0), "harness.run(workers=", "found 0; expected greater than"),
        (lambda _: harness.run("idm", "out", progress=print), "harness.run(progress=", "an instance of Progress"),
        (lambda _: harness.run("idm", "out", worker=2), "harness.run:", "Did you mean 'workers'?"),
        (lambda run: harness.estimate(run, ["nade"]), "harness.estimate:", "arguments folder, estimators="),
        (lambda _: harness.load_campaign("smoke.yaml", "stop.rhw=.1"), "(overrides=", "Write ['stop.rhw=.1']."),
        (lambda run: harness.estimate(run, confidence=math.nan), "(confidence=", "found nan"),
        (lambda run: harness.replay(run, np.int64(-1)), "harness.replay(episode=", "found -1"),
        (lambda run: harness.read(run / "no"), "no/manifest.json", "no run folder"),
        (lambda run: harness.read(run).table("episode"), "table(name=", "Did you mean 'episodes'?"),
        (
            lambda run: harness.write_motion(harness.replay(run, 0), "a.mp4"),
            "a.mp4",
            ".html, .csv, .xosc, .xml, .sumocfg",
        ),
        (lambda _: harness.compare("idm", "fvdm", "out", labels="ab"), "harness.compare(labels=", "a tuple"),
    ],
)
def test_arguments_that_are_wrong_are_named(call, where, said, stored_run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(harness.HarnessError) as caught:
        call(stored_run(RUN))
    assert where in str(caught.value)
    assert said in str(caught.value)
    assert list(tmp_path.iterdir()) == []


EXAMPLES = ("run", "estimate", "read", "replay", "compare")


@pytest.mark.slow
def test_examples_in_docstrings_give_what_they_say(tmp_path, monkeypatch):
    """In one folder, in this order: the run of the first is that of the others."""
    monkeypatch.chdir(tmp_path)
    runner = doctest.DocTestRunner(verbose=False)
    for name in EXAMPLES:
        (example,) = doctest.DocTestFinder(recurse=False).find(getattr(harness, name), name, globs={})
        assert example.examples, name
        runner.run(example)
    assert runner.summarize(verbose=False).failed == 0


@pytest.mark.parametrize("name", ["run", pytest.param("compare", marks=pytest.mark.slow)])
def test_in_a_notebook_it_is_the_short_answer_and_the_map(name, stored_run, tmp_path):
    """Of a campaign by its path, with a number of numpy's."""
    campaign = stored_run(RUN) / "campaign.yaml"
    given = {"run": (campaign,), "compare": (campaign, harness.load_campaign(campaign, av="r157-cc"))}[name]
    with one_process():
        result = getattr(harness, name)(*given, tmp_path / "out", workers=np.int64(1))
    text, image = result._repr_html_().split("</pre>")
    assert html.unescape(text) == f"<pre>{result!r}"
    assert len(repr(result).splitlines()) <= 10
    svg = base64.b64decode(re.search('base64,(.*?)"', image)[1])
    assert ElementTree.fromstring(svg).findall(".//{*}path")
    assert b"--ink" in svg


@pytest.mark.parametrize(
    ("call", "first", "map_below"),
    [
        (harness.estimate, "idm · ", True),
        (lambda run: harness.estimate(run, estimators=["shells"]), "golden: 49 crashes in ", True),
        (harness.read, "idm · ", True),
        (lambda run: harness.replay(run, 3), "test 3: ", False),
    ],
    ids=["estimate", "by estimator", "read", "replay"],
)
def test_what_is_stored_is_shown_in_ten_lines_too(call, first, map_below, stored_run, capsys):
    found = call(stored_run(RUN))
    assert repr(found).startswith(first)
    assert len(repr(found).splitlines()) <= 10
    text, image = found._repr_html_().split("</pre>")
    assert html.unescape(text) == f"<pre>{found!r}"
    assert ("<img" in image) is map_below
    if first == "idm · ":  # as the command line has it
        assert main(["estimate", str(stored_run(RUN))]) == 0
        assert capsys.readouterr().out == f"{found!r}\n"


REFERENCE = json.loads((ROOT / "tests/reference/default.json").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_the_answer_is_that_of_the_reference(tmp_path, capsys):
    """Fixed seeds on both sides: beyond 2 standard errors with a probability of 5 % once, and none after.

    In the twin, which other tests hold to SUMO in every bit.
    """
    folder = tmp_path / "shells"
    precise = "world.engine=twin", "stop.rhw=0.05", "testing.shells.first_tests=1400"  # as the reference deserves
    with one_process():
        assert main(["run", str(ROOT / "scenarios/overtaking_shells.yaml"), "--out", str(folder), *sets(*precise)]) == 0
    estimates = json.loads((folder / "estimates.json").read_text(encoding="utf-8"))
    found = estimates["estimates"][estimates["headline"]]
    assert estimates["headline"] == "shells"
    assert found["rhw"] <= 0.05
    assert found["n_crashes"] >= 3000
    assert REFERENCE["relative_error"] <= 0.005
    assert "--seed 777" in REFERENCE["command"]
    combined = math.hypot(found["std_error"], REFERENCE["std_error"])
    assert abs(found["crash_rate"] - REFERENCE["crash_rate"]) < 2.0 * combined
    assert "× competent driver" in capsys.readouterr().out
    within = found["details"]["within"]
    assert not within["refuted"]
    assert within["rhw"] < 0.03
    assert found["warnings"] == []
    assert "Read this before using the number" not in (folder / "report.html").read_text(encoding="utf-8")
    rows = [pq.read_table(path, columns=["outcome"]) for path in (folder / "episodes").glob("*.parquet")]
    share = sum(table["outcome"].to_pylist().count("crash") for table in rows) / estimates["n_episodes"]
    assert share > 1e5 * REFERENCE["crash_rate"], "tests count without the probabilities of their shells"
