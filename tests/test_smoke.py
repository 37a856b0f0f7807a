"""README's first command: the smoke campaign, by the command line, against a committed reference."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

ROOT = Path(__file__).parent.parent
REFERENCE = json.loads((ROOT / "tests/reference/default.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "smoke"
    command = [sys.executable, "-m", "harness", "run", "scenarios/smoke.yaml", "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def estimates(folder):
    return json.loads((folder / "estimates.json").read_text(encoding="utf-8"))


def test_the_reference_is_precise_and_from_other_seeds():
    assert REFERENCE["relative_error"] <= 0.005
    assert "--seed 777" in REFERENCE["command"]
    assert "seed: 777" not in (ROOT / "scenarios/smoke.yaml").read_text(encoding="utf-8")


def test_the_precision_is_reached_with_enough_crashes(estimates):
    headline = estimates["estimates"][estimates["headline"]]
    assert headline["rhw"] <= 0.05
    assert headline["n_crashes"] >= 3000


def test_the_rate_is_within_two_standard_errors_of_the_reference(estimates):
    # Fixed seeds on both sides: a difference beyond 2 standard errors has a probability of 5 % once, and none after.
    found = estimates["estimates"]["shells"]
    combined = math.hypot(found["std_error"], REFERENCE["std_error"])
    assert abs(found["crash_rate"] - REFERENCE["crash_rate"]) < 2.0 * combined


def test_all_statements_are_made(estimates):
    assert "as often as a careful and competent driver (r157-cc) would" in estimates["statement"]
    assert "If this vehicle brakes as hard as it takes, up to 3 m/s²" in estimates["boundary_statements"]["need-based"]
    for found in estimates["estimates"]["shells"]["details"]["statements"]:
        assert found["rhw"] < 0.03
        assert not found["refuted"]


def test_dropping_the_probabilities_of_shells_misses_the_reference(folder, estimates):
    rows = [pq.read_table(path, columns=["outcome"]) for path in sorted((folder / "episodes").glob("*.parquet"))]
    share = sum(table["outcome"].to_pylist().count("crash") for table in rows) / estimates["n_episodes"]
    assert share > 1e5 * REFERENCE["crash_rate"]


def test_everything_a_user_expects_is_in_the_folder(folder):
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["status"] == "done"
    assert manifest["stopped_by"] == "rhw"
    assert "1.3" in (folder / "report.html").read_text(encoding="utf-8")
    assert sorted((folder / "plots").glob("*.png"))
    assert sorted((folder / "plots").glob("*.svg"))
    for table in ("episodes", "traces"):
        assert sorted((folder / table).glob("shard-*.parquet"))
