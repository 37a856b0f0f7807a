"""Trajectories as a table: read from CSV or Parquet one recording at a time, by a mapping of columns, and checked.

One row per vehicle and time. The rows of a recording stand together in a file, in any order among themselves, so that
no more than one recording is held in memory (some 400 bytes a row); without ``recording_id`` a file is one recording.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from pydantic import Field

from harness.campaign.files import read_model, shipped_or_own
from harness.campaign.problems import did_you_mean
from harness.campaign.sections import Section
from harness.errors import TrajectoryError
from harness.vocabulary import FloatArray, IntArray

Needed = Literal["vehicle_id", "time_s", "s_m", "speed_mps", "lane", "length_m"]
Measured = Literal["time_s", "s_m", "speed_mps", "length_m", "lateral_m"]
Optional = Literal["recording_id", "lateral_m", "class", "direction"]
NEEDED: tuple[Needed, ...] = get_args(Needed)
OPTIONAL: tuple[Optional, ...] = get_args(Optional)
NAMES = ("recording_id", "vehicle_id", "class", "direction")
"""Columns that are read as text."""
Unit = Literal["m", "ft", "km", "m/s", "ft/s", "km/h", "mph", "s", "ms", "us", "ns"]
UNITS: dict[Unit, float] = dict(
    zip(get_args(Unit), (1.0, 0.3048, 1e3, 1.0, 0.3048, 1 / 3.6, 0.44704, 1.0, 1e-3, 1e-6, 1e-9), strict=True)
)
NO_LENGTH = "Gaps need lengths: correct them, or give one for all in a mapping (columns: {length_m: 4.6})."
NO_COLUMN = ("Rename the column, or give its name in a mapping (--mapping FILE.yaml).", NO_LENGTH)
LONGEST_LINE = 1 << 20
SAMPLE = 1 << 16
"""Bytes in which decimal signs are counted."""
SLOWEST_HZ = 9.5
FASTEST_MEDIAN_MPS = 70.0
USUAL_LENGTH_M = (2.5, 10.0)
"""Range of the median length of vehicles, which in feet is about 15."""
OF_STEP = 0.05
"""Largest relative difference between speeds and the change of positions."""
SLIPS = {
    3.2808: "speeds in ft/s beside positions in m",
    0.3048: "positions in feet beside speeds in m/s",
    0.9113: "speeds in ft/s read as km/h",
    3.6: "speeds in km/h beside positions in m",
    2.2369: "speeds in mph beside positions in m",
    0.6818: "positions in feet beside speeds in mph",
    1.0973: "positions in feet beside speeds in km/h",
    1000.0: "positions in km beside speeds in m/s",
    -1.0: "positions that fall where vehicles drive forward",
}
"""Cause of a ratio of speeds to the change of positions."""
MOST_APART = {"time_s": 1e7, "s_m": 1e5, "lane": 1e3}
"""Values further from the median are wrong [assumed]."""
LEAST_LAG_S = 0.3
ANOTHER_VEHICLE_S = 60.0
"""An identifier that reappears after so long is another vehicle's (as in NGSIM)."""


class Mapping(Section):
    """How to read the columns of a file."""

    columns: dict[Literal[Needed, Optional], str | float] = Field(
        default={}, description="name in the file, or one number for all rows, by name of the input table"
    )
    units: dict[Measured, Unit | Annotated[float, Field(gt=0.0)]] = Field(
        default={}, description="unit in the file, or the factor to multiply by"
    )
    lanes: Literal["from_right", "from_left"] | list[int | str] = Field(
        default="from_right",
        description="how lanes are numbered, or a list of lanes from right to left, without others",
    )
    origin: Literal["centre", "front", "rear"] = Field(default="centre", description="point of a vehicle that s_m is")
    mirror: bool = Field(default=False, description="whether vehicles that close in from behind are on the left")
    classes: list[str] = Field(default=[], description="classes whose driving is fitted; all, if none is named")
    layout: Literal["table", "highd"] = Field(default="table", description="whether files are highD's")

    @property
    def lane_names(self) -> list[str]:
        """Lanes from right to left if some have names; else none."""
        names = self.lanes if isinstance(self.lanes, list) else []
        return list(map(str, names)) if any(isinstance(each, str) for each in names) else []


