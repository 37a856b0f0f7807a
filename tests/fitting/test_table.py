"""Files and mappings: what is read, and what is refused, by name."""

import functools
import gzip
import os
import random
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.errors import EXIT_BAD_INPUT, HarnessError, TrajectoryError
from harness.families.cut_in.fitting.observations import BesideCounts, observe, require_enough
from harness.fitting.distinct import fingerprint, require_distinct
from harness.fitting.table import load_mapping, recordings
from tests.fitting.trajectories import overtaking, recording

FEET = 1 / 0.3048
ROWS = overtaking(2.5)
as_csv = functools.cache(lambda: ROWS.to_csv(index=False).encode())


def judged(file: Path, mapping: str | None = None, *others: Path, leave_out: tuple[str, ...] = ()) -> BesideCounts:
    """What `harness fit` does with files before it fits."""
    read = load_mapping(mapping, leave_out=leave_out)
    read_in = list(recordings([file, *others], read))
    require_distinct(list(map(fingerprint, read_in)))
    return require_enough(list(map(observe, read_in)), file.name, read)


def changed(**columns: object) -> Callable[[], pd.DataFrame]:
    return lambda: ROWS.assign(**columns)


def with_value(row: int, column: str, value: object) -> Callable[[], pd.DataFrame]:
    def rows() -> pd.DataFrame:
        out = ROWS.astype({"lane": float})
        out.loc[row, column] = value
        return out

    return rows


def first(column: str) -> pd.Series:
    """The first value of each vehicle, in all of its rows."""
    return ROWS.groupby(["recording_id", "vehicle_id"])[column].transform("first")


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


def congested() -> pd.DataFrame:
    return ROWS.assign(speed_mps=ROWS.speed_mps - 15, s_m=ROWS.s_m - 15 * ROWS.time_s)


def flickering() -> pd.DataFrame:
    """A lane that comes and goes as LV drives."""
    return ROWS.assign(lane=np.where((ROWS.vehicle_id == 0) & (ROWS.time_s % 2 < 0.25), 0, ROWS.lane))


REFUSED = {
    "feet beside m/s": (changed(s_m=ROWS.s_m * FEET), "speeds 0.305 times the change"),
    "feet throughout": (
        lambda: ROWS.assign(**{each: ROWS[each] * FEET for each in ("s_m", "speed_mps", "length_m")}),
        "found a median of .* in speed_mps.*feet|a median of .* in speed_mps.*ft",
    ),
    "milliseconds": (changed(time_s=ROWS.time_s * 1000), "units: {time_s: ms}"),
    "widths": (changed(length_m=1.9), "the width"),
    "backwards": (changed(s_m=-ROWS.s_m), "speeds -1 times the change.*must rise"),
    "mirrored": (fast_lanes, "--mirror"),
    "front bumpers": (long_followers, "origin: front"),
    "own clocks": (own_clocks, "one clock"),
    "one vehicle each": (lambda: ROWS[ROWS.vehicle_id == 1], "vehicles that close in from behind"),
    "two recordings of one name": (
        lambda: pd.concat([ROWS, ROWS.assign(vehicle_id=ROWS.vehicle_id + 5, s_m=ROWS.s_m + 2)]).sort_values(
            "recording_id"
        ),
        "Do several recordings share a name",
    ),
    "one lane": (changed(lane=0), "no vehicle with another lane beside it"),
    "half a lane": (with_value(7, "lane", 0.5), r"row 8, lane: found 0\.5"),
    "5 Hz": (lambda: ROWS[(ROWS.time_s * 10).round() % 2 == 0], "a row every 0.2 s"),
    "unequal steps": (with_value(7, "time_s", 0.75), "row 8 .*a time off the steps of 10 Hz"),
    "twice": (lambda: pd.concat([ROWS[:5], ROWS]), "a second row"),
    "flicker": (flickering, "come back within a second"),
    "few": (
        lambda: ROWS[ROWS.recording_id < 12],
        r"\(of 12 in all; to the left 0\), in [\d.]+ vehicle-hours beside.*at least 20.*hours are needed",
    ),
    "changes to the other side": (
        lambda: ROWS.assign(lane=ROWS.lane.where(ROWS.vehicle_id != 1, 1 - ROWS.lane)),
        r"\(of 0 in all; to the left 30\), .*change to the left: number lanes as they lie",
    ),
    "congested": (congested, "outside the fit range"),
    "nobody closes in": (lambda: ROWS[ROWS.vehicle_id != 2].query("vehicle_id < 2"), "beside it|closes? in"),
    "straight": (changed(lateral_m=first("lateral_m")), "or without lateral motion"),
    "no lateral number": (changed(lateral_m=ROWS.lateral_m * 1e300), r"lanes 3\.6e\+300 m apart"),
    "lanes' middles": (changed(lateral_m=3.5 * ROWS.lane), "in a jump"),
    "no length": (with_value(3, "length_m", 0.0), r"row 4 \(vehicle 0 of recording 0, t = 0\.3 s\): found length_m 0;"),
    "NaN": (with_value(9, "speed_mps", np.nan), "row 10, speed_mps: found no finite number"),
    "a lone row each": (lambda: ROWS[ROWS.time_s == 0], "one row per vehicle"),
    "misspelt": (lambda: ROWS.rename(columns={"speed_mps": "sped_mps"}), "Did you mean 'sped_mps'"),
    "without lengths": (lambda: ROWS.drop(columns="length_m"), "Gaps need lengths"),
    "text": (changed(lane="left"), "invalid value .left|cannot be read"),
    "nobody's row": (with_value(7, "vehicle_id", None), "row 8, vehicle_id: found nothing"),
    "the end of time": (with_value(7, "time_s", 1e12), r"row 8 .*found time_s 1e\+12"),
    "km/h of one vehicle": (
        lambda: ROWS.assign(**{c: ROWS[c] * np.where(ROWS.vehicle_id == 2, 3.6, 1.0) for c in ("s_m", "speed_mps")}),
        r"vehicle 2 of .*found speed_mps 1\d\d\.\d*; expected at most 60 from the median",
    ),
    "the other carriageway": (
        lambda: congested().assign(
            **{c: congested()[c] * np.where(ROWS.vehicle_id == 2, -1, 1) for c in ("s_m", "speed_mps")}
        ),
        r"vehicle 2 of .*found speed_mps -1\d\.\d*; expected one that drives forward",
    ),
    "one recording stands still": (
        changed(s_m=ROWS.s_m.where(ROWS.recording_id != 3, first("s_m"))),
        r"of recording 3, t = 0 s\): found s_m -40, and -40 in row 4981, where speeds say -36.* such pairs of rows",
    ),
    "a vehicle twice": (
        lambda: pd.concat([ROWS, ROWS[(ROWS.vehicle_id == 1) & (ROWS.recording_id == 3)].assign(vehicle_id=9)]),
        "vehicle 9 of recording 3, t = 0 s.: found the time, lane and s_m of another vehicle",
    ),
}


