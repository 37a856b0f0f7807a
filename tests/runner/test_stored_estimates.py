"""`harness estimate` on a stored run is `estimates.json`, exactly; and what surrogates can be asked about it."""

from __future__ import annotations

import json
import math
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

from harness.campaign import models
from harness.campaign.campaign import Campaign
from harness.campaign.sections import PoolSettings
from harness.campaign.vehicle import AutomatedVehicle
from harness.cli import main
from harness.errors import RunFolderError
from harness.estimators.block import columns_of, joined
from harness.pool import storage
from harness.pool.replay import PATH_COLUMNS
from harness.runner import estimate_run, stored_estimates
from harness.runner.stored_estimates import stored_blocks, surrogates_of
from tests.runner.stored_runs import copy_of, stored_table


def test_estimating_again_gives_the_same_content(sumo_run, twin_run, capsys):
    for folder in (sumo_run, twin_run):
        assert estimate_run(folder) == json.loads((folder / "estimates.json").read_text())
    assert main(["estimate", str(twin_run), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((twin_run / "estimates.json").read_text())


def test_another_confidence_changes_intervals_and_not_the_rate(twin_run):
    stored = json.loads((twin_run / "estimates.json").read_text())
    wider = estimate_run(twin_run, confidence=0.99)
    headline = stored["headline"]
    assert wider["estimates"][headline]["crash_rate"] == stored["estimates"][headline]["crash_rate"]
    assert wider["estimates"][headline]["ci_high"] > stored["estimates"][headline]["ci_high"]


def test_rate_and_counts_can_be_had_from_the_table_alone(sumo_run):
    """The estimate `nade` is the plain mean of exp(log_weight) over crashes."""
    rows = stored_table(sumo_run, "episodes")
    outcomes, log_weights = rows["outcome"].to_pylist(), rows["log_weight"].to_pylist()
    weights = [math.exp(w) for w, outcome in zip(log_weights, outcomes, strict=True) if outcome == "crash"]
    nade = estimate_run(sumo_run)["estimates"]["nade"]
    assert math.isclose(nade["crash_rate"], math.fsum(weights) / rows.num_rows, rel_tol=1e-12)
    assert nade["n_crashes"] == len(weights)


@pytest.mark.parametrize(
    ("most", "edge", "sizes"),
    [(90, 0, [80, 160, 160]), (170, 0, [80, 240, 80]), (5_000, 0, [80, 320]), (5_000, 240, [80, 160, 160])],
)
@pytest.mark.parametrize("gathered", [True, False])
def test_shards_are_read_in_groups_without_changing_a_bit(most, edge, sizes, gathered, twin_run, tmp_path, monkeypatch):
    """Five shards of 80 tests: `joined` blocks of gathered shards, or one block of several tables."""
    folder = copy_of(twin_run, tmp_path / "run")
    if not gathered:
        shutil.rmtree(folder / "gathered")
    one_by_one = list(stored_blocks(folder, moments=False))
    monkeypatch.setattr(stored_estimates, "SPACING", 100.0)
    monkeypatch.setattr(stored_estimates, "MOST_GROUPED", most)
    grouped = list(stored_blocks(folder, moments=False, n_asked=edge))
    assert ([len(block) for block in one_by_one], [len(block) for block in grouped]) == ([80] * 5, sizes)
    whole, again = joined(one_by_one), joined(grouped)
    assert columns_of(whole).keys() == columns_of(again).keys()
    assert all(np.array_equal(column, columns_of(again)[name]) for name, column in columns_of(whole).items())


def test_shards_with_columns_of_other_types_are_refused(twin_run, tmp_path, monkeypatch):
    folder = copy_of(twin_run, tmp_path / "run")
    shutil.rmtree(folder / "gathered")
    path = folder / "episodes" / sorted(path.name for path in (folder / "episodes").iterdir())[2]
    table = pq.read_table(path)
    column = table.schema.get_field_index("cut_in_step")
    pq.write_table(table.set_column(column, "cut_in_step", table.column(column).cast("float64")), path)
    monkeypatch.setattr(stored_estimates, "SPACING", 100.0)
    with pytest.raises(RunFolderError, match="cut_in_step as double and int16"):
        list(stored_blocks(folder, moments=False))


COLUMNS = set(PATH_COLUMNS)
EARLY = AutomatedVehicle(controller="a:B", before_cut_in="controller")


def of_stored(**settings) -> Campaign:
    return Campaign(name="stored", **{"testing": models.Testing(method="step_mixture"), **settings})


@pytest.mark.parametrize(
    ("settings", "columns", "reason"),
    [
        ({"av": EARLY}, COLUMNS, "keeps its speed until the cut-in"),
        ({"testing": models.Testing(method="shells")}, COLUMNS, "drawn from shells"),
        ({}, COLUMNS - {"bv_maneuvers", "r2_m"}, "columns r2_m, bv_maneuvers of the episodes table"),
        ({}, COLUMNS, "harness pool DIR/campaign.yaml"),
        ({"pool": PoolSettings(library="./gone.yaml")}, COLUMNS, "cannot be used"),
    ],
)
def test_what_surrogates_cannot_be_asked_is_said(settings, columns, reason, monkeypatch, tmp_path):
    monkeypatch.setattr(storage, "cache_root", lambda: tmp_path)
    assert reason in surrogates_of(of_stored(**settings), columns)


def test_a_pool_that_was_asked_for_and_is_wrong_is_an_error(tmp_path):
    (tmp_path / "pool.parquet").write_bytes(b"no pool")
    with pytest.raises(RunFolderError, match="not a whole pool"):
        surrogates_of(of_stored(), COLUMNS, tmp_path / "pool.parquet")
