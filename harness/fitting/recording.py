"""One recording: its rows sorted by vehicle and time, and held against what trajectories can be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import pandas as pd
from scipy import ndimage

from harness.errors import TrajectoryError
from harness.vocabulary import BoolArray, FloatArray, IntArray

Unit = Literal["m", "ft", "km", "m/s", "ft/s", "km/h", "mph", "s", "ms", "us", "ns"]
UNITS: dict[Unit, float] = dict(
    zip(get_args(Unit), (1.0, 0.3048, 1e3, 1.0, 0.3048, 1 / 3.6, 0.44704, 1.0, 1e-3, 1e-6, 1e-9), strict=True)
)
NAMES = ["recording_id", "vehicle_id", "class", "direction"]
"""Columns that are read as text."""
NO_LENGTH = "Gaps need lengths: correct them, or give one for all in a mapping (columns: {length_m: 4.6})."
ONE_CLOCK = "Do several recordings share a name, or do times begin anew with each vehicle? Use one clock for all."
CORRECT = "Correct the value, or delete the row."
SLOWEST_HZ = 9.5
MEDIANS = (
    ("speed_mps", -0.5, 70.0, "Give units in a mapping (units: {s_m: ft, speed_mps: ft/s}); forward is positive."),
    ("length_m", 2.5, 10.0, "Give units in a mapping (units: {length_m: ft}); or is it the width of vehicles?"),
)
"""Limits of medians, which hold in metres and not in feet."""
MOST_APART_M = 7.0
"""Between the middles of lanes side by side [assumed]; in feet they are 12 apart."""
OF_STEP = 0.05
"""Largest relative difference between speeds and the change of positions."""
ANOTHER_VEHICLE_S = 60.0
"""An identifier that reappears after so long is another vehicle's (as in NGSIM)."""
OFF_IN_STEP_M = 3.0
OFF_IN_SECOND_M = 5.0
"""More than measurement error between the way of a frame, or of a second, and that of the speeds [assumed]."""
JUMP_MPS = 5.0
JUMPS = {"speed_mps": (JUMP_MPS, 10.0), "lateral_m": (5.0, 5.0), "length_m": (3.0, 0.0)}
"""How far numbers of a vehicle may change from row to row by measurement error, and per second by motion [assumed]."""


class ColumnRule(NamedTuple):
    """What must hold of a column in every row; ``found`` is formatted with the value of a row for which it does not."""

    column: str
    holds: Callable[[FloatArray], BoolArray]
    found: str
    expected: str
    mend: str = CORRECT


def _near(column: str, most: float) -> ColumnRule:
    """Values further from the median are wrong [assumed]."""
    expected = f"at most {most:g} from the median of the recording"
    return ColumnRule(column, lambda x: np.abs(x - np.median(x)) <= most, f"{column} {{:g}}", expected)


_NUMBERS = "time_s", "s_m", "speed_mps", "lane", "length_m"
NUMBERS = (
    *(ColumnRule(name, np.isfinite, "no finite number", "a number in every row") for name in _NUMBERS),
    ColumnRule("lane", lambda x: x % 1 == 0, "{:g}", "a whole number", "Number the lanes by whole numbers."),
)
SOME_LENGTH = ColumnRule("length_m", lambda x: x >= 0.5, "length_m {:g}", "a length of 0.5 m or more", NO_LENGTH)
NEAR_TIME = _near("time_s", 1e7)
OTHER_WAY = "Give what drives the other way positive speeds, rising s_m and another direction; or delete it."
FORWARD = ColumnRule("speed_mps", lambda v: v > -JUMP_MPS, "speed_mps {:g}", "one that drives forward", OTHER_WAY)
NEAR = _near("s_m", 1e5), _near("lane", 20), _near("length_m", 50.0), _near("speed_mps", 60.0), FORWARD


def require(rule: ColumnRule, rows: pd.DataFrame, where: Callable[[int], str]) -> None:
    """Refuse the first of some rows that breaks a rule; ``where`` names the i-th (`TrajectoryError`)."""
    values = rows[rule.column].to_numpy()
    if not (holds := rule.holds(values)).all():
        i = int(np.argmin(holds))
        raise TrajectoryError(where(i), rule.found.format(values[i]), rule.expected, rule.mend)


