"""Trajectories as a table: read from CSV or Parquet by a mapping of columns, one recording at a time.

One row per vehicle and time, in any order; without ``recording_id`` a file is one recording. In memory are held one
file (some 200 bytes a row), and one of its recordings (some 400).
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from pydantic import Field

from harness.campaign.models import read_model, shipped_or_own
from harness.campaign.sections import Section
from harness.errors import TrajectoryError, printable
from harness.fitting.recording import NAMES, NO_LENGTH, NUMBERS, UNITS, Recording, Unit, recording_of, require
from harness.problems import did_you_mean, file_meant

Needed = Literal["vehicle_id", "time_s", "s_m", "speed_mps", "lane", "length_m"]
Measured = Literal["time_s", "s_m", "speed_mps", "length_m", "lateral_m"]
Optional = Literal["recording_id", "lateral_m", "class", "direction"]
NEEDED: tuple[Needed, ...] = get_args(Needed)
OPTIONAL: tuple[Optional, ...] = get_args(Optional)
NO_COLUMN = ("Rename the column, or give its name in a mapping (--mapping FILE.yaml).", NO_LENGTH)
SAMPLE = 1 << 16
"""Bytes of a file by which its separators and decimal signs are known."""


class Mapping(Section):
    """How to read the columns of a file."""

    columns: dict[Literal[Needed, Optional], str | float] = Field(
        default={}, description="name in the file, or one number for all rows, by name of the input table"
    )
    units: dict[Measured, Unit | Annotated[float, Field(gt=0.0)]] = Field(
        default={}, description="unit in the file, or the factor to multiply by"
    )
    lanes: Literal["from_right", "from_left"] | list[int] = Field(
        default="from_right",
        description="how lanes are numbered, or a list of lanes from right to left, without others",
    )
    origin: Literal["centre", "front", "rear"] = Field(default="centre", description="point of a vehicle that s_m is")
    mirror: bool = Field(default=False, description="whether vehicles that close in from behind are on the left")
    classes: list[str] = Field(default=[], description="classes whose driving is fitted; all, if none is named")
    leave_out: list[str] = Field(default=[], description="recordings that are not fitted")
    header: list[str] = Field(default=[], description="names of the columns of a text file without a header")
    layout: Literal["table", "highd"] = Field(default="table", description="whether files are highD's")


SHIPPED_FOLDER = Path(__file__).parent


def load_mapping(name: str | None = None, *, mirror: bool | None = None, leave_out: Sequence[str] = ()) -> Mapping:
    """A shipped mapping (``highd``, ``ngsim``) or that of a YAML file (or `CampaignError`); else the input table's."""
    mapping = Mapping() if name is None else read_model(shipped_or_own(name, SHIPPED_FOLDER, "--mapping"), Mapping)
    mapping = mapping.replaced(("leave_out",), [*mapping.leave_out, *leave_out])
    return mapping if mirror is None else mapping.replaced(("mirror",), mirror)


def recordings(files: Sequence[str | Path], mapping: Mapping) -> Iterator[Recording]:
    """Recordings of some files, one after the other, checked, without those that are left out.

    Raises `TrajectoryError`: a file cannot be read, or its rows cannot be trajectories in these units.
    """
    paths = [Path(file) for file in files]
    track_files = [path for path in paths if mapping.layout != "highd" or not path.stem.endswith("Meta")]
    where = places(paths)
    if not track_files:
        raise TrajectoryError(where, "no file with tracks", "NN_tracks.csv", "Give highD's tracks as well.")
    names_seen: dict[str, set[str]] = {"recording": set(), "class": set()}
    for i, path in enumerate(track_files):
        table = _read(path, mapping)
        n_read = 0
        for name, rows in table.groupby("recording_id", sort=False):
            n_read += len(rows)
            names_seen["recording"].add(str(name))
            if name not in mapping.leave_out:
                standard = _standard(rows.reset_index(drop=True), path, mapping)
                names_seen["class"].update(standard["class"].unique() if mapping.classes else ())
                yield recording_of(str(name), str(path), standard, (i + n_read / len(table)) / len(track_files))
    none = [] if names_seen["class"].intersection(mapping.classes) else mapping.classes
    unknown = [name for name in mapping.leave_out if name not in names_seen["recording"]]
    for kind, missing in (("recording", unknown), ("class", none)):
        if missing:
            found = f"no {kind} {' or '.join(missing)}; there are {', '.join(sorted(map(str, names_seen[kind])))}"
            raise TrajectoryError(where, found, "names that are there", "Correct the name, or leave it out.")
    if names_seen["recording"].issubset(mapping.leave_out):
        raise TrajectoryError(where, "no recording that is not left out", "one or more", "Leave out fewer.")


