"""`harness estimate` on a stored run is `estimates.json`, exactly, and the rate is the mean of stored weights."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import harness
from harness.cli import main
from harness.errors import RunFolderError
from harness.estimators.block import joined
from harness.runner import stored
from harness.runner.stored import estimate_run, stored_blocks
from tests.stored_runs import copy_of, edit, estimates, manifest, of_before

ESTIMATOR = {"shells-twin": "shells", "nde-twin": "nde"}
RECORDS = (Path(__file__).parents[2] / "docs/records.md").read_text()
LINES = "\n".join(re.findall(r"^```python\n(.*?)^```$", RECORDS, re.MULTILINE | re.DOTALL))


def test_estimating_again_gives_the_same_content(sumo_run, twin_run, capsys):
    for folder in (sumo_run, twin_run):
        assert estimate_run(folder) == estimates(folder)
    assert main(["estimate", str(twin_run), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == estimates(twin_run)


def test_another_confidence_changes_intervals_and_not_the_rate(twin_run):
    stored = estimates(twin_run)
    wider = estimate_run(twin_run, confidence=0.99)
    headline = stored["headline"]
    assert wider["estimates"][headline]["crash_rate"] == stored["estimates"][headline]["crash_rate"]
    assert wider["estimates"][headline]["ci_high"] > stored["estimates"][headline]["ci_high"]


def test_of_the_prefix_that_counts_what_is_asked_and_the_headline_are_estimated(stored_run, tmp_path):
    folder = copy_of(stored_run("step-recursive-twin"), tmp_path / "run")
    shards = [{**shard, "files": {"episodes": shard["files"]["episodes"]}} for shard in manifest(folder)["shards"]]
    edit(folder, n_episodes=200, shards=shards)
    content, asked = estimate_run(folder), estimate_run(folder, estimators=["scv"])
    assert content["n_episodes"] == content["convergence"][-1]["n"] == 200
    assert asked["estimates"] == {name: content["estimates"][name] for name in ("nade", "scv")}
    assert content["estimates"]["scv"]["crash_rate"] is None
    assert "records.moments" in content["estimates"]["scv"]["reason"]


@pytest.mark.parametrize(("most", "sizes"), [(90, [80, 160, 160]), (170, [80, 240, 80]), (5_000, [80, 320])])
def test_shards_are_read_in_groups_without_changing_a_bit(most, sizes, twin_run, monkeypatch):
    """Five shards of 80 tests, as one block of several tables."""
    one_by_one = list(stored_blocks(twin_run, moments=False))
    monkeypatch.setattr(stored, "SPACING", 100.0)
    monkeypatch.setattr(stored, "MOST_GROUPED", most)
    grouped = list(stored_blocks(twin_run, moments=False))
    assert ([len(block) for block in one_by_one], [len(block) for block in grouped]) == ([80] * 5, sizes)
    whole, again = joined(one_by_one), joined(grouped)
    assert whole.columns.keys() == again.columns.keys()
    assert all(np.array_equal(column, again.columns[name]) for name, column in whole.columns.items())
    np.testing.assert_array_equal(whole.outcome, again.outcome)
    np.testing.assert_array_equal(whole.log_weight, again.log_weight)


def test_shards_with_columns_of_other_types_are_refused(twin_run, tmp_path, monkeypatch):
    folder = of_before(copy_of(twin_run, tmp_path / "run"))
    path = folder / "episodes" / sorted(path.name for path in (folder / "episodes").iterdir())[2]
    table = pq.read_table(path)
    column = table.schema.get_field_index("cut_in_step")
    pq.write_table(table.set_column(column, "cut_in_step", table.column(column).cast("float64")), path)
    monkeypatch.setattr(stored, "SPACING", 100.0)
    with pytest.raises(RunFolderError, match="cut_in_step as double and int16"):
        list(stored_blocks(folder, moments=False))


@pytest.mark.parametrize("name", ["shells-twin", "forced-twin", "nde-twin", "step-recursive-twin", "mixture-twin"])
def test_the_weights_give_the_rate_of_every_method_as_docs_have_it(name, stored_run, capsys):
    folder = stored_run(name)
    rate = estimates(folder)["estimates"][ESTIMATOR.get(name, "nade")]["crash_rate"]
    assert rate > 0.0
    tests = harness.read(folder).episodes(["outcome", "log_weight"])
    crash = tests.outcome == "crash"
    assert (tests.weight * crash).mean() == pytest.approx(rate, rel=1e-9)
    plain = (np.exp(tests.log_weight) * crash).mean()
    assert (plain == pytest.approx(rate, rel=1e-9)) == (name != "shells-twin")
    exec(LINES.replace("runs/hard-braking", str(folder)), {})
    assert float(capsys.readouterr().out.split()[-1]) == pytest.approx(rate, rel=1e-9)
