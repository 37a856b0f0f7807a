"""What the laws of traffic are fitted to, taken from the trajectories of one recording.

States are taken at whole seconds, as they were recorded. The acceleration of a second is the slope of a line through
all speeds in it: of an acceleration that is held for that second it is the value itself, and noise of
measurement enters with less than half of the variance that the difference of two speeds has.

A lane change is a change of ``lane`` to the next one that lasts; lanes that come back within a second are smoothed. The
likelihood of a hazard is a sum over crossings and an integral over time: the last row before a crossing is its state,
and each row stands for the time that is nearest to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from harness.errors import TrajectoryError
from harness.fitting.table import Mapping, Recording, recordings
from harness.vocabulary import BoolArray, FloatArray, IntArray, RecordArray


def _dtype(*names: str) -> np.dtype[np.void]:
    return np.dtype([("vehicle", np.int64), *((name, np.float64) for name in names)])


FREE = _dtype("v_mps", "acceleration_mps2")
FOLLOWING = _dtype("v_mps", "r1_m", "r1dot_mps", "acceleration_mps2")
INITIAL = _dtype("v_mps", "r1_m", "r1dot_mps")
AT_RISK = np.dtype(
    [*_dtype("duration_s", "v_mps", "r1_m", "r1dot_mps", "r2_m", "r2dot_mps", "ttc_s").descr, ("changes", np.bool_)]
)
LEADS = _dtype("lead_s", "lateral_speed_mps")

IN_VIEW_M = 100.0
"""Nobody is behind where so much of the road behind is seen."""
INITIAL_EVERY_S = 20
CLOSING_TTC_S = 8.0
LONGEST_LEAD_S = 10.0
SHORTEST_LANE_S = 0.5
"""Of straight driving before the onset of lateral motion: else its beginning was not seen."""
LATERAL_WINDOW_S = 0.5
"""Half of the time over which the lateral speed at a crossing is a slope."""
STRAIGHT_MPS = 0.1
SHIFTED_S = 0.8
OVERLAP_M = -0.5
"""A gap below that is no error of measurement."""
MOST_OVERLAPPING = 0.005
MOST_OUTSIDE = 0.5
FEWEST_CHANGES = 20
LEAST_CLOSING_S = 1.0
OTHER_SIDE = 10.0
"""Times as much closing in on the other side that it must be the one that is meant."""


class FitRange(NamedTuple):
    """States that laws are fitted to."""

    v_min_mps: float = 20.0
    v_max_mps: float = 40.0
    r1_min_m: float = 0.0
    r1_max_m: float = 115.0


USUAL_RANGE = FitRange()
"""That of the shipped environments."""


class Tally(NamedTuple):
    """What was counted on the way, of vehicles beside the target lane: all recordings are judged by it together."""

    vehicles: int = 0
    driven_s: float = 0.0
    """At any speed."""
    outside_s: float = 0.0
    """At speeds outside the fit range."""
    followed_s: float = 0.0
    overlapping_s: float = 0.0
    """Of that, behind a leader that overlaps."""
    overlapping_fronts_s: float = 0.0
    overlapping_rears_s: float = 0.0
    """The same, if positions were those of front or rear bumpers."""
    first_overlap: str = ""
    own_clocks: int = 0
    """Recordings all of whose vehicles begin at the same time."""
    flickers: int = 0
    changes: int = 0
    """Lane changes to the target lane."""
    used: int = 0
    """Of those, behind a leader within the fit range and beside nobody."""
    straight: int = 0
    """Of those with lateral positions, without lateral motion."""
    shifted: int = 0
    """Of those, more than 0.8 s from the middle between both lanes."""
    closing_s: float = 0.0
    """Whole seconds at risk with a time to collision below 8 s."""
    closing_other_s: float = 0.0
    """The same on the other side."""

    def plus(self, other: Tally) -> Tally:
        """Of both."""
        pairs: Iterator[tuple[Any, Any]] = zip(self, other, strict=True)
        summed: list[Any] = [mine or theirs if isinstance(mine, str) else mine + theirs for mine, theirs in pairs]
        return Tally(*summed)


@dataclass(frozen=True)
class Observations:
    """Observations of one recording, within the fit range, of vehicles in lanes beside a target lane.

    Gaps are bumper to bumper (m), rates leader minus follower (m/s); ``vehicle`` numbers the vehicles of the recording.

    Attributes
    ----------
    recording : str
        Its name, for messages and as cluster.
    free : RecordArray
        `FREE`: accelerations of one second of vehicles without a leader within the fit range.
    following : RecordArray
        `FOLLOWING`: state behind the leader, and acceleration of the second that begins there.
    initial : RecordArray
        `INITIAL`: state behind a leader every 20 s of a vehicle, from its first on.
    at_risk : RecordArray
        `AT_RISK`: one row per second behind a leader with nobody alongside in the target lane; ``duration_s`` is the
        time that it stands for. ``ttc_s`` is R2/-R2dot, infinite where nobody is behind or closes in; R2 and R2dot are
        infinite and 0 where nobody is behind. A row that ``changes`` is the state of a crossing to the target lane.
    leads : RecordArray
        `LEADS`: time from onset of lateral motion to crossing, and lateral speed at it; empty without lateral
        positions.
    noise_mps2 : float
        Standard deviation of the error of ``acceleration_mps2`` by noise of measurement that frames do not share.
    tally : Tally
        Counts for `require_enough`.
    """

    recording: str
    free: RecordArray
    following: RecordArray
    initial: RecordArray
    at_risk: RecordArray
    leads: RecordArray
    noise_mps2: float = 0.0
    tally: Tally = field(default_factory=Tally)


def observations(
    files: Sequence[str | Path], mapping: Mapping, fit_range: FitRange = USUAL_RANGE
) -> Iterator[tuple[Observations, float]]:
    """Observations of each recording of some files, and the share of all that is read by then.

    Raises `TrajectoryError`: a file cannot be read, or its rows are not what they should be.
    """
    for recording in recordings(files, mapping):
        yield observe(recording, fit_range), recording.share_read


def observe(recording: Recording, fit_range: FitRange = USUAL_RANGE) -> Observations:
    """Observations of one recording, whatever they are worth (`require_enough`)."""
    track, flickers = _track(recording)
    n = track.second
    changes = np.flatnonzero(track.crosses(-1) & track.fitted)
    chosen = track.fitted & (track.frame % n == 0)
    other_rows = np.flatnonzero(chosen & track.has_lane(1))
    chosen[changes] = True
    rows = np.flatnonzero(chosen & track.has_lane(-1))
    whole = track.frame[rows] % n == 0
    scene = _Scene(track, chosen)
    state, other = scene.states(rows, -1, fit_range), scene.states(other_rows, 1, fit_range)
    duration_s = _durations(track, rows)

    second = whole & track.same_run(rows, n)
    acceleration = np.full(rows.size, np.nan)
    acceleration[second] = _slopes(track, rows[second])
    seen = (state.leader >= 0) | (track.s[rows] + fit_range.r1_max_m <= track.road_end[track.road[rows]])
    since = track.frame[rows] - track.frame[np.searchsorted(track.vehicle, track.vehicle[rows])]
    crosses = np.isin(rows, changes)
    columns = {
        "vehicle": track.vehicle[rows],
        "duration_s": duration_s,
        "v_mps": track.v[rows],
        "r1_m": state.r1,
        "r1dot_mps": state.r1dot,
        "r2_m": state.r2,
        "r2dot_mps": state.r2dot,
        "ttc_s": state.ttc_s,
        "acceleration_mps2": acceleration,
        "changes": crosses,
    }
    leads, straight, shifted = _leads(track, rows[crosses & state.fits])
    overlaps = state.follows & (state.r1 < OVERLAP_M)
    longer = 0.5 * (track.length[rows] - track.length[state.leader])
    tally = Tally(
        vehicles=np.unique(track.vehicle[rows]).size,
        driven_s=float(duration_s.sum()),
        outside_s=float(duration_s[~state.fits].sum()),
        followed_s=float(duration_s[state.follows].sum()),
        overlapping_s=float(duration_s[overlaps].sum()),
        overlapping_fronts_s=float(duration_s[state.follows & (state.r1 + longer < OVERLAP_M)].sum()),
        overlapping_rears_s=float(duration_s[state.follows & (state.r1 - longer < OVERLAP_M)].sum()),
        first_overlap=_overlap(recording, rows, state, overlaps),
        own_clocks=int(track.vehicle[-1] > 0 and (track.frame[track.begins()] == track.frame.min()).all()),
        flickers=flickers,
        changes=changes.size,
        used=int((state.at_risk & crosses).sum()),
        straight=straight,
        shifted=shifted,
        closing_s=float((whole & state.at_risk & (state.ttc_s < CLOSING_TTC_S)).sum()),
        closing_other_s=float((other.at_risk & (other.ttc_s < CLOSING_TTC_S)).sum()),
    )
    return Observations(
        recording.name,
        _records(FREE, columns, second & state.fits & ~state.follows & seen),
        _records(FOLLOWING, columns, second & state.behind),
        _records(INITIAL, columns, whole & state.behind & (since // n % INITIAL_EVERY_S == 0)),
        _records(AT_RISK, columns, state.at_risk),
        leads,
        _noise(track),
        tally,
    )


def _records(dtype: np.dtype[np.void], columns: dict[str, RecordArray], inside: BoolArray) -> RecordArray:
    """Rows of some columns (n,) that are ``inside`` (n,)."""
    out = np.empty(int(inside.sum()), dtype)
    for name in dtype.names or ():
        out[name] = columns[name][inside]
    return out


# -- rows, runs and neighbours --


class _Track(NamedTuple):
    """Columns of a recording, sorted by vehicle and frame; a run is a vehicle in one lane without a gap in time."""

    vehicle: IntArray
    frame: IntArray
    road: IntArray
    lane: IntArray
    s: FloatArray
    v: FloatArray
    length: FloatArray
    lateral: FloatArray
    fitted: BoolArray
    piece: IntArray
    """Number of the part of a vehicle's track without a gap in time."""
    run: IntArray
    road_begin: FloatArray
    road_end: FloatArray
    """By road: how far it is seen."""
    rate_hz: float

    @property
    def second(self) -> int:
        """Frames of a second."""
        return round(self.rate_hz)

    def begins(self) -> IntArray:
        """First rows of vehicles."""
        return np.flatnonzero(np.diff(self.vehicle, prepend=-1))

    def crosses(self, side: int) -> BoolArray:
        """Rows (n,) after which the vehicle is in the next lane."""
        same = np.diff(self.piece, append=-1) == 0
        return np.asarray(same & (np.diff(self.lane, append=0) == side))

    def has_lane(self, side: int) -> BoolArray:
        """Rows (n,) beside a lane in which somebody drives in this recording."""
        lanes = self.lane - self.lane.min() + 1
        at = self.road * (lanes.max() + 2) + lanes
        return np.asarray(np.isin(at + side, np.unique(at)))

    def same_run(self, rows: IntArray, frames: int) -> BoolArray:
        """Whether a vehicle stays in its lane so long after some rows (m,)."""
        last = np.minimum(rows + frames, self.run.size - 1)
        return np.asarray((self.run[last] == self.run[rows]) & (last == rows + frames))

    def gap(self, leader: IntArray, follower: IntArray) -> FloatArray:
        """Bumper to bumper; infinite where one of them is -1."""
        gap = self.s[leader] - self.s[follower] - 0.5 * (self.length[leader] + self.length[follower])
        return np.where((leader >= 0) & (follower >= 0), gap, np.inf)

    def rate(self, leader: IntArray, follower: IntArray) -> FloatArray:
        """Speed of the leader minus that of the follower; 0 where one of them is -1."""
        return np.where((leader >= 0) & (follower >= 0), self.v[leader] - self.v[follower], 0.0)