SHIPPED_FOLDER = Path(__file__).parent


def load_mapping(name: str | None = None, *, mirror: bool | None = None) -> Mapping:
    """A shipped mapping (``highd``, ``ngsim``), that of a YAML file, or by default that of the input table itself.

    Raises `CampaignError`: there is no such mapping, or it is wrong.
    """
    mapping = Mapping() if name is None else read_model(shipped_or_own(name, SHIPPED_FOLDER, "--mapping"), Mapping)
    return mapping if mirror is None else mapping.replaced(("mirror",), mirror)


@dataclass(frozen=True)
class Recording:
    """All vehicles on a stretch of road during some time.

    Attributes
    ----------
    name, file : str
        For messages.
    rows : DataFrame
        Sorted by vehicle and time: ``vehicle`` (int, a number in the recording), ``time_s``, ``frame`` (int),
        ``s_m`` (centre, rising as one drives), ``speed_mps``, ``lane`` (int, the target lane's is one less),
        ``length_m``, ``lateral_m`` (NaN where there is none), ``road`` (int, one of its directions), ``fitted`` (bool,
        of a class whose driving is fitted), ``row`` (in the file, from 1).
    rate_hz : float
        Frames per second.
    vehicles : list of str
        Identifiers in the file, by number.
    share_read : float
        Of the bytes or rows of all files, with this recording.
    """

    name: str
    file: str
    rows: pd.DataFrame
    rate_hz: float
    vehicles: Sequence[str]
    share_read: float

    def where(self, i: int | np.intp) -> str:
        """Place in the file of the i-th row."""
        each = self.rows.iloc[int(i)]
        return (
            f"{self.file}, row {each.row} (vehicle {self.vehicles[int(each.vehicle)]} of recording {self.name}, "
            f"t = {each.time_s:.10g} s)"
        )

    def require_near(self, column: str) -> None:
        """Refuse a value so far from the others that it cannot be right."""
        values = self.rows[column].to_numpy()
        off = np.abs(values - np.median(values))
        if off.max() > MOST_APART[column]:
            i, mend = int(np.argmax(off)), "Delete the row, or correct the value."
            expected = f"at most {MOST_APART[column]:g} from the median of the recording"
            raise TrajectoryError(self.where(i), f"{column} {values[i]:g}", expected, mend)


def recordings(files: Sequence[str | Path], mapping: Mapping) -> Iterator[Recording]:
    """Recordings of some files, one after the other, checked.

    Raises `TrajectoryError`: a file cannot be read, or its rows cannot be trajectories in these units.
    """
    paths = [Path(file) for file in files]
    kept = [path for path in paths if mapping.layout != "highd" or not path.stem.endswith("Meta")]
    if not kept:
        where = ", ".join(map(str, files))
        raise TrajectoryError(where, "no file with tracks", "NN_tracks.csv", "Give highD's tracks as well.")
    classes: set[str] = set()
    for i, path in enumerate(kept):
        for name, rows, share in _pieces(path, mapping):
            standard = _standard(rows, path, mapping)
            if mapping.classes:
                classes.update(standard["class"].unique())
            yield _recording(name, path, standard, (i + share) / len(kept))
    if mapping.classes and classes.isdisjoint(mapping.classes):
        found = f"no row of class {' or '.join(mapping.classes)}; classes are {', '.join(sorted(map(str, classes)))}"
        where = ", ".join(map(str, kept))
        raise TrajectoryError(where, found, "one of them", "Correct `classes` of the mapping, or leave it out.")


# -- files --


