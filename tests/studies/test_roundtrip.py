"""Data sets are fitted and judged, and what is fitted is what the environment of the fit says."""

from pathlib import Path

import pytest

from harness.fitting.fit import HEAVIEST_TAILS, fit_traffic
from harness.fitting.laws import Traffic
from harness.fitting.observations import observations
from harness.fitting.table import load_mapping
from harness.progress import Progress
from harness.traffic.loading import load_environment, load_parameters
from studies.roundtrip import FITTED, TRAFFIC
from studies.trajectories import simulate, write


def test_speed_differences_as_wide_as_on_motorways_are_fitted_with_lighter_tails(tmp_path: Path) -> None:
    """With the base's tails LV would exceed 100 m/s: lighter ones are assumed, and written to the environment."""
    environment = load_environment(TRAFFIC)
    numbers = environment.numbers.copy()
    numbers["initial_state__r1dot_log_scale"] = 1.2
    write(simulate(environment._replace(numbers=numbers), 5.0, 1), tmp_path / "wide.parquet")
    traffic = Traffic.of(each for each, _ in observations([tmp_path / "wide.parquet"], load_mapping()))
    fit = fit_traffic(traffic, load_parameters(FITTED), FITTED.parameters, "wide", Progress())
    df = fit.environment.values()["initial_state__r1dot_df"]
    assert df in HEAVIEST_TAILS[2:]
    assert df == pytest.approx(fit.laws["rate"].estimate["initial_state__r1dot_df"])