def _track(recording: Recording) -> tuple[_Track, int]:
    """Columns with lanes smoothed, and how often a lane came back within a second."""
    rows = recording.rows
    vehicle, frame, lane = (rows[name].to_numpy() for name in ("vehicle", "frame", "lane"))
    road, s, n = rows.road.to_numpy(), rows.s_m.to_numpy(), round(recording.rate_hz)
    piece = _numbers((np.diff(vehicle) != 0) | (np.diff(frame) != 1))
    lane, flickers = _smoothed(lane, piece, n)
    run = _numbers((np.diff(piece) != 0) | (np.diff(lane) != 0))
    begin, end = np.array([(s[road == each].min(), s[road == each].max()) for each in range(int(road.max()) + 1)]).T
    v, length, lateral, fitted = (rows[each].to_numpy() for each in ("speed_mps", "length_m", "lateral_m", "fitted"))
    rate_hz = recording.rate_hz
    track = _Track(vehicle, frame, road, lane, s, v, length, lateral, fitted, piece, run, begin, end, rate_hz)
    return track, flickers


def _numbers(breaks: BoolArray) -> IntArray:
    """Number of the part that each row (n,) is in, between breaks (n - 1,)."""
    return np.append(0, np.cumsum(breaks))


def _smoothed(lane: IntArray, piece: IntArray, second: int) -> tuple[IntArray, int]:
    """Lanes (n,) as the median of two seconds where one came back within one, and how often that was."""
    run = _numbers((np.diff(piece) != 0) | (np.diff(lane) != 0))
    first = np.flatnonzero(np.diff(run, prepend=-1))
    frames = np.diff(first, append=lane.size)
    at, of = lane[first], piece[first]
    back = np.zeros(first.size, np.bool_)
    back[1:-1] = (of[:-2] == of[2:]) & (at[:-2] == at[2:]) & (frames[1:-1] < second)
    out = lane.copy()
    for each in np.unique(of[back]):
        part = slice(*np.searchsorted(piece, [each, each + 1]))
        out[part] = ndimage.median_filter(lane[part], 2 * second + 1, mode="nearest")
    return out, int(back.sum())