def places(files: Sequence[Path]) -> str:
    """Names of some files, for messages."""
    few = ", ".join(map(str, files[:3]))
    return few if len(files) <= 3 else f"{few} and {len(files) - 3} more"


# -- files --


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    expected = "a CSV or Parquet file"
    try:
        if path.exists() and not path.is_file():
            found, mend = "a folder, a pipe or a device", "Name the files in it, or write its content into one first."
            raise TrajectoryError(str(path), found, expected, mend)
        yield
    except FileNotFoundError:
        mend = file_meant(path) or "Check the spelling and the current folder."
        raise TrajectoryError(str(path), "no such file", expected, mend) from None
    except (pa.ArrowException, csv.Error, OSError, ValueError) as error:
        first = str(error).splitlines()[0]
        mend = "Is it complete, of the type that its name says, and text in UTF-8? Copy or write it again."
        if "columns, got" in first:
            mend = "Give each row as many values as the header has names. "
            mend += "Decimal commas need semicolons between columns."
        if (invalid := re.match(r"In CSV column #(\d+): .*invalid value (.*)", first)) is not None:
            where, mend = f"{path}, column {int(invalid[1]) + 1}", "Correct it, or delete the rows that have none."
            raise TrajectoryError(
                where, invalid[2], "numbers, of one decimal sign (lane 0: the rightmost)", mend
            ) from None
        raise TrajectoryError(str(path), f"a file that cannot be read ({first})", expected, mend) from None


def _read(path: Path, mapping: Mapping) -> pd.DataFrame:
    """Rows of a file with the columns of the input table that it has, and ``row``."""
    with _reading(path):
        if path.suffix in (".parquet", ".pq"):
            with pq.ParquetFile(path, page_checksum_verification=True) as file:
                columns, first = _columns(path, file.schema_arrow.names, mapping), 1
                table = file.read(list(columns.values()))
        else:
            content, names, delimiter, decimal_point, first = _text(path, mapping)
            columns = _columns(path, names, mapping)
            types = {name: pa.string() if column in NAMES else pa.float64() for column, name in columns.items()}
            read = pa.csv.ReadOptions(column_names=names, skip_rows=first - 1, block_size=1 << 22)
            wanted = {"column_types": types, "include_columns": list(types), "decimal_point": decimal_point}
            parse = pa.csv.ParseOptions(delimiter=delimiter)
            convert = pa.csv.ConvertOptions(**wanted)
            table = pa.csv.read_csv(content, read, parse, convert)
        if not len(table):
            raise TrajectoryError(str(path), "no rows", "one row per vehicle and time", "Is it the right file?")
        return _renamed(table, columns, path, mapping, first)