HEAD = b"vehicle_id,time_s,s_m,speed_mps,lane,length_m\n"
FILES = {
    "empty.csv": (b"", "an empty file"),
    "ragged.csv": (HEAD + b"1,0,0,30,0,5\n1,0.1,3\n", "as many values as"),
    "comma.csv": (HEAD + b"1,0,0,30,5,0,5\n", "got 7.*Decimal commas"),
    "both.csv": (b"vehicle_id;time_s;s_m;speed_mps;lane;length_m\n1;0,1;996.58;30,5;0;5\n", "996.58.; .* decimal sign"),
    "twice.csv": (HEAD[:-1] + b",Lane\n1,0,0,30,0,5,1\n", "more than one column lane"),
    "latin.csv": (HEAD + b"\xfcber,0,0,30,0,5\n", "text in UTF-8"),
    "cut.csv.gz": (gzip.compress(HEAD + random.Random(1).randbytes(9000))[:-2000], "cannot be read"),
    "utf16.csv": ("vehicle_id,time_s\n1,0.1\n".encode("utf-16"), "zero bytes"),
    "gzip.csv": (gzip.compress(b"vehicle_id,time_s\n1,0.1\n"), "zero bytes"),
    "zeros.csv": (HEAD + b"1,0,0,30,0,5\n" + bytes(9), "zero bytes"),
    "returns.csv": (HEAD[:-1] + b"\r1,0,0,30,0,5\r", "cannot be read .*new-line"),
    "text.csv": (HEAD + b"1,0,0,n.a.,0,5\n", "column 4: found 'n.a.'; expected numbers, of"),
    "headless.csv": (b"1,0,0,30,0,5\n1,0.1,3,30,0,5\n", r"numbers in place of a header: 6 columns.*header: \["),
}


@pytest.mark.parametrize("case", [*REFUSED, *FILES])
def test_wrong_trajectories_are_refused_by_name(case, tmp_path):
    content, words = REFUSED.get(case) or FILES[case]
    file = tmp_path / (case if case in FILES else "rows.parquet")
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        content().to_parquet(file, index=False)
    with pytest.raises(TrajectoryError, match=words) as refused:
        judged(file)
    error = refused.value
    assert all((error.found, error.expected, error.mend))
    assert error.exit_code == EXIT_BAD_INPUT
    assert file.name in error.where