class _Scene:
    """Who drives where at the moments of some rows."""

    def __init__(self, track: _Track, chosen: BoolArray) -> None:
        at = np.flatnonzero(np.isin(track.frame, np.unique(track.frame[chosen])))
        lanes = track.lane - track.lane.min() + 1
        frames = track.frame - track.frame.min()
        self._track = track
        self._spot = (track.road * (frames.max() + 1) + frames) * (lanes.max() + 2) + lanes
        self._s = track.s - track.s.min()
        self._span = float(self._s.max() + 1.0)
        place = self._spot[at] * self._span + self._s[at]
        order = np.argsort(place, kind="stable")
        self._place, self._at = place[order], at[order]

    def neighbours(self, rows: IntArray, side: int) -> tuple[IntArray, IntArray]:
        """Rows (m,) of the next vehicles ahead of and behind the centre of some, in a lane beside; -1 for none."""
        spot = self._spot[rows] + side
        i = np.searchsorted(self._place, spot * self._span + self._s[rows], side="right")
        ahead = self._at[np.minimum(i, self._at.size - 1)]
        behind = self._at[np.maximum(i - 1, 0)]
        return (
            np.where((i < self._at.size) & (self._spot[ahead] == spot), ahead, -1),
            np.where((i > 0) & (self._spot[behind] == spot), behind, -1),
        )

    def states(self, rows: IntArray, side: int, fit_range: FitRange) -> _States:
        """States of some rows (m,) towards the lane beside."""
        track, fit = self._track, fit_range
        v = track.v[rows]
        leader, _ = self.neighbours(rows, 0)
        r1 = track.gap(leader, rows)
        fits = (v >= fit.v_min_mps) & (v <= fit.v_max_mps)
        follows = (leader >= 0) & (r1 <= fit.r1_max_m)
        behind = follows & fits & (r1 > max(fit.r1_min_m, 0.0))
        ahead, after = self.neighbours(rows, side)
        r2, r2dot = track.gap(rows, after), track.rate(rows, after)
        ttc_s = np.full(rows.size, np.inf)
        closing = r2dot < 0.0
        ttc_s[closing] = r2[closing] / -r2dot[closing]
        seen = (after >= 0) | (track.s[rows] - track.road_begin[track.road[rows]] >= IN_VIEW_M)
        at_risk = behind & (r2 > 0.0) & (track.gap(ahead, rows) > 0.0) & seen
        return _States(leader, r1, track.rate(leader, rows), fits, follows, behind, r2, r2dot, ttc_s, at_risk)