class _Batch(NamedTuple):
    rows: pd.DataFrame
    share_read: float


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Say what is wrong with a file that cannot be read."""
    try:
        yield
    except FileNotFoundError:
        meant = did_you_mean(path.name, [each.name for each in path.parent.glob("*")])
        mend = meant or "Check the spelling and the current folder."
        raise TrajectoryError(str(path), "no such file", "a CSV or Parquet file", mend) from None
    except IsADirectoryError:
        raise TrajectoryError(str(path), "a folder", "a CSV or Parquet file", "Name the files in it.") from None
    except (pa.ArrowException, OSError, UnicodeError) as error:
        found = f"a file that cannot be read ({str(error).splitlines()[0]})"
        mend = "Is it complete, and of the type that its name says? Copy or write it again."
        raise TrajectoryError(str(path), found, "a CSV or Parquet file", mend) from None


@contextmanager
def _numbers_in(path: Path, names: Sequence[str], delimiter: str) -> Iterator[None]:
    """Say which value of a CSV file is no number, and whether decimal commas are why."""
    try:
        yield
    except pa.ArrowInvalid as error:
        words = str(error)
        if value := re.search(r"column #(\d+): .*invalid value '(.*)'", words):
            column, text = int(value[1]), value[2]
            name = names[column]
            found, mend = f"'{text}'", "Correct it, or give another column in a mapping (--mapping FILE.yaml)."
            if re.fullmatch(r"[-+]?\d+[.,]\d+", text):
                seen = "a decimal comma" if "," in text else "beside decimal commas"
                found, mend = f"'{text}', {seen}", "Write all numbers with a decimal point."
            elif name.lower().startswith("lane"):
                mend = "Lanes with names need a mapping that lists them from right to left (lanes: [R, L])."
            with path.open(encoding="utf-8", errors="replace") as lines:
                cells = (line.rstrip().split(delimiter)[column : column + 1] for line in lines)
                row = next((f", row {i}" for i, each in enumerate(cells, 1) if each == [text]), "")
            raise TrajectoryError(f"{path}{row}, column {name}", found, "a number", mend) from None
        counts = re.search(r"Expected (\d+) columns, got (\d+)", words)
        if counts and delimiter == "," and int(counts[1]) < int(counts[2]):
            found, mend = (
                f"a row of {counts[2]} values",
                "If numbers have decimal commas, separate columns by semicolons.",
            )
            raise TrajectoryError(str(path), found, f"{counts[1]}, as in its header", mend) from None
        raise


def _pieces(path: Path, mapping: Mapping) -> Iterator[tuple[str, pd.DataFrame, float]]:
    """Name and rows of each recording of a file, and the share of the file that is read by then."""
    parts: list[pd.DataFrame] = []
    current: str | None = None
    done: set[str] = set()
    share = 0.0
    with _reading(path):
        for batch in _batches(path, mapping):
            for key, part in batch.rows.groupby("recording_id", sort=False):
                name = str(key)
                if name in done:
                    where, found = f"{path}, row {part.row.iloc[0]}", f"recording {name} again, after another one"
                    mend = "Sort the file by recording_id, or write a file for each."
                    raise TrajectoryError(where, found, "all its rows together", mend)
                if current is not None and name != current:
                    yield current, pd.concat(parts, ignore_index=True), share
                    done.add(current)
                    parts = []
                current = name
                parts.append(part)
            share = batch.share_read
    if current is None:
        raise TrajectoryError(str(path), "no rows", "one row per vehicle and time", "Is it the right file?")
    yield current, pd.concat(parts, ignore_index=True), 1.0


def _batches(path: Path, mapping: Mapping) -> Iterator[_Batch]:
    """Rows of a file with the columns of the input table that it has, and ``row``."""
    first = 2  # the header of a CSV file is its first row
    if path.suffix in (".parquet", ".pq"):
        with pq.ParquetFile(path) as file:
            columns = _columns(path, file.schema_arrow.names, mapping)
            total = max(file.metadata.num_rows, 1)
            first = 1
            for batch in file.iter_batches(columns=list(columns.values())):
                yield _Batch(_renamed(batch, columns, first, path, mapping), (first - 1 + batch.num_rows) / total)
                first += batch.num_rows
        return
    with path.open("rb") as raw:
        head = raw.readline(LONGEST_LINE).decode("utf-8-sig")
        sample = raw.read(SAMPLE).decode(errors="replace")
    head = head.strip()
    if not head:
        raise TrajectoryError(str(path), "an empty file", "a header and rows", "Is it the right file?")
    delimiter = max(",;\t", key=head.count)
    names = [name.strip().strip('"') for name in head.split(delimiter)]
    columns = _columns(path, names, mapping)
    commas, points = (len(re.findall(rf"\d{sign}\d", sample)) for sign in (",", r"\."))
    text = {columns.get(each) for each in (*NAMES, *(["lane"] if mapping.lane_names else []))}
    types = {name: pa.string() if name in text else pa.float64() for name in columns.values()}
    raw = pa.OSFile(str(path))  # after an error pyarrow's threads read on: from a file of Python they abort its exit
    with _numbers_in(path, names, delimiter):
        reader = pa.csv.open_csv(
            raw,
            read_options=pa.csv.ReadOptions(column_names=names, skip_rows=1, block_size=1 << 22),
            parse_options=pa.csv.ParseOptions(delimiter=delimiter),
            convert_options=pa.csv.ConvertOptions(
                column_types=types,
                include_columns=list(columns.values()),
                decimal_point="," if delimiter == ";" and commas > points else ".",
            ),
        )
        for batch in reader:
            yield _Batch(_renamed(batch, columns, first, path, mapping), min(raw.tell() / raw.size(), 1.0))
            first += batch.num_rows


def _columns(path: Path, names: Sequence[str], mapping: Mapping) -> dict[str, str]:
    """Name in the file of each column of the input table that it has; capital letters do not count."""
    lower = [name.lower() for name in names]
    found: dict[str, str] = {}
    for column in (*NEEDED, *OPTIONAL):
        wanted = mapping.columns.get(column, column)
        if isinstance(wanted, float):
            continue
        if lower.count(wanted.lower()) > 1:
            mend = "Rename all but one; capital letters do not count."
            raise TrajectoryError(str(path), f"more than one column {wanted}", "one", mend)
        if wanted.lower() in lower:
            found[column] = names[lower.index(wanted.lower())]
        elif column in NEEDED or (column in mapping.columns and column != "recording_id"):
            known = {} if mapping.columns else {"xvelocity": "highd", "local_y": "ngsim"}
            of = [f"Is it a file for --mapping {known[name]}?" for name in lower if name in known]
            unused = [name for name in names if name.lower() not in _asked(mapping)]
            other = f"Is it one of these: {', '.join(unused[:12])}?" if wanted != column and unused else ""
            mend = of[0] if of else did_you_mean(wanted, names) or other or NO_COLUMN[column == "length_m"]
            what = f"a column {wanted}" + (f" for {column}" if wanted != column else "")
            raise TrajectoryError(str(path), f"the columns {', '.join(names)}", what, mend)
    if mapping.classes and "class" not in found and mapping.layout != "highd":
        mend = "Add it, or leave out `classes` of the mapping."
        raise TrajectoryError(str(path), "no column class", "one, as the mapping names classes", mend)
    return found


def _asked(mapping: Mapping) -> set[str]:
    """Names in a file that a mapping reads, in small letters."""
    return {str(mapping.columns.get(column, column)).lower() for column in (*NEEDED, *OPTIONAL)}


def _renamed(batch: Any, columns: dict[str, str], first: int, path: Path, mapping: Mapping) -> pd.DataFrame:
    """Rows of a batch by the names of the input table, constants filled in."""
    data = {}
    for column, name in columns.items():
        values = batch.column(name)
        if column in NAMES:
            text = values.cast(pa.string()).fill_null("")
            if column in ("recording_id", "vehicle_id") and (i := text.index("").as_py()) >= 0:
                where, mend = f"{path}, row {first + i}, {name}", "Fill it in, or delete the row."
                raise TrajectoryError(where, "nothing", "an identifier in every row", mend)
            data[column] = pd.arrays.ArrowExtensionArray(pa.chunked_array([text]))
            continue
        if column == "lane" and mapping.lane_names:
            order = {lane: i for i, lane in enumerate(mapping.lane_names)}
            data[column] = values.cast(pa.string()).to_pandas().map(order).fillna(-1)  # others are left out
            continue
        try:
            data[column] = values.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
        except pa.ArrowException:
            found = f"values of type {values.type}"
            raise TrajectoryError(f"{path}, column {name}", found, "numbers", "Write the column as numbers.") from None
    rows = pd.DataFrame(data)
    for column, value in mapping.columns.items():
        if isinstance(value, float):
            rows[column] = value
    rows["row"] = np.arange(first, first + len(rows))
    return rows if "recording_id" in rows else rows.assign(recording_id=path.stem)


# -- rows by the mapping --


def _standard(rows: pd.DataFrame, path: Path, mapping: Mapping) -> pd.DataFrame:
    """Rows in metres and seconds, with the centre of vehicles, and lanes of which the target lane's is one less."""
    for column, unit in mapping.units.items():
        if column in rows:
            rows[column] *= UNITS[unit] if isinstance(unit, str) else unit
    if mapping.layout == "highd":
        rows = _from_highd(rows, path)
    if (odd := ~np.isfinite(rows[list(NEEDED[1:])].to_numpy())).any():
        i, column = np.argwhere(odd)[0]
        where = f"{path}, row {rows.row.iloc[i]}, {NEEDED[1:][column]}"
        raise TrajectoryError(where, "no finite number", "a number in every row", "Delete or correct the row.")
    if (odd := rows.lane.to_numpy() % 1 != 0).any():
        i = int(np.argmax(odd))
        where = f"{path}, row {rows.row.iloc[i]}, lane"
        raise TrajectoryError(where, f"{rows.lane.iloc[i]:g}", "a whole number", "Number the lanes by whole numbers.")
    if isinstance(mapping.lanes, list):
        lanes = range(len(mapping.lanes)) if mapping.lane_names else mapping.lanes
        order = {float(lane): i for i, lane in enumerate(lanes)}
        rows = rows[rows.lane.isin(list(order))].copy()
        if rows.empty:
            found = f"no vehicle in the lanes {', '.join(map(str, mapping.lanes))}"
            raise TrajectoryError(str(path), found, "rows in these lanes", "Correct `lanes` of the mapping.")
        rows["lane"] = rows.lane.map(order)
    from_right = mapping.lanes != "from_left"
    rows["lane"] = rows.lane.astype(np.int64) * (1 if from_right != mapping.mirror else -1)
    rows["s_m"] += rows.length_m * {"centre": 0.0, "front": -0.5, "rear": 0.5}[mapping.origin]
    rows["fitted"] = rows["class"].isin(mapping.classes) if mapping.classes else True
    rows["road"] = pd.factorize(rows.direction)[0] if "direction" in rows else 0
    return rows if "lateral_m" in rows else rows.assign(lateral_m=np.nan)