@dataclass(frozen=True, eq=False)
class Recording:
    """All vehicles on a stretch of road during some time: rows (n,), sorted by vehicle and time.

    ``vehicle`` numbers the identifiers ``vehicles``; ``row`` is that in the file, from 1; ``lane`` is smoothed: it was
    left for less than a second ``flickers`` times. ``share_read`` is the share of all files that has been read so far.
    """

    name: str
    file: str
    share_read: float
    vehicles: Sequence[str]
    row: IntArray
    vehicle: IntArray
    time_s: FloatArray
    road: IntArray
    """Number of the direction of driving."""
    lane: IntArray
    """The target lane's is one less."""
    s: FloatArray
    """Centre (m), rising as one drives."""
    v: FloatArray
    length: FloatArray
    lateral: FloatArray
    """NaN where there is none."""
    fitted: BoolArray
    """Of a class whose driving is fitted."""
    frame: IntArray
    rate_hz: float = 0.0
    flickers: int = 0

    @property
    def place(self) -> str:
        """For messages."""
        return f"{self.file}, recording {self.name}"

    def where(self, i: int | np.intp) -> str:
        """Place in the file of the i-th row."""
        who = f"vehicle {self.vehicles[self.vehicle[i]]} of recording {self.name}"
        return f"{self.file}, row {self.row[i]} ({who}, t = {self.time_s[i]:.10g} s)"

    @cached_property
    def piece(self) -> IntArray:
        """Number of the part of a vehicle's track without a gap in time."""
        return _numbers((np.diff(self.vehicle) != 0) | (np.diff(self.frame) != 1))

    @cached_property
    def run(self) -> IntArray:
        """Number of the part of it in one lane."""
        return _numbers((np.diff(self.piece) != 0) | (np.diff(self.lane) != 0))

    @cached_property
    def view(self) -> FloatArray:
        """First and last s of each road, (2, roads)."""
        positions = [self.s[self.road == road] for road in range(int(self.road.max()) + 1)]
        return np.array([(s.min(), s.max()) for s in positions]).T

    @property
    def second(self) -> int:
        """Frames per second, rounded."""
        return round(self.rate_hz)

    def crosses(self, side: int) -> BoolArray:
        """Rows (n,) after which the vehicle is in the next lane."""
        same = np.diff(self.piece, append=-1) == 0
        return np.asarray(same & (np.diff(self.lane, append=0) == side))

    def has_lane(self, side: int) -> BoolArray:
        """Rows (n,) beside a lane in which vehicles drive in this recording."""
        lanes = self.lane - self.lane.min() + 1
        lane_of_road = self.road * (lanes.max() + 2) + lanes
        return np.asarray(np.isin(lane_of_road + side, np.unique(lane_of_road)))

    def same_run(self, rows: IntArray, frames: int) -> BoolArray:
        """Whether the vehicle stays in its lane for so many frames after some rows (m,)."""
        last = np.minimum(rows + frames, self.run.size - 1)
        return np.asarray((self.run[last] == self.run[rows]) & (last == rows + frames))

    def gap(self, leader: IntArray, follower: IntArray) -> FloatArray:
        """Gap (m), bumper to bumper; infinite where a row is -1."""
        gap = self.s[leader] - self.s[follower] - 0.5 * (self.length[leader] + self.length[follower])
        return np.where((leader >= 0) & (follower >= 0), gap, np.inf)

    def rate(self, leader: IntArray, follower: IntArray) -> FloatArray:
        """Speed of the leader minus that of the follower (m/s); 0 where a row is -1."""
        return np.where((leader >= 0) & (follower >= 0), self.v[leader] - self.v[follower], 0.0)


_COLUMNS = {"s": "s_m", "v": "speed_mps", "length": "length_m", "lateral": "lateral_m"}
_COLUMNS |= {name: name for name in ("row", "time_s", "road", "lane", "fitted")}


