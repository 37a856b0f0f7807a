"""Simulated trajectories follow the laws that they were made from, as far as these can be read off the table."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy import stats

from harness.campaign.sections import EnvironmentSettings
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.loading import evaluate_laws, load_environment
from harness.families.cut_in.parameters import SHIPPED_FOLDER
from harness.vocabulary import ACCELERATIONS_MPS2
from studies.__main__ import main
from studies.traffic import beside_published
from studies.trajectories import ALIKE, CLOSEST_M, Differences, simulate
from tests.golden.campaigns import LATERAL_FILE

pytestmark = pytest.mark.slow

TRUE = ["v", "r1", "r1dot"]


@pytest.fixture(scope="module")
def environment() -> Environment:
    settings = EnvironmentSettings(parameters=LATERAL_FILE, lane_change_level=1000.0)
    made = load_environment(settings)
    numbers = made.numbers.copy()
    numbers["cut_in__ignore_share"] = 0.5
    return made._replace(numbers=numbers)


@pytest.fixture(scope="module")
def triples(environment: Environment) -> pd.DataFrame:
    """One row per triple and time, columns of LV (0), BV (1) and the vehicle behind (2) side by side."""
    table = simulate(environment, 40.0, 1)
    table["triple"], table["who"] = np.divmod(table.vehicle_id, 3)
    rows = table.pivot_table(index=["recording_id", "triple", "time_s"], columns="who").swaplevel(axis=1)
    lv, bv, behind = (rows[who] for who in range(3))
    half = 0.5 * bv.length_m
    return pd.DataFrame(
        {
            "v": bv.speed_mps,
            "r1": lv.s_m - bv.s_m - half - 0.5 * lv.length_m,
            "r1dot": lv.speed_mps - bv.speed_mps,
            "r2": bv.s_m - behind.s_m - half - 0.5 * behind.length_m,
            "r2dot": bv.speed_mps - behind.speed_mps,
            "beside": (bv.s_m - behind.s_m).abs() < half + 0.5 * behind.length_m,
            "lane": bv.lane,
            "lateral": bv.lateral_m,
            "v_lv": lv.speed_mps,
        }
    ).reset_index()


@pytest.mark.parametrize(("closest_s", "furthest_s"), [(0.0, 4.0), (4.0, 12.0), (12.0, np.inf), (np.inf, np.inf)])
def test_lane_changes_are_as_many_as_their_hazards_sum_up_to(
    triples: pd.DataFrame, environment: Environment, closest_s: float, furthest_s: float
) -> None:
    """The difference is a martingale: 4 standard errors miss once in 16,000 times."""
    of = triples.groupby(["recording_id", "triple"])
    before = (triples.lane == 1) & of.lane.shift(-1).notna()
    changes = before & (of.lane.shift(-1) == 0)
    closing = (triples.r2 > 0.0) & (triples.r2dot < 0.0)
    ttc = (triples.r2 / -triples.r2dot).where(closing, np.inf)
    here = before & ~triples.beside & (ttc >= closest_s) & ((ttc < furthest_s) | (furthest_s == closest_s))
    rows = triples[here]
    approaches = np.where(closing[here].to_numpy()[:, None], rows[["r2", "r2dot"]], [1.0, 1.0])
    *_, chance, accepted = evaluate_laws(environment, rows[TRUE].to_numpy(), approaches)
    expected = float((0.1 * -np.log1p(-chance * accepted)).sum())
    assert expected > 10
    assert abs(int(changes[here].sum()) - expected) < 4.0 * np.sqrt(expected)


def test_accelerations_are_those_of_the_laws(triples: pd.DataFrame, environment: Environment) -> None:
    """Of a second that begins in a state: numbers of each acceleration against the sum of their probabilities."""
    of = triples.groupby(["recording_id", "triple"])
    whole = (triples.time_s * 10).round() % 10 == 0
    stays = of.lane.shift(-10) == 1
    for law, column in enumerate(("v_lv", "v")):
        change = (of[column].shift(-10) - triples[column])[whole & stays]
        states = triples.loc[change.index, TRUE].to_numpy().copy()
        states[:, 0] = triples.loc[change.index, column]
        pmf = evaluate_laws(environment, states).pmf
        seen = np.bincount(np.abs(change.to_numpy()[:, None] - ACCELERATIONS_MPS2).argmin(axis=1), minlength=31)
        expected = pmf[law].sum(axis=0)
        assert len(change) > 10_000
        assert (np.abs(seen - expected) < 4.5 * np.sqrt(expected) + 1.0).all(), (seen, expected)


def test_a_lane_change_shows_itself_by_an_even_motion_to_the_marking(triples: pd.DataFrame) -> None:
    of = triples.groupby(["recording_id", "triple"])
    crosses = (triples.lane == 0) & (of.lane.shift(1) == 1)
    after, before = 3.4 - triples.lateral[crosses], 3.4 - of.lateral.shift(1)[crosses]
    assert len(after) > 100
    assert (after + before).abs().max() < 0.01 * 1.7
    assert (after - before).min() > 1.7 / 41  # the longest lead is 4 s


def test_nobody_drives_into_somebody(triples: pd.DataFrame) -> None:
    assert triples.r1[triples.lane == 1].quantile(0.0) > CLOSEST_M - 0.5  # a step after the last that was far enough
    assert not triples.beside[triples.lane == 0].any()


def test_vehicles_differ_and_are_measured_with_errors_that_were_asked_for(environment: Environment) -> None:
    only = {"hazard": 0.0, "recording_hazard": 0.0, "acceleration_mps2": 0.0, "spread": 0.0}
    exact, measured, different = (
        simulate(environment, 1.0, 2, each) for each in (ALIKE, Differences(**only), Differences())
    )
    assert len(measured) == len(exact)
    for column, sd in (("s_m", 0.1), ("speed_mps", 0.1), ("lateral_m", 0.03)):
        error = measured[column] - exact[column]
        assert error.std() == pytest.approx(sd, rel=0.05)
        assert error.diff().std() < 0.15 * sd  # but where one vehicle's rows end and those of another begin
    assert not different.lane.equals(measured.lane) or not different.time_s.equals(measured.time_s)


# -- environments beside published figures --


SHIPPED = (SHIPPED_FOLDER / "ndd-overtaking-2.yaml").read_text(encoding="utf-8")


def test_the_default_traffic_is_as_published(capsys: pytest.CaptureFixture[str]):
    assert main(["traffic"]) == 0
    assert "beside what is published" in capsys.readouterr().out
    rows = beside_published("ndd-overtaking-2")
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


def test_the_range_of_who_does_not_look_ends_where_published_figures_do():
    number = yaml.safe_load(SHIPPED)["cut_in"]["ignore_share"]
    (row,) = [row for row in beside_published("ndd-overtaking-2") if row["figure"] == "drivers who do not look"]
    assert row["within"][1] / 100.0 == pytest.approx(number["range"][1], abs=0.005)
