"""A made-up motorway: what was driven is found again on a bent road, and put beside the traffic that it was made by."""

import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.campaign.sections import EnvironmentSettings
from harness.families.cut_in.loading import load_environment
from harness.families.cut_in.parameters import SHIPPED_FOLDER
from studies.__main__ import main
from studies.motorway import trajectories_of
from studies.trajectories import Differences, simulate

pytestmark = pytest.mark.slow

MADE_OF = "ndd-overtaking-1-lateral"
BEND_M = 3000.0


@pytest.fixture(scope="module")
def driven() -> pd.DataFrame:
    """Two recordings whose lanes are mirrored, as vehicles overtake on the left."""
    environment = load_environment(EnvironmentSettings(parameters=MADE_OF, lane_change_level=1000.0))
    table = simulate(environment, 1.0, 3, Differences())
    table["lane"], table["lateral_m"] = 1 - table.lane, 6.8 - table.lateral_m
    table["vehicle_id"] += 10_000 * table.recording_id
    return table


@pytest.fixture(scope="module")
def on_earth(driven: pd.DataFrame) -> pd.DataFrame:
    """The first recording on a road that bends to the left from east to north, the second on the way back beside it."""
    back = driven.recording_id == 1
    angle = driven.s_m.where(~back, 1300.0 - driven.s_m) / BEND_M
    radius = BEND_M - driven.lateral_m.where(~back, -20.0 - driven.lateral_m)
    return pd.DataFrame(
        {
            "vehicle_id": driven.vehicle_id,
            "time_s": driven.time_s,
            "east_m": radius * np.sin(angle),
            "north_m": -radius * np.cos(angle),
            "speed_mps": driven.speed_mps,
            "length_m": driven.length_m,
        }
    )


def test_lanes_and_ways_are_found_on_a_bent_road(driven: pd.DataFrame, on_earth: pd.DataFrame) -> None:
    found = trajectories_of(on_earth)
    assert found.groupby("recording_id").size().to_dict() == pytest.approx({"north": 17_500, "south": 17_500}, rel=0.3)
    both = found.merge(driven, on=["vehicle_id", "time_s"])
    assert len(both) == len(found)
    assert (both.lane_x == both.lane_y).mean() > 0.998
    assert (both.lateral_m_x - both.lateral_m_y).groupby(both.recording_id_x).std().max() < 0.1
    way = both.groupby("vehicle_id").s_m_x.diff() / both.groupby("vehicle_id").s_m_y.diff()
    assert way.median() == pytest.approx(1.0, abs=0.01)  # in the bend the road beside is 0.8 % longer


def installed(folder: Path, rows: pd.DataFrame) -> None:
    """A package tasi that holds some rows."""
    data = folder / "tasi" / "dataset" / "data"
    data.mkdir(parents=True)
    (folder / "tasi" / "__init__.py").write_text("raise ImportError('it need not be imported')")
    names = {
        "vehicle_id": "id",
        "east_m": "center_easting",
        "north_m": "center_northing",
        "speed_mps": "velocity_magnitude",
        "length_m": "dimension_length",
    }
    time = pd.Timestamp("2024-10-07 06:00:00+00:00") + pd.to_timedelta(rows.time_s, "s")
    table = rows.rename(columns=names).drop(columns="time_s").assign(timestamp=time)
    with zipfile.ZipFile(data / "DLR-Highway-Traffic-dataset_v0.zip", "w") as archive:
        archive.writestr("DLR/raw_data/trajectories/all.csv", table.to_csv(index=False))


def test_traffic_agrees_with_the_environment_it_was_made_by_rather_than_with_another(
    on_earth: pd.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path, on_earth)
    monkeypatch.syspath_prepend(tmp_path)
    text = (SHIPPED_FOLDER / f"{MADE_OF}.yaml").read_text(encoding="utf-8")
    other = tmp_path / "other.yaml"
    assert "speed_median_mps: {value: 0.69" in text
    text = text.replace("speed_median_mps: {value: 0.69", "speed_median_mps: {value: 1.4")
    other.write_text(f"{text}\ncar_following: {{log_scale_rate: {{value: 0.8, source: openacc}}}}\n", encoding="utf-8")
    out = tmp_path / "out"
    assert main(["motorway", "--out", str(out), "-e", MADE_OF, "-e", str(other)]) == 0
    left = (out / "motorway.md").read_text(encoding="utf-8").split("## ")[1]
    rows = [line.split("|") for line in left.splitlines() if line.startswith("| ")][2:]
    agrees = {row[1].strip(): ["agrees" in each for each in row[3:5]] for row in rows}
    own, others = np.array(list(agrees.values())).T
    assert len(own) == 21
    assert own.sum() >= 15  # nine in ten, but for noise of measurement and what goes on after the first state
    assert others.sum() <= own.sum() - 3
    assert not agrees["car following: mean square (m²/s⁴)"][1]
    assert not agrees["lead, median (s)"][1]
    assert len(pd.read_parquet(out / "trajectories.parquet")) > 0.7 * len(on_earth)