def recording_of(name: str, file: str, rows: pd.DataFrame, share_read: float) -> Recording:
    """Rows of the input table, in metres and seconds, sorted and checked.

    Raises `TrajectoryError`: they cannot be trajectories in these units.
    """
    code, identifiers = pd.factorize(rows.vehicle_id)
    order = np.lexsort((rows.time_s, code))
    rows = rows.drop(columns=NAMES, errors="ignore").iloc[order].reset_index(drop=True)
    code = code[order]
    time_s = rows.time_s.to_numpy()
    dt = np.diff(time_s)
    same = np.diff(code) == 0
    another = np.append(True, ~same | (dt > ANOTHER_VEHICLE_S))
    vehicles = [str(identifiers[i]) for i in code[another]]
    columns: dict[str, Any] = {key: rows[column].to_numpy() for key, column in _COLUMNS.items()}
    recording = Recording(name, file, share_read, vehicles, vehicle=np.cumsum(another) - 1, frame=code, **columns)
    if (twice := same & (dt == 0.0)).any():
        where = recording.where(np.argmax(twice) + 1)
        mend = "Delete it; or, if it is another vehicle, add a recording_id."
        raise TrajectoryError(where, "a second row of this vehicle and time", "one", mend)
    rate = _rate_hz(recording, dt[same])
    require(NEAR_TIME, rows, recording.where)
    since = (time_s - time_s.min()) * rate
    frame = np.rint(since).astype(np.int64)
    if (odd := np.abs(since - frame) > 0.3).any():
        found = f"a time off the steps of {rate:.4g} Hz"
        mend = "Interpolate all vehicles to the same times."
        raise TrajectoryError(recording.where(np.argmax(odd)), found, "times in equal steps", mend)
    rows["frame"] = frame + round(time_s.min() * rate)
    if (same_place := rows.duplicated(["frame", "road", "lane", "s_m"]).to_numpy()).any():
        found = "the time, lane and s_m of another vehicle"
        raise TrajectoryError(recording.where(np.argmax(same_place)), found, "one at a place", ONE_CLOCK)
    recording = replace(recording, rate_hz=rate, frame=rows.frame.to_numpy())
    _check_motion(recording, rows)
    lane, flickers = _smoothed(recording.lane, recording.piece, recording.second)
    return replace(recording, lane=lane, flickers=flickers)


def _rate_hz(recording: Recording, steps_s: FloatArray) -> float:
    if not steps_s.size:
        raise TrajectoryError(recording.place, "one row per vehicle", "many", "Check the column vehicle_id.")
    step_s = float(np.median(steps_s))
    regular = steps_s[np.abs(steps_s - step_s) < 0.5 * step_s]
    rate = 1.0 / float(regular.mean())  # times may be rounded: 0.033, 0.067
    if rate < SLOWEST_HZ:
        mend = "Use recordings at 10 Hz or more."
        if step_s >= 1.0:
            mend = "If times are milliseconds or frames, use a mapping: units: {time_s: ms}, or seconds per frame."
        raise TrajectoryError(recording.place, f"a row every {step_s:g} s", "10 Hz or more", mend)
    return float(round(rate)) if abs(rate / round(rate) - 1.0) < 1e-4 else rate


