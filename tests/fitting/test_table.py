"""Files and mappings: what is read, and what is refused, by name."""

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.errors import EXIT_BAD_INPUT, HarnessError, TrajectoryError
from harness.fitting.observations import Tally, observations, require_enough
from harness.fitting.table import load_mapping, recordings
from tests.fitting.trajectories import overtaking

FEET = 1 / 0.3048
ROWS = overtaking(2.5)


def tallied(file: Path, mapping: str | None = None) -> Tally:
    found = observations([file], load_mapping(mapping))
    return functools.reduce(Tally.plus, (each.tally for each, _ in found), Tally())


def judged(file: Path, mapping: str | None = None) -> Tally:
    """What `harness fit` does with a file before it fits."""
    total = tallied(file, mapping)
    require_enough(total, file.name, load_mapping(mapping))
    return total


def changed(**columns: object) -> Callable[[], pd.DataFrame]:
    return lambda: ROWS.assign(**columns)


def with_value(row: int, column: str, value: object) -> Callable[[], pd.DataFrame]:
    def rows() -> pd.DataFrame:
        out = ROWS.astype({"lane": float})
        out.loc[row, column] = value
        return out

    return rows


def fast_lanes() -> pd.DataFrame:
    """The same traffic seen in a mirror."""
    return ROWS.assign(lane=1 - ROWS.lane)


def own_clocks() -> pd.DataFrame:
    """One road, and the time of each vehicle from its own beginning."""
    few = ROWS[ROWS.recording_id < 20]
    return few.assign(recording_id=0, vehicle_id=few.vehicle_id + 5 * few.recording_id)


def long_followers() -> pd.DataFrame:
    """Positions are those of front bumpers, and BV is a truck close behind LV."""
    rows = ROWS.copy()
    lv, bv = rows.vehicle_id == 0, rows.vehicle_id == 1
    rows.loc[bv, "length_m"] = 18.0
    rows.loc[lv, "s_m"] = rows[bv].s_m.to_numpy() + 1.5 + rows[lv].length_m.to_numpy()
    rows.loc[lv, "speed_mps"] = rows[bv].speed_mps.to_numpy()
    return rows


def shifted() -> pd.DataFrame:
    """Speeds a second late."""
    late = ROWS.groupby(["recording_id", "vehicle_id"]).speed_mps.shift(10)
    return ROWS.assign(speed_mps=late).dropna()


def late_lanes() -> pd.DataFrame:
    """Lanes a second late."""
    late = ROWS.groupby(["recording_id", "vehicle_id"]).lane.shift(9)
    return ROWS.assign(lane=late).dropna()


def flickering() -> pd.DataFrame:
    """A lane that comes and goes as LV drives."""
    return ROWS.assign(lane=np.where((ROWS.vehicle_id == 0) & (ROWS.time_s % 2 < 0.25), 0, ROWS.lane))


