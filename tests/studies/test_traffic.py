"""Environments beside published figures: the shipped default holds them, and wrong numbers are found by name."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import yaml
from scipy import stats

from harness.families.cut_in.parameters import SHIPPED_FOLDER
from studies.__main__ import main
from studies.traffic import beside_published

pytestmark = pytest.mark.slow

SHIPPED = (SHIPPED_FOLDER / "ndd-overtaking-2.yaml").read_text(encoding="utf-8")


def test_the_default_traffic_is_as_published(capsys: pytest.CaptureFixture[str]):
    assert main(["traffic", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["figure"] for row in rows if row["verdict"] == "fail"] == []
    assert sum(row["verdict"] == "pass" for row in rows) >= 10
    lead = {row["figure"]: row["model"] for row in rows}["onset to middle of a cut-in, 95 %"]
    assert lead == pytest.approx(1.7 / 0.867 * math.exp(0.30 * stats.norm.isf(0.05)), rel=0.01)


@pytest.mark.parametrize(
    ("old", "new", "fails"),
    [
        ("accept_ttc_s: {value: 5.5", "accept_ttc_s: {value: 5.0", "the same, of the scenario's cut-ins"),
        (
            "share: {value: 0.01, source: assumed, range: [0.001, 0.25]",
            "share: {value: 0.3, source: user",
            "drivers who do not look",
        ),
        ("speed_median_mps: {value: 0.867", "speed_median_mps: {value: 1.1", "onset to middle of a cut-in, median"),
        ("speed_log_sd: {value: 0.30", "speed_log_sd: {value: 0.5", "time to line crossing, lowest 1 %"),
    ],
)
def test_wrong_numbers_are_found(tmp_path: Path, old: str, new: str, fails: str):
    assert old in SHIPPED
    (file := tmp_path / "wrong.yaml").write_text(SHIPPED.replace(old, new), encoding="utf-8")
    assert fails in [row["figure"] for row in beside_published(str(file)) if row["verdict"] == "fail"]


def test_cut_ins_of_one_step_are_not_as_published(capsys: pytest.CaptureFixture[str]):
    assert main(["traffic", "ndd-overtaking-1"]) == 1
    assert " fail" in capsys.readouterr().out


def test_the_range_of_who_does_not_look_ends_where_published_figures_do():
    number = yaml.safe_load(SHIPPED)["cut_in"]["ignore_share"]
    (row,) = [row for row in beside_published("ndd-overtaking-2") if row["figure"] == "drivers who do not look"]
    assert row["within"][1] / 100.0 == pytest.approx(number["range"][1], abs=0.005)
