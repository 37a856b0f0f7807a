"""Which stored runs surrogates can be asked about, and what is said where they cannot."""

from __future__ import annotations

import pytest

from harness.campaign import models
from harness.campaign.models import AutomatedVehicle, Campaign, PoolSettings
from harness.errors import RunFolderError
from harness.pool import storage
from harness.pool.surrogate_replay import PATH_COLUMNS
from harness.runner.surrogates import surrogates_of

COLUMNS = set(PATH_COLUMNS)


def campaign(**settings) -> Campaign:
    return Campaign(name="stored", **{"testing": models.Testing(method="step_mixture"), **settings})


@pytest.fixture(autouse=True)
def no_pool(monkeypatch, tmp_path):
    monkeypatch.setattr(storage, "cache_root", lambda: tmp_path)


@pytest.mark.parametrize(
    ("settings", "columns", "reason"),
    [
        (
            {"av": AutomatedVehicle(controller="a:B", before_cut_in="controller")},
            COLUMNS,
            "keeps its speed until the cut-in",
        ),
        ({"testing": models.Testing(method="shells")}, COLUMNS, "drawn from shells"),
        ({}, COLUMNS - {"bv_maneuvers", "r2_m"}, "columns r2_m, bv_maneuvers of the episodes table"),
        ({}, COLUMNS, "harness pool DIR/campaign.yaml"),
        ({"pool": PoolSettings(library="./gone.yaml")}, COLUMNS, "cannot be used"),
    ],
)
def test_what_cannot_be_asked_is_said(settings, columns, reason):
    assert reason in surrogates_of(campaign(**settings), columns)


def test_what_was_asked_for_and_is_wrong_is_an_error(tmp_path):
    (tmp_path / "pool.parquet").write_bytes(b"no pool")
    with pytest.raises(RunFolderError, match="not a whole pool"):
        surrogates_of(campaign(), COLUMNS, tmp_path / "pool.parquet")
