"""README's first command: the smoke campaign, by the command line, against a committed reference."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq

ROOT = Path(__file__).parent.parent
REFERENCE = json.loads((ROOT / "tests/reference/default.json").read_text(encoding="utf-8"))


def test_the_answer_is_that_of_the_reference(tmp_path):
    """Fixed seeds on both sides: beyond 2 standard errors with a probability of 5 % once, and none after."""
    folder = tmp_path / "smoke"
    command = [Path(sys.executable).with_name("harness"), "run", "scenarios/smoke.yaml", "--out", folder]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    estimates = json.loads((folder / "estimates.json").read_text(encoding="utf-8"))
    found = estimates["estimates"][estimates["headline"]]
    assert estimates["headline"] == "shells"
    assert found["rhw"] <= 0.05
    assert found["n_crashes"] >= 3000
    assert REFERENCE["relative_error"] <= 0.005
    assert "--seed 777" in REFERENCE["command"]
    combined = math.hypot(found["std_error"], REFERENCE["std_error"])
    assert abs(found["crash_rate"] - REFERENCE["crash_rate"]) < 2.0 * combined
    assert "as often as a careful and competent driver (r157-cc) would" in estimates["statement"]
    assert "If this vehicle brakes as hard as it takes, up to 3 m/s²" in estimates["boundary_statements"]["need-based"]
    statements = found["details"]["statements"]
    assert not any(each["refuted"] or each["n_ahead"] or each["rhw"] >= 0.03 for each in statements)
    assert found["warnings"] == []
    assert "Read this before using the number" not in (folder / "report.html").read_text(encoding="utf-8")
    rows = [pq.read_table(path, columns=["outcome"]) for path in (folder / "episodes").glob("*.parquet")]
    share = sum(table["outcome"].to_pylist().count("crash") for table in rows) / estimates["n_episodes"]
    assert share > 1e5 * REFERENCE["crash_rate"], "tests count without the probabilities of their shells"
