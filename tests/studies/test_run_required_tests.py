"""RNoT and AAR of stored runs: the rows, what is said about them, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from harness.cli import main
from harness.estimators.block import joined
from harness.studies.chains.named import overtaking
from harness.studies.chains.sampler import blocks
from harness.studies.required_tests import Procedure, plain_rhw, required_tests, scv_rhw
from harness.studies.run_required_tests import SCV_REMARK, required_tests_of_runs
from tests.chains.seed import SEED
from tests.estimators.run_folder import write_run
from tests.estimators.small_blocks import block

CHAIN = overtaking("two surrogates", skill=0.5, surrogates=[0.5, 0.2], level=0.02, horizon=6)
QUICK = Procedure(rhw=0.6, n_shuffles=5, ratio=1.3, seed=3)


def drawn(method: str, sizes=(600, 600, 300)):
    return list(blocks(CHAIN, method, list(sizes), SEED))


def test_a_stored_run_gives_what_its_blocks_give(tmp_path):
    folder = write_run(tmp_path / "run", drawn("step_mixture"))
    content = required_tests_of_runs([folder], QUICK, estimators=["nade", "scv"])
    tests = joined(drawn("step_mixture"))
    grid = QUICK.grid(1_500)
    nade = required_tests(plain_rhw(tests.weighted_crashes()[tests.crash], 1_500, QUICK), grid, QUICK.rhw)
    scv = required_tests(scv_rhw(tests, QUICK), grid, QUICK.rhw)
    assert [row["mean"] for row in content["rows"]] == [nade.mean, scv.mean]
    assert [row["aar"] for row in content["rows"]] == [1.0, nade.mean / scv.mean]
    assert SCV_REMARK in content["rows"][1]["remarks"]
    assert SCV_REMARK not in content["rows"][0]["remarks"]
    assert content["rows"][0]["grid"] == f"10 to 1,500 by 0.3 n ({len(grid)} looks)"
    assert content == required_tests_of_runs([folder], QUICK, estimators=["nade", "scv"])
    other = required_tests_of_runs([folder], replace(QUICK, seed=4), estimators=["nade", "scv"])
    assert other["rows"] != content["rows"]


def test_rows_do_not_depend_on_what_else_is_asked_and_shards_do_not_matter(tmp_path):
    one = write_run(tmp_path / "one", drawn("step_mixture", [1_500]))
    whole = drawn("step_mixture", [1_500])[0]
    cut = [whole.take(slice(a, b)) for a, b in pairwise([0, 100, 700, 1_500])]
    three = write_run(tmp_path / "three", cut)
    rows = required_tests_of_runs([one, three], QUICK, estimators=["nade", "scv"])["rows"]
    assert {**rows[0], "run": None} == {**rows[2], "run": None}
    assert rows[1]["mean"] == rows[3]["mean"]
    (alone,) = required_tests_of_runs([three], QUICK, estimators=["scv"])["rows"]
    assert {**alone, "aar": None} == {**rows[3], "aar": None}


@pytest.mark.parametrize(
    ("method", "plain"),
    [("nde", "nde"), ("forced", "nade"), ("step_mixture", "nade"), ("episode_mixture", "nade")],
)
def test_the_plain_estimator_is_the_default_of_every_method(tmp_path, method, plain):
    content = required_tests_of_runs([write_run(tmp_path, drawn(method))], QUICK)
    assert [row["estimator"] for row in content["rows"]] == [plain]
    assert content["rows"][0]["mean"] > 0


def test_what_the_records_do_not_allow_has_a_reason_and_is_no_reference(tmp_path):
    folder = write_run(tmp_path, drawn("step_mixture"), with_moments=False)
    refused, plain = required_tests_of_runs([folder], QUICK, estimators=["scv", "nade"])["rows"]
    assert refused["mean"] is None
    assert "records.moments" in refused["reason"]
    assert plain["aar"] == 1.0


def test_two_runs_that_never_settle_have_no_acceleration(tmp_path):
    parts = [block([True] + [False] * 99, method="nde", alpha=np.empty(0), log_q=np.empty((100, 0)))]
    folders = [write_run(tmp_path / name, parts) for name in ("a", "b")]
    content = required_tests_of_runs(folders, QUICK)
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    for row in content["rows"]:
        assert (row["mean"], row["mean_is_lower_limit"], row["never_reached"]) == (100, True, 5)
        assert (row["aar"], row["aar_is"]) == (None, "unknown")
        assert "the mean is a lower limit" in row["remarks"][0]


def test_a_record_that_is_too_short_is_told(tmp_path):
    folder = write_run(tmp_path, drawn("step_mixture"))
    (row,) = required_tests_of_runs([folder], replace(QUICK, rhw=0.35))["rows"]
    assert row["high_95"] > 750
    assert "ask a longer run" in row["remarks"][-1]


OPTIONS = ["--rhw", "0.6", "--shuffles", "5", "--seed", "3", "--ratio", "1.3"]


def test_the_command_prints_what_python_gives(tmp_path, capsys):
    folder = write_run(tmp_path / "run", drawn("step_mixture"))
    assert main(["rnot", str(folder), *OPTIONS, "-e", "nade", "-e", "scv", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content == required_tests_of_runs([folder], QUICK, estimators=["nade", "scv"])


def test_the_table_says_what_limits_its_numbers(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, method in (("mixture", "step_mixture"), ("forced", "forced")):
        write_run(tmp_path / name, drawn(method))
    assert main(["rnot", "mixture", "forced", *OPTIONS, "--total", "40", "-e", "nade", "-e", "scv"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in lines if line.startswith("│")]
    runs = [("mixture", "nade"), ("mixture", "scv"), ("forced", "nade"), ("forced", "scv")]
    assert [(row[0], row[1]) for row in rows] == runs
    assert rows[0][2:5] == ["1,500", "10 to 40 by 0.3 n (7 looks)", "5"]
    assert rows[0][5].startswith("≥ ")
    assert rows[3][3:] == ["-"] * 6
    assert f"mixture scv: {SCV_REMARK}" in lines
    assert any(line.startswith("mixture nade: ") and line.endswith("the mean is a lower limit") for line in lines)
    assert any(line.startswith("forced scv: ") and "step mixture" in line for line in lines)


def test_the_command_refuses_shells_in_plain_words(tmp_path, capsys):
    folder = write_run(tmp_path, drawn("nde"))
    text = (folder / "campaign.yaml").read_text().replace("method: nde", "method: shells")
    (folder / "campaign.yaml").write_text(text)
    assert main(["rnot", str(folder)]) == 2
    assert "drawn from shells" in capsys.readouterr().err