def _check_motion(recording: Recording, rows: pd.DataFrame) -> None:
    """Refuse wrong units, and rows whose positions and speeds disagree."""
    require(SOME_LENGTH, rows, recording.where)
    frame, vehicle, s, v = recording.frame, recording.vehicle, recording.s, recording.v
    rate, n = recording.rate_hz, recording.second
    driven_m = np.append(0.0, np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(frame) / rate))
    begin = np.arange(max(s.size - n, 0))
    begin = begin[(vehicle[begin] == vehicle[begin + n]) & (frame[begin + n] == frame[begin] + n)]
    way_m = s[begin + n] - s[begin]
    of_speeds_m = driven_m[begin + n] - driven_m[begin]
    ratio = _ratio(way_m, of_speeds_m)
    if abs(ratio - 1.0) > OF_STEP:
        found = f"speeds {ratio:.3g} times the change of positions"
        mend = "Correct the units of speed_mps or s_m in a mapping (units: {speed_mps: km/h, s_m: ft})."
        if ratio < 0.0:
            mend = "s_m must rise in driving direction, and speeds be positive."
        raise TrajectoryError(recording.place, found, "positions in m and speeds in m/s that agree", mend)
    for column, low, high, mend in MEDIANS:
        if not low < (median := float(rows[column].median())) < high:
            found = f"a median of {median:.4g} in {column}"
            raise TrajectoryError(recording.place, found, f"{low:g} to {high:g}", mend)
    for rule in NEAR:
        require(rule, rows, recording.where)
    beside = rows.groupby(["road", "lane"]).lateral_m.median().reset_index().diff()
    apart_m = float(beside.lateral_m[(beside.road == 0) & (beside.lane == 1)].abs().median())
    if apart_m > MOST_APART_M:
        found, mend = f"lanes {apart_m:.3g} m apart in lateral_m", "Give units in a mapping (units: {lateral_m: ft})."
        raise TrajectoryError(recording.place, found, f"at most {MOST_APART_M:g} m", mend)
    step = np.flatnonzero(np.diff(vehicle) == 0)
    dt = (frame[step + 1] - frame[step]) / rate
    for name, (most, per_s) in JUMPS.items():
        off = np.abs(np.diff(rows[name]))[step] > most + per_s * dt
        _require_agreement(recording, step[off], 1, name, rows[name].to_numpy())
    off = np.abs(np.diff(s) - np.diff(driven_m) / ratio)[step] > OFF_IN_STEP_M + JUMP_MPS * dt
    _require_agreement(recording, step[off], 1, "s_m", s, driven_m / ratio)
    off = np.abs(way_m - of_speeds_m / ratio) > OFF_IN_SECOND_M
    _require_agreement(recording, begin[off], n, "s_m", s, driven_m / ratio)


def _ratio(way_m: FloatArray, of_speeds_m: FloatArray) -> float:
    """Median ratio of ways (n,) by speeds to those by positions; few that are wrong do not move it."""
    moving = np.abs(way_m) > 0.2 * np.quantile(np.abs(way_m), 0.9) if way_m.size else np.zeros(0, np.bool_)
    return float(np.median(of_speeds_m[moving] / way_m[moving])) if moving.any() else 1.0


def _require_agreement(
    recording: Recording, off: IntArray, frames: int, name: str, column: FloatArray, driven_m: FloatArray | None = None
) -> None:
    """Refuse rows ``off`` (m,) after which a column moves within so many rows as no vehicle at these speeds does."""
    if not off.size:
        return
    first, last = int(off[0]), int(off[0]) + frames
    a, b = column[[first, last]]
    found = f"{name} {a:.6g}, and {b:.6g} in row {recording.row[last]}"
    found += "" if driven_m is None else f", where speeds say {a + driven_m[last] - driven_m[first]:.6g}"
    found += f"; {off.size:,} such pairs of rows" * (off.size > 1)
    mend = f"{CORRECT} If they are many, positions or speeds stand still, or are of different vehicles."
    raise TrajectoryError(recording.where(first), found, "positions and speeds of one motion in all rows", mend)


def _numbers(breaks: BoolArray) -> IntArray:
    """Number of each row's part (n,), between breaks (n - 1,)."""
    return np.append(0, np.cumsum(breaks))


def _smoothed(lane: IntArray, piece: IntArray, second: int) -> tuple[IntArray, int]:
    """Lanes (n,), by the median of two seconds where one came back within a second, and how often it did."""
    run = _numbers((np.diff(piece) != 0) | (np.diff(lane) != 0))
    first = np.flatnonzero(np.diff(run, prepend=-1))
    frames = np.diff(first, append=lane.size)
    lanes, pieces = lane[first], piece[first]
    came_back = np.zeros(first.size, np.bool_)
    came_back[1:-1] = (pieces[:-2] == pieces[2:]) & (lanes[:-2] == lanes[2:]) & (frames[1:-1] < second)
    out = lane.copy()
    for number in np.unique(pieces[came_back]):
        part = slice(*np.searchsorted(piece, [number, number + 1]))
        out[part] = ndimage.median_filter(lane[part], 2 * second + 1, mode="nearest")
    return out, int(came_back.sum())