def _text(path: Path, mapping: Mapping) -> tuple[Any, list[str], str, str, int]:
    """How a text file is written: unpacked content, names, delimiter, decimal sign, and the row of the first values."""
    sample = pa.input_stream(str(path)).read(SAMPLE)
    if b"\0" in sample:
        found = "zero bytes, as in an Excel workbook, in what is packed, or in text that is not UTF-8"
        mend = "Write it as CSV in UTF-8 (packed by gzip: .csv.gz), or as Parquet (.parquet)."
        raise TrajectoryError(str(path), found, "a CSV or Parquet file", mend)
    content = pa.input_stream(str(path))
    text = sample.decode("utf-8-sig", errors="replace")
    below = text.lstrip("\r\n")
    head = below.partition("\n")[0].strip()
    if not head:
        raise TrajectoryError(str(path), "an empty file", "a header and rows", "Is it the right file?")
    if isinstance(content, pa.OSFile):  # of what is packed the end is known
        content.seek(content.size() - 1)
        if content.read() not in (b"\n", b"\r"):
            sys.stderr.write(f"note: {printable(str(path))} has no line end after its last row: is it complete?\n")
        content.seek(0)
    delimiter = max(",;\t", key=head.count)
    if delimiter not in head and " " in head:  # columns of a fixed width, as NGSIM's
        delimiter, lines = " ", re.sub(rb"(?m)^ +| +(?=\r?$)", b"", content.read())
        content = pa.BufferReader(re.sub(rb" +", b" ", lines))
        head = re.sub(" +", " ", head)
    names = [name.strip() for name in next(csv.reader([head], delimiter=delimiter))]
    marks = [len(re.findall(rf"\d{sign}\d", text)) for sign in (",", r"\.")]
    headed = any(re.fullmatch(r"[-+]?[\d.,]+(e[-+]?\d+)?", name, re.IGNORECASE) is None for name in names)
    if not headed and len(names) != len(mapping.header):
        found = f"numbers in place of a header: {len(names)} columns"
        mend = "Add a header; or list the names in a mapping (header: [vehicle_id, time_s, …])."
        raise TrajectoryError(str(path), found, "names of columns in the first row", mend)
    decimal_point = "," if delimiter != "," and marks[0] > marks[1] else "."
    first = 1 + headed + text[: len(text) - len(below)].count("\n")
    return content, names if headed else mapping.header, delimiter, decimal_point, first


def _columns(path: Path, names: Sequence[str], mapping: Mapping) -> dict[str, str]:
    """Name in the file of each column of the input table that it has; capital letters do not count."""
    lower = [name.lower() for name in names]
    columns: dict[str, str] = {}
    for column in (*NEEDED, *OPTIONAL):
        name_given = mapping.columns.get(column, column)
        if isinstance(name_given, float):
            continue
        if lower.count(name_given.lower()) > 1:
            mend = "Rename all but one; capital letters do not count."
            raise TrajectoryError(str(path), f"more than one column {name_given}", "one", mend)
        if name_given.lower() in lower:
            columns[column] = names[lower.index(name_given.lower())]
        elif column in NEEDED or (column in mapping.columns and column != "recording_id"):
            known = {} if mapping.columns else {"xvelocity": "highd", "local_y": "ngsim"}
            mappings = [f"Is it a file for --mapping {known[name]}?" for name in lower if name in known]
            mend = mappings[0] if mappings else did_you_mean(name_given, names) or NO_COLUMN[column == "length_m"]
            mend = "Use the file as published." if mapping.layout == "highd" else mend  # xVelocity is no yVelocity
            what = f"a column {name_given}" + (f" for {column}" if name_given != column else "")
            raise TrajectoryError(str(path), f"the columns {', '.join(names)}", what, mend)
    if mapping.classes and "class" not in columns and mapping.layout != "highd":
        mend = "Add it, or leave out `classes` of the mapping."
        raise TrajectoryError(str(path), "no column class", "one, as the mapping names classes", mend)
    return columns


def _renamed(table: Any, columns: dict[str, str], path: Path, mapping: Mapping, first: int) -> pd.DataFrame:
    """Rows of a table by the names of the input table, constants filled in."""
    data: dict[str, Any] = {}
    for column, name in columns.items():
        values = table.column(name)
        if column in NAMES:
            text = values.cast(pa.string()).fill_null("")
            if column in ("recording_id", "vehicle_id") and (i := text.index("").as_py()) >= 0:
                where, mend = f"{path}, row {first + i}, {name}", "Fill it in, or delete the row."
                raise TrajectoryError(where, "nothing", "an identifier in every row", mend)
            data[column] = pd.arrays.ArrowExtensionArray(text)
        else:
            data[column] = values.cast(pa.float64(), safe=False).to_numpy()
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
    for rule in NUMBERS:
        require(rule, rows, lambda i, of=rule.column: f"{path}, row {rows.row.iloc[i]}, {of}")  # type: ignore[misc]
    if isinstance(mapping.lanes, list):
        order = {float(lane): i for i, lane in enumerate(mapping.lanes)}
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
        with path.open("rb") as file:
            return pd.read_csv(file, usecols=columns, dtype=str)
    except (ValueError, OSError) as error:
        mend = "highD has it beside the tracks: use the file as published."
        raise TrajectoryError(str(path), str(error), f"a CSV file with {', '.join(columns)}", mend) from None