class _States(NamedTuple):
    """States of rows (m,) towards the lane on one side."""

    leader: IntArray
    """Its row, or -1."""
    r1: FloatArray
    r1dot: FloatArray
    fits: BoolArray
    """Whether the speed is within the fit range."""
    follows: BoolArray
    """Whether R1 is."""
    behind: BoolArray
    """Both, without overlap."""
    r2: FloatArray
    r2dot: FloatArray
    ttc_s: FloatArray
    at_risk: BoolArray
    """Behind a leader, nobody alongside, and seen who comes from behind."""


def _durations(track: _Track, rows: IntArray) -> FloatArray:
    """Time (s) that each of some rows (m,) stands for: what of its run is nearest to it."""
    run, frame = track.run[rows], track.frame[rows].astype(np.float64)
    alone = np.flatnonzero(np.diff(track.run, prepend=-1))
    first, last = track.frame[alone].astype(np.float64), track.frame[np.append(alone[1:], track.run.size) - 1]
    goes_on = np.diff(track.piece[alone], append=-1) == 0  # in another lane, half a frame later
    begin = first[run] - 0.5 * np.append(False, goes_on[:-1])[run]
    end = last[run] + 0.5 * goes_on[run]
    same = np.diff(run) == 0
    middle = 0.5 * (frame[1:] + frame[:-1])
    begin[1:][same], end[:-1][same] = middle[same], middle[same]
    return np.asarray(end - begin) / track.rate_hz