def test_what_is_no_file_is_refused_at_once(tmp_path):
    (tmp_path / "rows.parquet").touch()
    os.mkfifo(tmp_path / "rows.csv")
    for file, words in (("row.parquet", r"no such file.*'rows\.parquet'"), ("", "a folder"), ("rows.csv", "a pipe")):
        with pytest.raises(TrajectoryError, match=words):
            judged(tmp_path / file)


@pytest.mark.parametrize(("cut", "n"), [(0, 0), (3, 1)])
def test_a_row_that_may_be_cut_is_told(cut, n, tmp_path, capsys):
    """One that has lost a value is refused; of a shorter last value nothing else tells."""
    content = as_csv()
    (tmp_path / "rows.csv").write_bytes(content[: len(content) - cut])
    judged(tmp_path / "rows.csv")
    assert capsys.readouterr().err.count("rows.csv has no line end after its last row: is it complete?") == n


@pytest.mark.slow
def test_csv_and_parquet_say_the_same_however_they_are_cut(tmp_path):
    """Also with semicolons and decimal commas, compressed, in two files, and with lengths of the mapping."""
    rows = ROWS.assign(length_m=4.6, vehicle_id="car " + ROWS.vehicle_id.astype(str))
    rows.to_parquet(tmp_path / "all.parquet", index=False, row_group_size=5000)
    rows.to_csv(tmp_path / "all.csv", index=False)
    rows.sample(frac=1, random_state=1).sort_values("recording_id", kind="stable").drop(columns="length_m").to_csv(
        tmp_path / "german.csv", index=False, sep=";", decimal=","
    )
    (tmp_path / "own.yaml").write_text("columns: {length_m: 4.6}\n")
    whole = judged(tmp_path / "all.parquet")
    text = (tmp_path / "all.csv").read_text()
    (tmp_path / "all.csv.gz").write_bytes(gzip.compress(text.encode()))
    (tmp_path / "below.csv").write_text(f"\n\r\n{text}")
    for name in ("all.csv", "all.csv.gz", "below.csv"):
        assert judged(tmp_path / name) == whole
    assert judged(tmp_path / "german.csv", str(tmp_path / "own.yaml")) == whole
    parts = [tmp_path / "first.csv", tmp_path / "second.csv"]
    first = rows.recording_id < 13
    rows[first].to_csv(parts[0], index=False)
    rows[~first].to_csv(parts[1], index=False)
    found = list(recordings(parts, load_mapping()))
    assert sum(observe(each).tally.changes for each in found) == whole.changes
    shares = [each.share_read for each in found]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


@pytest.mark.slow
def test_ngsim(tmp_path):
    """Feet, milliseconds, front bumpers, lanes from the left, and ramps; also the original text without a header."""
    lane = np.where(ROWS.recording_id == 3, 7, 6 - ROWS.lane)
    rows = pd.DataFrame(
        {
            "Vehicle_ID": ROWS.vehicle_id + 10 * ROWS.recording_id,
            "Global_Time": (1118846980000 + ROWS.time_s * 1000 + ROWS.recording_id * 100000).round().astype(int),
            "Local_X": ROWS.lateral_m * FEET,
            "Local_Y": (ROWS.s_m + ROWS.length_m / 2) * FEET,
            "v_length": ROWS.length_m * FEET,
            "v_Vel": ROWS.speed_mps * FEET,
            "Lane_ID": lane,
        }
    )
    rows.to_csv(tmp_path / "i80.csv", index=False)
    names = [{"v_Length": "v_length"}.get(name, name) for name in load_mapping("ngsim").header]
    original = rows.reindex(columns=names, fill_value=0).to_string(header=False, index=False)
    (tmp_path / "i80.txt").write_text("".join(f"   {line} \r\n" for line in original.splitlines()))
    expected = ROWS[ROWS.recording_id != 3]
    for name, exactly in (("i80.csv", 1e-9), ("i80.txt", 1e-5)):
        (recording,) = recordings([tmp_path / name], load_mapping("ngsim"))
        assert recording.rate_hz == pytest.approx(10.0)
        for attribute, column in {"s": "s_m", "v": "speed_mps", "length": "length_m", "lateral": "lateral_m"}.items():
            assert getattr(recording, attribute) == pytest.approx(expected[column].to_numpy(), rel=1e-6, abs=exactly)
        assert (recording.lane == expected.lane.to_numpy()).all()


@pytest.mark.slow
def test_sites_need_not_be_sorted(tmp_path):
    """Also in a file of several of the blocks in which it is read."""
    ROWS.to_parquet(tmp_path / "rows.parquet", index=False)
    ROWS.sample(frac=1, random_state=1).assign(note="x" * 200).to_csv(tmp_path / "sites.csv", index=False)
    assert (tmp_path / "sites.csv").stat().st_size > 1 << 23
    whole, shuffled = (judged(tmp_path / name)._replace(driven_s=0.0) for name in ("rows.parquet", "sites.csv"))
    assert shuffled._replace(followed_s=whole.followed_s) == whole