def _from_highd(rows: pd.DataFrame, path: Path) -> pd.DataFrame:
    """Rows of highD's tracks with both carriageways' positions and lanes as seen by their drivers.

    Direction 1 drives to the left in the picture, so that its right lane is the upper one, of the smallest number.
    """
    stem = path.stem.removesuffix("_tracks")
    vehicles = _highd_meta(path.with_name(f"{stem}_tracksMeta.csv"), ["id", "drivingDirection", "class"])
    file = path.with_name(f"{stem}_recordingMeta.csv")
    rate = pd.to_numeric(_highd_meta(file, ["frameRate"])["frameRate"], errors="coerce").max()
    if not rate > 0.0:
        raise TrajectoryError(str(file), "no frameRate", "frames per second", "Use the file as published.")
    rows = rows.merge(vehicles.rename(columns={"id": "vehicle_id"}), on="vehicle_id", how="left")
    if (missing := ~rows.drivingDirection.isin(["1", "2"])).any():
        found = f"no drivingDirection 1 or 2 for vehicle {rows.vehicle_id[missing].iloc[0]}"
        raise TrajectoryError(f"{stem}_tracksMeta.csv", found, "that of every vehicle", "Use files of one recording.")
    leftwards = (rows.drivingDirection == "1").to_numpy()
    forward = np.where(leftwards, -1.0, 1.0)
    return rows.assign(
        direction=rows.drivingDirection,
        time_s=rows.time_s / rate,
        s_m=forward * (rows.s_m + rows.length_m / 2),
        speed_mps=forward * rows.speed_mps,
        lane=-forward * rows.lane,
    )