def _slopes(track: _Track, rows: IntArray) -> FloatArray:
    """Slope (m/s²) of a line through the speeds of the second that begins at each of some rows (m,)."""
    since = np.arange(track.second + 1) - track.second / 2
    weights = since / (since @ since) * track.rate_hz
    slopes = np.zeros(rows.size)
    for i, weight in enumerate(weights):
        slopes += weight * track.v[rows + i]
    return slopes


def _noise(track: _Track) -> float:
    """Standard deviation (m/s²) of slopes by white noise, which third differences show as no motion does."""
    same = track.piece[3:] == track.piece[:-3]
    third = np.diff(track.v, 3)[same]
    since = np.arange(track.second + 1) - track.second / 2
    return float(np.sqrt(third @ third / max(third.size, 1) / 20.0 / (since @ since)) * track.rate_hz)


# -- lateral motion --


def _leads(track: _Track, crossings: IntArray) -> tuple[RecordArray, int, int]:
    """Leads of some crossings (rows before them); how many go without lateral motion, and how many at another time.

    The onset is where a line, level before and straight from there to the crossing, comes nearest to the lateral
    positions: as the law has it, which moves BV at a constant lateral speed. Where a track begins later, there is none.
    """
    found, straight, shifted = [], 0, 0
    moves = (np.diff(track.lane) != 0) & (np.diff(track.vehicle) == 0)
    steady = ~np.isin(track.vehicle, track.vehicle[1:][moves]) & np.isfinite(track.lateral)
    middle: dict[tuple[int, int], float] = {}
    for row in crossings:
        window = round(LATERAL_WINDOW_S * track.rate_hz)
        near = np.arange(max(row - window + 1, 0), min(row + window + 1, track.run.size))
        near = near[(track.piece[near] == track.piece[row]) & np.isfinite(track.lateral[near])]
        reach = np.arange(max(row - round(LONGEST_LEAD_S * track.rate_hz), 0), row + 1)
        reach = reach[(track.run[reach] == track.run[row]) & np.isfinite(track.lateral[reach])]
        if near.size < window or reach.size < 2 * window:
            continue
        speed = _slope(near / track.rate_hz, track.lateral[near])
        road, lane = where = int(track.road[row]), int(track.lane[row])
        if where not in middle:
            on = [track.lateral[steady & (track.road == road) & (track.lane == each)] for each in (lane, lane - 1)]
            middle[where] = float(np.mean([np.median(each) if each.size else np.nan for each in on]))
        off_m = abs(track.lateral[reach[-1]] - middle[where])
        straight += int(abs(speed) < STRAIGHT_MPS)
        shifted += int(STRAIGHT_MPS <= abs(speed) < off_m / SHIFTED_S)
        before_s = (reach - row - 0.5) / track.rate_hz
        onset = _onset(before_s, track.lateral[reach])
        if onset - before_s[0] >= SHORTEST_LANE_S:
            found.append((track.vehicle[row], -onset, abs(speed)))
    return np.array(found, LEADS), straight, shifted


def _onset(time_s: FloatArray, lateral: FloatArray) -> float:
    """Where the best line that is level, then straight, has its bend."""
    rises = np.maximum(time_s - time_s[:-2, None], 0.0)
    rises -= rises.mean(axis=1, keepdims=True)
    explained = (rises @ lateral) ** 2 / (rises * rises).sum(axis=1)
    return float(time_s[np.argmax(explained)])