def test_a_recording_is_named_and_left_out(tmp_path):
    still = congested()
    street = still[still.recording_id < 4].assign(recording_id="street")
    street["vehicle_id"] = street.vehicle_id + 5 * still.recording_id
    street["time_s"] += 100 * still.recording_id
    others = ROWS[ROWS.recording_id > 3].astype({"recording_id": str})[:3000]
    pd.concat([others, street]).to_csv(tmp_path / "all.csv", index=False)
    for left_out, words in {
        (): r"most of it in recording street.*--leave-out 'street'",
        ("street",): "lane changes to the right",
        ("stret",): r"no recording stret; there are .*street",
    }.items():
        with pytest.raises(TrajectoryError, match=words):
            judged(tmp_path / "all.csv", leave_out=left_out)


@pytest.mark.parametrize("column", ["s_m", "speed_mps", "lateral_m", "length_m"])
@pytest.mark.parametrize("row", range(1001, 1004))
def test_one_wrong_value_is_refused_whatever_its_row(column, row, tmp_path):
    file = tmp_path / "rows.parquet"
    with_value(row, column, ROWS[column][row] + 12.0)().to_parquet(file, index=False)
    with pytest.raises(TrajectoryError, match=column) as refused:
        judged(file)
    named = {int(each) for each in re.findall(r"row (\d+)", str(refused.value))}
    assert row + 1 in named


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
    (each,) = map(observe, recordings(sorted(tmp_path.glob("*.csv")), load_mapping("highd")))
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
    (tmp_path / "rows.csv").write_bytes(as_csv())
    for name, words in (("classes", "no column class"), ("lateral", "Did you mean 'lateral_m'")):
        with pytest.raises(TrajectoryError, match=words):
            judged(tmp_path / "rows.csv", str(tmp_path / f"{name}.yaml"))


MAPPED = {
    "classes": ("classes: [car]", "found no class car; there are PKW, van"),
    "from_left": ("lanes: from_left", "Give --mirror"),
    "list": ("lanes: [1, 0]", "from the other side"),
    "column": ("columns: {speed_mps: speed_ft, s_m: s_m}", r"found the columns .*speed_mps.*speed_ft for speed_mps\."),
}


@pytest.mark.parametrize("case", MAPPED)
def test_a_mapping_that_does_not_suit_the_file(case, tmp_path):
    content, words = MAPPED[case]
    (tmp_path / "own.yaml").write_text(content)
    ROWS.assign(**{"class": np.where(ROWS.vehicle_id > 0, "PKW", "van")}).to_parquet(tmp_path / "rows.parquet")
    with pytest.raises(TrajectoryError, match=words):
        judged(tmp_path / "rows.parquet", str(tmp_path / "own.yaml"))


@pytest.mark.slow
def test_classes_and_mirror(tmp_path):
    """Only named classes are fitted, others are neighbours still; a mirror's picture in a mirror is the road."""
    rows = ROWS.assign(**{"class": np.where(ROWS.recording_id % 2 == 0, "car", "truck")})
    rows.to_csv(tmp_path / "rows.csv", index=False)
    (tmp_path / "cars.yaml").write_text("classes: [car]\n")
    found = recordings([tmp_path / "rows.csv"], load_mapping(str(tmp_path / "cars.yaml")))
    driven_s, whole = sum(observe(each).tally.driven_s for each in found), judged(tmp_path / "rows.csv")
    assert 0.4 * whole.driven_s < driven_s < 0.6 * whole.driven_s
    fast_lanes().to_csv(tmp_path / "mirrored.csv", index=False)
    (tmp_path / "mirror.yaml").write_text("mirror: true\n")
    mirrored = judged(tmp_path / "mirrored.csv", str(tmp_path / "mirror.yaml"))
    assert mirrored == whole


def test_directions_whose_lanes_are_numbered_the_other_way_are_counted():
    """All together vehicles close in often enough on the side that is meant."""
    rows = overtaking(0.5).query("recording_id < 2").astype({"vehicle_id": str, "recording_id": str})
    alike = [recording(each) for _, each in rows.groupby("recording_id")]
    turned = rows.assign(lane=np.where(rows.recording_id == "1", 1 - rows.lane, rows.lane))
    assert [observe(each).tally.turned for each in alike] == [0, 0]
    assert [observe(recording(each)).tally.turned for _, each in turned.groupby("recording_id")] == [0, 1]