def _highd_meta(path: Path, columns: list[str]) -> pd.DataFrame:
    """Columns of one of highD's two files about a recording, as text."""
    try:
        return pd.read_csv(path, usecols=columns, dtype=str)
    except FileNotFoundError:
        found, mend = "no such file", "highD needs it beside the tracks: copy it there."
    except (ValueError, OSError) as error:
        found, mend = str(error), "Use the file as published."
    raise TrajectoryError(str(path), found, f"a CSV file with {', '.join(columns)}", mend)


# -- one recording --


def _recording(name: str, path: Path, rows: pd.DataFrame, share_read: float) -> Recording:
    """Rows sorted by vehicle and time, and checked."""
    code, identifiers = pd.factorize(rows.vehicle_id)
    order = np.lexsort((rows.time_s, code))
    rows = rows.drop(columns=[each for each in NAMES if each in rows]).iloc[order].reset_index(drop=True)
    code = code[order]
    time_s = rows.time_s.to_numpy()
    dt = np.diff(time_s)
    same = np.diff(code) == 0
    another = np.append(True, ~same | (dt > ANOTHER_VEHICLE_S))
    rows["vehicle"] = np.cumsum(another) - 1
    vehicles = [str(identifiers[i]) for i in code[another]]
    recording = Recording(name, str(path), rows, 0.0, vehicles, share_read)
    if (twice := same & (dt == 0.0)).any():
        where = recording.where(np.argmax(twice) + 1)
        mend = "Delete it; or, if it is another vehicle, add a recording_id."
        raise TrajectoryError(where, "a second row of this vehicle and time", "one", mend)
    rate = _rate_hz(recording, dt[same])
    recording.require_near("time_s")
    since = (time_s - time_s.min()) * rate
    frame = np.rint(since).astype(np.int64)
    if (odd := np.abs(since - frame) > 0.3).any():
        found = f"a time off the steps of {rate:.4g} Hz"
        mend = "Interpolate all vehicles to the same times."
        raise TrajectoryError(recording.where(np.argmax(odd)), found, "times in equal steps", mend)
    rows["frame"] = frame + round(time_s.min() * rate)
    recording = Recording(name, str(path), rows, rate, vehicles, share_read)
    _check_units(recording)
    return recording


