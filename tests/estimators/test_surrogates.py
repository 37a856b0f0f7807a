"""Which stored runs surrogates can be asked about, and what is said where they cannot."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from harness.campaign import models
from harness.campaign.models import AutomatedVehicle, Campaign, PoolSettings, Stop
from harness.errors import CampaignError, RunFolderError
from harness.estimators.martingale import Martingale
from harness.estimators.replay import Replay
from harness.estimators.surrogates import PoolRequest, surrogates_of
from harness.pool import storage
from harness.pool.surrogate_replay import PATH_COLUMNS

from .small_blocks import block

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
        ({}, COLUMNS, "harness estimate DIR -e replay"),
        ({"pool": PoolSettings(library="./gone.yaml")}, COLUMNS, "cannot be used"),
    ],
)
def test_what_cannot_be_asked_is_said(settings, columns, reason):
    assert reason in surrogates_of(campaign(**settings), columns, PoolRequest())


def test_what_was_asked_for_and_is_wrong_is_an_error(tmp_path):
    with pytest.raises(CampaignError):
        surrogates_of(campaign(pool=PoolSettings(library="./gone.yaml")), COLUMNS, PoolRequest(build=True))
    (tmp_path / "pool.parquet").write_bytes(b"no pool")
    with pytest.raises(RunFolderError, match="not a whole pool"):
        surrogates_of(campaign(), COLUMNS, PoolRequest(file=tmp_path / "pool.parquet"))


@pytest.mark.parametrize("method", ["nde", "forced", "shells"])
def test_martingale_needs_surrogates_that_controlled(method):
    assert "no surrogate controls anything" in Martingale.refusal(block([True], method=method))


def test_missing_columns_are_named():
    assert "column martingale" in Martingale.refusal(block([True], method="step_mixture"))
    assert "pool" in Replay.refusal(block([True], method="forced"))
    assert "shells" in Replay.refusal(block([True], method="shells"))


@pytest.mark.parametrize("estimator", ["martingale", "replay"])
def test_no_campaign_stops_on_regression_residuals(estimator):
    with pytest.raises(ValidationError, match="a stored run"):
        campaign(stop=Stop(estimator=estimator))