REFUSED = {
    "feet beside m/s": (changed(s_m=ROWS.s_m * FEET), "positions in feet beside speeds in m/s"),
    "ft/s beside m": (changed(speed_mps=ROWS.speed_mps * FEET), "speeds in ft/s beside positions in m"),
    "km/h": (changed(speed_mps=ROWS.speed_mps * 3.6), "speeds in km/h"),
    "mph": (changed(speed_mps=ROWS.speed_mps / 0.44704), "speeds in mph"),
    "feet throughout": (
        lambda: ROWS.assign(**{each: ROWS[each] * FEET for each in ("s_m", "speed_mps", "length_m")}),
        "a median speed of .* and a median length of .*: feet",
    ),
    "lengths in feet": (changed(length_m=ROWS.length_m * FEET), r"median length of 15\.\d m: feet"),
    "milliseconds": (changed(time_s=ROWS.time_s * 1000), "units: {time_s: ms}"),
    "widths": (changed(length_m=1.9), "the width"),
    "backwards": (changed(s_m=-ROWS.s_m), "positions that fall where vehicles drive forward.*must rise"),
    "backwards throughout": (changed(s_m=-ROWS.s_m, speed_mps=-ROWS.speed_mps), "median speed of -"),
    "mirrored": (fast_lanes, "mirror: true"),
    "shifted": (shifted, r"speeds that belong to positions of 1\.0 s earlier"),
    "front bumpers": (long_followers, "origin: front"),
    "own clocks": (own_clocks, "one clock"),
    "one vehicle": (lambda: ROWS[(ROWS.vehicle_id == 1) & (ROWS.recording_id == 0)], "found only one vehicle;"),
    "one vehicle each": (lambda: ROWS[ROWS.vehicle_id == 1], "only one vehicle in each recording"),
    "two recordings of one name": (
        lambda: pd.concat([ROWS, ROWS.assign(vehicle_id=ROWS.vehicle_id + 5, s_m=ROWS.s_m + 2)]).sort_values(
            "recording_id"
        ),
        "do several recordings share a name",
    ),
    "ft/s as km/h": (changed(speed_mps=ROWS.speed_mps * FEET / 3.6), r"speeds in ft/s read as km/h.*speed_mps: km/h"),
    "one lane": (changed(lane=0), "no vehicle with another lane beside it"),
    "half a lane": (with_value(7, "lane", 0.5), r"row 8, lane: found 0\.5"),
    "5 Hz": (lambda: ROWS[(ROWS.time_s * 10).round() % 2 == 0], "a row every 0.2 s"),
    "unequal steps": (with_value(7, "time_s", 0.75), "row 8 .*a time off the steps of 10 Hz"),
    "twice": (lambda: pd.concat([ROWS[:5], ROWS]), "a second row"),
    "interleaved": (
        lambda: pd.concat([ROWS[ROWS.recording_id < 40]] * 2 + [ROWS]).sort_values("time_s"),
        "a second row|its rows together",
    ),
    "flicker": (flickering, "come back within a second"),
    "few": (
        lambda: ROWS[ROWS.recording_id < 12],
        r"\(of 12 in all\), in [\d.]+ vehicle-hours beside.*at least 20.*hours are needed",
    ),
    "congested": (
        lambda: ROWS.assign(s_m=ROWS.s_m - 15 * ROWS.time_s, speed_mps=ROWS.speed_mps - 15),
        "outside the fit range",
    ),
    "nobody closes in": (lambda: ROWS[ROWS.vehicle_id != 2].query("vehicle_id < 2"), "beside it|closes? in"),
    "straight": (
        changed(lateral_m=ROWS.groupby(["recording_id", "vehicle_id"]).lateral_m.transform("first")),
        "without lateral motion",
    ),
    "lanes' middles": (changed(lateral_m=3.5 * ROWS.lane), "in one jump"),
    "late lanes": (late_lanes, r"more than 0\.8 s from the lane's marking"),
    "no length": (with_value(3, "length_m", 0.0), r"row 4 \(vehicle 0 of recording 0, t = 0\.3 s\): found no length"),
    "NaN": (with_value(9, "speed_mps", np.nan), "row 10, speed_mps: found no finite number"),
    "a lone row each": (lambda: ROWS[ROWS.time_s == 0], "one row per vehicle"),
    "misspelt": (lambda: ROWS.rename(columns={"speed_mps": "sped_mps"}), "Did you mean 'sped_mps'"),
    "without lengths": (lambda: ROWS.drop(columns="length_m"), "Gaps need lengths"),
    "of highD": (lambda: ROWS.rename(columns={"speed_mps": "xVelocity"}), "--mapping highd"),
    "of NGSIM": (lambda: ROWS.rename(columns={"s_m": "Local_Y"}), "--mapping ngsim"),
    "text": (changed(lane="left"), "numbers"),
    "nobody's row": (with_value(7, "vehicle_id", None), "row 8, vehicle_id: found nothing"),
    "the end of time": (with_value(7, "time_s", 1e12), r"row 8 .*found time_s 1e\+12"),
    "far away": (with_value(7, "s_m", 1e12), r"row 8 .*found s_m 1e\+12"),
    "lanes": (with_value(7, "lane", 1e12), r"row 8 .*found lane 1e\+12"),
    "no rows": (lambda: ROWS[:0], "no rows"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_trajectories_are_refused_by_name(case, tmp_path):
    rows, words = REFUSED[case]
    file = tmp_path / "rows.parquet"
    rows().to_parquet(file, index=False)
    with pytest.raises(TrajectoryError, match=words) as refused:
        judged(file)
    error = refused.value
    assert all((error.found, error.expected, error.mend))
    assert error.exit_code == EXIT_BAD_INPUT
    assert "rows.parquet" in error.where


FILES = {
    "empty.csv": (b"", "an empty file"),
    "header.csv": (b"vehicle_id,time_s,s_m,speed_mps,lane,length_m\n", "no rows"),
    "ragged.csv": (b"vehicle_id,time_s,s_m,speed_mps,lane,length_m\n1,0,0,30,0,5\n1,0.1,3\n", "cannot be read"),
    "words.csv": (
        b"vehicle_id,time_s,s_m,speed_mps,lane,length_m\n1,0,0,fast,0,5\n",
        "row 2, column speed_mps: found 'fast'; expected a number",
    ),
    "names.csv": (b"vehicle_id,time_s,s_m,speed_mps,lane,length_m\n1,0,0,30,R,5\n", r"found 'R'.*lanes: \[R, L\]"),
    "comma.csv": (b"vehicle_id,time_s,s_m,speed_mps,lane,length_m\n1,0,0,30,5,0,5\n", "a row of 7 .*decimal commas"),
    "both.csv": (
        b"vehicle_id;time_s;s_m;speed_mps;lane;length_m\n1;0,1;996.58;30,5;0;5\n",
        r"row 2, column s_m: found '996\.58', beside decimal commas.*with a decimal point",
    ),
    "twice.csv": (b"vehicle_id,time_s,s_m,speed_mps,lane,length_m,Lane\n1,0,0,30,0,5,1\n", "more than one column lane"),
    "cut.parquet": (b"PAR1 and no more", "cannot be read"),
    "binary.csv": (b"\xff\xfe\x00\x01\x80\n\x80\n", "cannot be read|columns"),
}


@pytest.mark.parametrize("name", FILES)
def test_files_that_cannot_be_read(name, tmp_path):
    content, words = FILES[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(TrajectoryError, match=words):
        judged(tmp_path / name)


def test_missing_and_truncated_files(tmp_path):
    whole = tmp_path / "rows.parquet"
    ROWS.to_parquet(whole, index=False)
    with pytest.raises(TrajectoryError, match=r"no such file.*'rows\.parquet'"):
        judged(tmp_path / "row.parquet")
    with pytest.raises(TrajectoryError, match="a folder"):
        judged(tmp_path)
    whole.write_bytes(whole.read_bytes()[:-1000])
    with pytest.raises(TrajectoryError, match="cannot be read"):
        judged(whole)


def test_csv_and_parquet_say_the_same_however_they_are_cut(tmp_path):
    """Also with semicolons and decimal commas, in two files, and with constant lengths from the mapping."""
    rows = ROWS.assign(length_m=4.6, vehicle_id="car " + ROWS.vehicle_id.astype(str))
    rows.to_parquet(tmp_path / "all.parquet", index=False, row_group_size=5000)
    rows.to_csv(tmp_path / "all.csv", index=False)
    rows.sample(frac=1, random_state=1).sort_values("recording_id", kind="stable").drop(columns="length_m").to_csv(
        tmp_path / "german.csv", index=False, sep=";", decimal=","
    )
    (tmp_path / "own.yaml").write_text("columns: {length_m: 4.6}\n")
    whole = judged(tmp_path / "all.parquet")
    assert judged(tmp_path / "all.csv") == whole
    assert judged(tmp_path / "german.csv", str(tmp_path / "own.yaml")) == whole
    parts = [tmp_path / "first.csv", tmp_path / "second.csv"]
    first = rows.recording_id < 13
    rows[first].to_csv(parts[0], index=False)
    rows[~first].to_csv(parts[1], index=False)
    found = list(observations(parts, load_mapping()))
    assert sum(each.tally.changes for each, _ in found) == whole.changes
    shares = [share for _, share in found]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_ngsim(tmp_path):
    """Feet, milliseconds, front bumpers, lanes from the left, and ramps."""
    lane = np.where(ROWS.recording_id == 3, 7, 6 - ROWS.lane)
    pd.DataFrame(
        {
            "Vehicle_ID": ROWS.vehicle_id + 10 * ROWS.recording_id,
            "Global_Time": (1118846980000 + ROWS.time_s * 1000 + ROWS.recording_id * 100000).round().astype(int),
            "Local_X": ROWS.lateral_m * FEET,
            "Local_Y": (ROWS.s_m + ROWS.length_m / 2) * FEET,
            "v_length": ROWS.length_m * FEET,
            "v_Vel": ROWS.speed_mps * FEET,
            "Lane_ID": lane,
        }
    ).to_csv(tmp_path / "i80.csv", index=False)
    (recording,) = recordings([tmp_path / "i80.csv"], load_mapping("ngsim"))
    expected = ROWS[ROWS.recording_id != 3]
    assert recording.rate_hz == pytest.approx(10.0)
    for column in ("s_m", "speed_mps", "length_m", "lateral_m"):
        assert recording.rows[column].to_numpy() == pytest.approx(expected[column].to_numpy())
    assert (recording.rows.lane == expected.lane.to_numpy()).all()


def highd(folder: Path) -> Path:
    """Both carriageways at 25 Hz as highD's files: the upper one to the left; vehicles that close in on the left."""
    time = np.arange(0, 60, 0.04)
    tracks, meta = [], []
    for direction in (1, 2):
        for vehicle, (lane, begin, speed) in enumerate([(0, 60, 28.5), (0, 0, 28.0), (1, -40, 33.0)]):
            number = 10 * direction + vehicle
            forward = begin + speed * time
            left = -forward if direction == 1 else forward
            lanes = 2 + lane if direction == 1 else 6 - lane
            one = {
                "frame": np.arange(1, time.size + 1),
                "id": number,
                "x": left - 2.25,
                "y": 3.6 * lanes,
                "width": 4.5,
                "height": 1.9,
                "xVelocity": -speed if direction == 1 else speed,
                "laneId": lanes,
            }
            tracks.append(pd.DataFrame(one))
            meta.append({"id": number, "class": "Car", "drivingDirection": direction})
    pd.concat(tracks).to_csv(folder / "01_tracks.csv", index=False)
    pd.DataFrame(meta).to_csv(folder / "01_tracksMeta.csv", index=False)
    pd.DataFrame([{"id": 1, "frameRate": 25}]).to_csv(folder / "01_recordingMeta.csv", index=False)
    return folder / "01_tracks.csv"


def test_highd(tmp_path):
    tracks = highd(tmp_path)
    found = list(observations(sorted(tmp_path.glob("*.csv")), load_mapping("highd")))
    ((each, _),) = found
    # Both carriageways say the same: the vehicle behind another in the right lane, and who comes on the left.
    for number in (1, 4):
        following = each.following[each.following["vehicle"] == number]
        assert following.size > 50
        assert following["r1_m"][0] == pytest.approx(60 + 0.5 * 0.96 - 4.5)
        assert following["r1dot_mps"] == pytest.approx(0.5)
        risky = each.at_risk[each.at_risk["vehicle"] == number]
        assert risky["r2_m"][0] == pytest.approx(40 - 5 * 0.96 - 4.5)
        assert risky["r2dot_mps"][0] == pytest.approx(-5.0)
    assert set(each.following["vehicle"]) == {1, 4}
    wrong = {
        "01_tracksMeta.csv": ("id,class,drivingDirection\n10,Car,3\n", "no drivingDirection 1 or 2"),
        "01_recordingMeta.csv": ("id,frameRate\n1,fast\n", "no frameRate"),
    }
    for name, (content, words) in wrong.items():
        right = (tmp_path / name).read_text()
        (tmp_path / name).write_text(content)
        with pytest.raises(TrajectoryError, match=words):
            judged(tracks, "highd")
        (tmp_path / name).unlink()
        with pytest.raises(TrajectoryError, match="beside the tracks"):
            judged(tracks, "highd")
        (tmp_path / name).write_text(right)


def test_a_mapping_is_checked(tmp_path):
    (tmp_path / "own.yaml").write_text("columns: {speed: v}\nunits: {s_m: yards, lane: 2.0}\n")
    with pytest.raises(HarnessError, match="3 problems") as refused:
        load_mapping(str(tmp_path / "own.yaml"))
    assert all(word in str(refused.value) for word in ("speed_mps", "yards", "lateral_m"))
    with pytest.raises(HarnessError, match="Did you mean 'highd'"):
        load_mapping("higd")
    (tmp_path / "classes.yaml").write_text("classes: [car]\n")
    (tmp_path / "lateral.yaml").write_text("columns: {lateral_m: laterl_m}\n")
    ROWS.to_csv(tmp_path / "rows.csv", index=False)
    for name, words in (("classes", "no column class"), ("lateral", "Did you mean 'lateral_m'")):
        with pytest.raises(TrajectoryError, match=words):
            judged(tmp_path / "rows.csv", str(tmp_path / f"{name}.yaml"))
    assert load_mapping("highd").mirror
    assert not load_mapping("highd", mirror=False).mirror


MAPPED = {
    "classes": ("classes: [car]", "found no row of class car; classes are PKW, van"),
    "mirror": ("mirror: true", "Leave --mirror out"),
    "from_left": ("lanes: from_left", "or lanes: from_right"),
    "list": ("lanes: [1, 0]", "Turn `lanes` of the mapping round"),
    "column": ("columns: {speed_mps: speed_ft, s_m: s_m}", r"speed_ft for speed_mps\. .*these: speed_mps"),
}


@pytest.mark.parametrize("case", MAPPED)
def test_a_mapping_that_does_not_suit_the_file(case, tmp_path):
    content, words = MAPPED[case]
    (tmp_path / "own.yaml").write_text(content)
    ROWS.assign(**{"class": np.where(ROWS.vehicle_id > 0, "PKW", "van")}).to_parquet(tmp_path / "rows.parquet")
    with pytest.raises(TrajectoryError, match=words):
        judged(tmp_path / "rows.parquet", str(tmp_path / "own.yaml"))


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_lanes_with_names(suffix, tmp_path):
    file = tmp_path / f"rows.{suffix}"
    rows = ROWS.assign(lane=np.where(ROWS.vehicle_id == 4, "ramp", np.where(ROWS.lane == 0, "R", "L")))
    rows.to_csv(file, index=False) if suffix == "csv" else rows.to_parquet(file)
    (tmp_path / "own.yaml").write_text("lanes: [R, L]\n")
    ROWS[ROWS.vehicle_id != 4].to_parquet(tmp_path / "numbers.parquet")
    assert judged(file, str(tmp_path / "own.yaml")) == judged(tmp_path / "numbers.parquet")


def test_classes_and_mirror(tmp_path):
    """Only named classes are fitted, others are neighbours still; a mirror's picture in a mirror is the road."""
    rows = ROWS.assign(**{"class": np.where(ROWS.recording_id % 2 == 0, "car", "truck")})
    rows.to_csv(tmp_path / "rows.csv", index=False)
    (tmp_path / "cars.yaml").write_text("classes: [car]\n")
    cars, whole = tallied(tmp_path / "rows.csv", str(tmp_path / "cars.yaml")), judged(tmp_path / "rows.csv")
    assert 0.4 * whole.driven_s < cars.driven_s < 0.6 * whole.driven_s
    fast_lanes().to_csv(tmp_path / "mirrored.csv", index=False)
    (tmp_path / "mirror.yaml").write_text("mirror: true\n")
    mirrored = judged(tmp_path / "mirrored.csv", str(tmp_path / "mirror.yaml"))
    assert mirrored == whole
