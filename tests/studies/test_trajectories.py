"""Simulated trajectories follow the laws that they were made from, as far as these can be read off the table."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy import stats
from scipy.stats import gamma

from harness.campaign.sections import EnvironmentSettings
from harness.families.cut_in.fitting.fitter import HEAVIEST_TAILS, fit_traffic
from harness.families.cut_in.fitting.hazard import Acceptance
from harness.families.cut_in.fitting.laws import ObservedTraffic
from harness.families.cut_in.fitting.observations import observe
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.loading import evaluate_laws, load_environment, load_parameters
from harness.families.cut_in.parameters import SHIPPED_FOLDER
from harness.families.cut_in.vocabulary import ACCELERATIONS_MPS2
from harness.fitting.table import load_mapping, recordings
from harness.progress import Progress
from studies import roundtrip
from studies.__main__ import main
from studies.traffic import beside_published
from studies.trajectories import ALIKE, CLOSEST_M, Differences, simulate, write
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


# -- fits of data sets --


def test_traffic_is_fitted_whose_speed_differences_are_as_wide_as_on_motorways_and_that_hardly_brakes(
    tmp_path: Path,
) -> None:
    """With the base's tails LV would exceed 100 m/s: lighter ones are assumed, and written to the environment.

    What was never seen is not taken from the base where the data exclude it.
    """
    environment = load_environment(roundtrip.TRAFFIC)
    numbers = environment.numbers.copy()
    numbers["initial_state__r1dot_log_scale"] = 1.2
    numbers["free_driving__brake_logit"] = -12.0
    write(simulate(environment._replace(numbers=numbers), 5.0, 1), tmp_path / "wide.parquet")
    traffic = ObservedTraffic.of(map(observe, recordings([tmp_path / "wide.parquet"], load_mapping())))
    fit = fit_traffic(traffic, "wide", Progress())
    found = fit.environment.values()
    assert (
        found["free_driving__brake_logit"]
        < load_parameters(roundtrip.FITTED).values()["free_driving__brake_logit"] - 1.0
    )
    df = found["initial_state__r1dot_df"]
    assert df in HEAVIEST_TAILS[2:]
    assert df == pytest.approx(fit.laws["rate"].estimate["initial_state__r1dot_df"])


def test_shares_of_one_step_do_not_lean_on_those_of_others() -> None:
    """More lane changes at the shortest times than at the next ones are chance, where nobody looks."""
    exposure = np.array([45.0, 45.0, 44.0, 78.0, 99.0, 900.0])
    counts = Acceptance(np.array([9, 1, 0, 13, 84, 900]), exposure, np.zeros((5, 1)), np.arange(5), exposure[:5])
    assert counts.shares == pytest.approx([9 / 45, 1 / 45, 0.5 / 44, 13 / 78, 84 / 99, 1.0])
    drawn = counts.drawn(np.zeros((20_000, 1)), np.random.default_rng(1))
    for step, (k, exposure) in enumerate(zip(counts.events[:-1], counts.exposure, strict=False)):
        expected = gamma.ppf([0.05, 0.95], k + 0.5) / exposure
        assert np.quantile(drawn[:, step], [0.05, 0.95]) == pytest.approx(np.minimum(expected, 1.0), rel=0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One data set of 10 vehicle-hours."""
    made = tmp_path_factory.mktemp("roundtrip")
    roundtrip.data_sets(made, 10.0, 1, 40, Progress())
    return made


def test_a_data_set_is_fitted_once_and_near_what_was_put_in(folder: Path) -> None:
    before = [path.stat().st_mtime_ns for path in folder.rglob("*.*")]
    (rows,) = roundtrip.data_sets(folder, 10.0, 1, 40, Progress())
    assert [path.stat().st_mtime_ns for path in folder.rglob("*.*")] == before
    assert rows.index.value_counts()[roundtrip.REPLICATE] == 40
    estimate = rows.loc[[roundtrip.ESTIMATE]]
    true = load_environment(roundtrip.TRAFFIC, roundtrip.truth())
    for state in roundtrip.STATES:  # within four standard errors, which are 0.2 to 0.5
        wished = -np.log1p(-evaluate_laws(true, np.array([state])).chance[0])  # 1/s
        off = roundtrip.log_hazard(estimate, state)[0] - np.log(wished)
        assert abs(off) < 4.0 * roundtrip.log_hazard(rows.loc[[roundtrip.REPLICATE]], state).std()
    mean = roundtrip.on_common_knots(estimate)
    assert roundtrip.log_hazard(pd.DataFrame([mean]), (30.0, 30.0, -2.0)) == pytest.approx(
        roundtrip.log_hazard(estimate, (30, 30, -2)), abs=0.1
    )
    kept = roundtrip.parameters_of({str(name): value for name, value in estimate.iloc[0].items()})
    assert kept.values() == pytest.approx({name: estimate[name].iloc[0] for name in kept.values()})
    judged = {row["number"]: row for row in roundtrip.judge_numbers([rows, rows * 1.5], mean)}
    gap = judged["car_following__gain_rate_per_s"]["interval"]
    assert (gap["n"], gap["coverage"]) == (2, 0.5)  # the second set is off by half


def test_sets_of_a_part_share_no_recording() -> None:
    pool = roundtrip.simulated(1, Progress())
    assert roundtrip.data_set(pool, 10.0, 0).at_risk.size == pool.at_risk.size
    small = roundtrip.data_set(pool, 5.0, 3)
    assert np.unique(small.recording).size == 10


@pytest.mark.parametrize(("n_covered", "refused"), [(200, False), (180, False), (160, True)])
def test_coverage_is_too_low_where_chance_does_not_explain_it(n_covered: int, refused: bool) -> None:
    found = roundtrip.coverage(np.arange(200) < n_covered)
    assert found["coverage"] == n_covered / 200
    assert (found["p_value"] < 0.001) == refused
