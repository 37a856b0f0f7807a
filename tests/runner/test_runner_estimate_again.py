"""`harness estimate` on a stored run is `estimates.json`, exactly."""

from __future__ import annotations

import json

from harness.cli import main
from harness.runner import estimate_run
from tests.runner.stored_runs import copy_of


def test_estimating_again_gives_the_same_content(sumo_run, twin_run):
    for folder in (sumo_run, twin_run):
        assert estimate_run(folder) == json.loads((folder / "estimates.json").read_text())


def test_the_command_prints_the_same_content(twin_run, capsys):
    assert main(["estimate", str(twin_run), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((twin_run / "estimates.json").read_text())


def test_writing_it_again_gives_the_same_file(twin_run, tmp_path):
    folder = copy_of(twin_run, tmp_path / "run")
    before = (folder / "estimates.json").read_bytes()
    (folder / "estimates.json").unlink()
    assert main(["estimate", str(folder), "--write"]) == 0
    assert (folder / "estimates.json").read_bytes() == before


def test_another_confidence_changes_intervals_and_not_the_rate(twin_run):
    stored = json.loads((twin_run / "estimates.json").read_text())
    wider = estimate_run(twin_run, confidence=0.99)
    headline = stored["headline"]
    assert wider["estimates"][headline]["crash_rate"] == stored["estimates"][headline]["crash_rate"]
    assert wider["estimates"][headline]["ci_high"] > stored["estimates"][headline]["ci_high"]


def test_rate_and_counts_can_be_had_from_the_table_alone(sumo_run):
    """The estimate `nade` is the plain mean of exp(log_weight) over crashes."""
    import math

    from tests.runner.stored_runs import stored_table

    rows = stored_table(sumo_run, "episodes")
    outcomes, log_weights = rows["outcome"].to_pylist(), rows["log_weight"].to_pylist()
    weights = [math.exp(w) for w, outcome in zip(log_weights, outcomes, strict=True) if outcome == "crash"]
    nade = estimate_run(sumo_run)["estimates"]["nade"]
    assert math.isclose(nade["crash_rate"], math.fsum(weights) / rows.num_rows, rel_tol=1e-12)
    assert nade["n_crashes"] == len(weights)
