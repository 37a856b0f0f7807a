"""Data sets are fitted and judged, and what is fitted is what the environment of the fit says."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import gamma

from harness.families.cut_in.fitting.fit import HEAVIEST_TAILS, fit_traffic
from harness.families.cut_in.fitting.hazard import Acceptance
from harness.families.cut_in.fitting.laws import ObservedTraffic
from harness.families.cut_in.fitting.observations import observe
from harness.families.cut_in.loading import evaluate_laws, load_environment, load_parameters
from harness.fitting.table import load_mapping, recordings
from harness.progress import Progress
from harness.vocabulary import FloatArray
from studies import roundtrip
from studies.trajectories import simulate, write

pytestmark = pytest.mark.slow


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
    fit = fit_traffic(traffic, load_parameters(roundtrip.FITTED), roundtrip.FITTED.parameters, "wide", Progress())
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

    class Counted(Acceptance):
        def exposures(self, theta: FloatArray) -> FloatArray:
            return np.broadcast_to(self.exposure[:-1], (len(theta), 5))

    nothing = np.empty((0, 0)), np.empty(0, np.int64), np.empty(0)
    counts = Counted(np.array([9, 1, 0, 13, 84, 900]), np.array([45.0, 45.0, 44.0, 78.0, 99.0, 900.0]), *nothing)
    assert counts.shares == pytest.approx([9 / 45, 1 / 45, 0.5 / 44, 13 / 78, 84 / 99, 1.0])
    drawn = counts.drawn(np.empty((20_000, 1)), np.random.default_rng(1))
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