def _slope(x: FloatArray, y: FloatArray) -> float:
    x = x - x.mean()
    return float(x @ y / (x @ x))


# -- is it enough? --


def _overlap(recording: Recording, rows: IntArray, state: _States, overlaps: BoolArray) -> str:
    """The first two vehicles that overlap, in words; empty if none do."""
    if not overlaps.any():
        return ""
    i = int(np.argmax(overlaps))
    ahead = recording.vehicles[int(recording.rows.vehicle.iloc[state.leader[i]])]
    return f"{recording.where(rows[i])}: a gap of {state.r1[i]:.1f} m to vehicle {ahead}"


def require_enough(total: Tally, where: str) -> None:
    """Refuse recordings that cannot tell what traffic does, or that were read in a wrong way.

    Parameters
    ----------
    total : Tally
        Of all recordings.
    where : str
        Files, for messages.

    Raises `TrajectoryError`: says which rule is broken.
    """
    side = "Does who closes in from behind do so on the other side? Set mirror: true in the mapping, or --mirror."
    if total.driven_s == 0.0:
        found, expected = "no vehicle with another lane beside it, on the side where vehicles close in", "lanes 0, 1, …"
        raise TrajectoryError(
            f"{where}, lane", found, expected, f"Name a column with lanes, and `classes` as in the file. {side}"
        )
    if total.overlapping_s > MOST_OVERLAPPING * total.followed_s:
        share = total.overlapping_s / total.followed_s
        mend = "Are lengths those of the vehicles, and lanes those of the time?"
        if total.overlapping_fronts_s < 0.2 * total.overlapping_s:
            mend = "Positions fit front bumpers: set origin: front in a mapping (centre, where it says rear)."
        elif total.overlapping_rears_s < 0.2 * total.overlapping_s:
            mend = "Positions fit rear bumpers: set origin: rear in a mapping (centre, where it says front)."
        elif total.own_clocks:
            mend = f"Do times count from one moment for all vehicles of a recording? {mend}"
        found = f"vehicles that overlap in {share:.1%} of the time; first {total.first_overlap}"
        raise TrajectoryError(where, found, f"at most {MOST_OVERLAPPING:.1%}", mend)
    if total.flickers > max(total.changes, FEWEST_CHANGES):
        found = f"{total.flickers:,} lanes that come back within a second, beside {total.changes:,} lane changes"
        mend = "Smooth lanes, or take them from lateral positions."
        raise TrajectoryError(f"{where}, lane", found, "lanes that last", mend)
    how = {"without lateral motion": total.straight, "more than 0.8 s from the lane's marking": total.shifted}
    odd = max(how, key=how.__getitem__)
    if how[odd] > 0.5 * total.changes:
        found = f"{how[odd]:,} of {total.changes:,} lane changes {odd}"
        mend = "Correct the shift between lanes and lateral positions, or leave out lateral_m."
        raise TrajectoryError(f"{where}, lane", found, "lateral_m of the same time", mend)
    if total.outside_s > MOST_OUTSIDE * total.driven_s:
        found = f"{total.outside_s / total.driven_s:.0%} of the time at speeds outside the fit range"
        mend = "Take recordings of traffic that flows: the laws are those of 20 to 40 m/s."
        raise TrajectoryError(f"{where}, speed_mps", found, f"at most {MOST_OUTSIDE:.0%}", mend)
    if total.closing_s < max(LEAST_CLOSING_S, total.closing_other_s / OTHER_SIDE):
        found = (
            f"vehicles that close in from behind in the target lane (TTC < 8 s) for {total.closing_s:.0f} s, "
            f"and for {total.closing_other_s:.0f} s in the lane on the other side"
        )
        mend = side if total.closing_other_s > total.closing_s else "Take recordings in which vehicles overtake."
        raise TrajectoryError(f"{where}, lane", found, "most of it in the target lane", mend)
    if total.used < FEWEST_CHANGES:
        found = f"{total.used} lane changes to the target lane behind a leader within the fit range"
        expected = (
            f"at least {FEWEST_CHANGES} (of {total.changes} in all, in {total.driven_s / 3600:.1f} vehicle-hours)"
        )
        raise TrajectoryError(where, found, expected, "Add recordings: rare lane changes need many hours.")