def _rate_hz(recording: Recording, steps_s: FloatArray) -> float:
    """Frames per second."""
    where, mend = f"{recording.file}, recording {recording.name}", "Use recordings at 10 Hz or more."
    if not steps_s.size:
        raise TrajectoryError(where, "one row per vehicle", "many", "Check the column vehicle_id.")
    step_s = float(np.median(steps_s))
    regular = steps_s[np.abs(steps_s - step_s) < 0.5 * step_s]
    rate = 1.0 / float(regular.mean())  # times may be rounded: 0.033, 0.067
    if rate < SLOWEST_HZ:
        if step_s >= 1.0:
            mend = "If times are milliseconds or frames, use a mapping: units: {time_s: ms}, or seconds per frame."
        raise TrajectoryError(where, f"a row every {step_s:g} s", "10 Hz or more", mend)
    return float(round(rate)) if abs(rate / round(rate) - 1.0) < 1e-4 else rate


def _check_units(recording: Recording) -> None:
    """Refuse wrong units, and columns that are shifted in time; name the units where the ratio shows them."""
    rows, where = recording.rows, f"{recording.file}, recording {recording.name}"
    if (odd := rows.length_m.to_numpy() <= 0.0).any():
        raise TrajectoryError(recording.where(np.argmax(odd)), "no length", "a length above 0 m", NO_LENGTH)
    n = round(recording.rate_hz)
    begin = np.arange(0, len(rows) - n, max(n // 2, 1))
    frame, vehicle = rows.frame.to_numpy(), rows.vehicle.to_numpy()
    begin = begin[(vehicle[begin] == vehicle[begin + n]) & (frame[begin + n] == frame[begin] + n)]
    s, v = rows.s_m.to_numpy(), rows.speed_mps.to_numpy()
    way_m = s[begin + n] - s[begin]
    summed = np.append(0.0, np.cumsum(v))
    of_speeds_m = (summed[begin + n + 1] - summed[begin] - 0.5 * (v[begin] + v[begin + n])) / recording.rate_hz
    moving = np.abs(way_m) > 0.2 * np.abs(way_m).max(initial=0.0)
    ratio = float(np.median(of_speeds_m[moving] / way_m[moving])) if moving.any() else 1.0
    if abs(ratio - 1.0) > OF_STEP:
        slip = min(SLIPS, key=lambda each: abs(ratio / each - 1.0))
        words = f": {SLIPS[slip]}" if abs(ratio / slip - 1.0) < OF_STEP else ""
        found = f"speeds {ratio:.3g} times the change of positions{words}"
        mend = "Correct the units of speed_mps or s_m in a mapping (units: {speed_mps: km/h, s_m: ft})."
        if ratio < 0.0:
            mend = "s_m must rise in driving direction, and speeds be positive."
        raise TrajectoryError(where, found, "positions in m and speeds in m/s that agree", mend)
    speed, length = float(np.median(v)), float(np.median(rows.length_m))
    feet = length > USUAL_LENGTH_M[1]
    if not -0.5 < speed < FASTEST_MEDIAN_MPS:
        found = f"a median speed of {speed:.4g} m/s" + (f" and a median length of {length:.3g} m: feet" if feet else "")
        mend = "Give units in a mapping (units: {s_m: ft, speed_mps: ft/s, length_m: ft}); forward is positive."
        raise TrajectoryError(where, found, "0 to 70 m/s", mend)
    if feet or length < USUAL_LENGTH_M[0]:
        mend = "Use a mapping: units: {length_m: ft}." if feet else "Is this the width of vehicles?"
        found = f"a median length of {length:.3g} m{': feet' if feet else ''}"
        raise TrajectoryError(where, found, "2.5 to 10 m", mend)
    lag_s = _lag(begin, frame, vehicle, way_m * recording.rate_hz, v, n) / recording.rate_hz
    if abs(lag_s) >= LEAST_LAG_S:
        found = f"speeds that belong to positions of {abs(lag_s):.1f} s {'earlier' if lag_s > 0 else 'later'}"
        raise TrajectoryError(where, found, "speeds and positions of the same time", "Shift one of the columns.")
    recording.require_near("s_m")
    recording.require_near("lane")


def _lag(begin: IntArray, frame: IntArray, vehicle: IntArray, way: FloatArray, v: FloatArray, n: int) -> int:
    """Frames by which speeds lag behind positions; 0 unless a shift explains them better beyond doubt.

    ``way`` is that of the ``n`` frames from each of ``begin``, in m/s times frames.
    """
    reach = 2 * n
    inside = (begin >= reach) & (begin + n + reach < v.size)
    begin, way = begin[inside], way[inside]
    first, last = begin - reach, begin + n + reach
    inside = (vehicle[first] == vehicle[last]) & (frame[last] - frame[first] == n + 2 * reach)
    begin, way = begin[inside], way[inside]
    if begin.size < 50:
        return 0
    summed = np.append(0.0, np.cumsum(v))
    lags = np.arange(-reach, reach + 1, max(n // 10, 1))
    error = np.empty((lags.size, begin.size))
    for row, lag in zip(error, lags, strict=True):
        at = begin + lag
        row[:] = np.abs(summed[at + n + 1] - summed[at] - 0.5 * (v[at] + v[at + n]) - way)
    best = int(np.argmin(error.mean(axis=1)))
    gain = error[lags.size // 2] - error[best]
    sure = gain.mean() > 6.0 * gain.std() / np.sqrt(gain.size) and gain.mean() > 0.2 * error[best].mean()
    return int(lags[best]) if sure else 0
