"""Vehicles of a recording: their lanes over time, and their neighbours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from harness.fitting.recording import Recording
from harness.vocabulary import BoolArray, FloatArray, IntArray

IN_VIEW_M = 100.0
"""Where so much of the road behind is in view and empty, nobody is behind."""


class FitRange(NamedTuple):
    """Range of the states that laws are fitted to."""

    v_min_mps: float = 20.0
    v_max_mps: float = 40.0
    r1_min_m: float = 0.0
    r1_max_m: float = 115.0


USUAL_RANGE = FitRange()
"""Fit range of the shipped environments."""


class Track(NamedTuple):
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
    """Ends of the view, by road."""
    rate_hz: float

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
        at = self.road * (lanes.max() + 2) + lanes
        return np.asarray(np.isin(at + side, np.unique(at)))

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


def track_of(recording: Recording) -> tuple[Track, int]:
    """Columns with smoothed lanes, and how often a vehicle came back to a lane within a second."""
    rows = recording.rows
    vehicle, frame, lane = (rows[name].to_numpy() for name in ("vehicle", "frame", "lane"))
    road, s, n = rows.road.to_numpy(), rows.s_m.to_numpy(), round(recording.rate_hz)
    piece = _numbers((np.diff(vehicle) != 0) | (np.diff(frame) != 1))
    lane, flickers = _smoothed(lane, piece, n)
    run = _numbers((np.diff(piece) != 0) | (np.diff(lane) != 0))
    begin, end = np.array([(s[road == each].min(), s[road == each].max()) for each in range(int(road.max()) + 1)]).T
    v, length, lateral, fitted = (rows[each].to_numpy() for each in ("speed_mps", "length_m", "lateral_m", "fitted"))
    rate_hz = recording.rate_hz
    track = Track(vehicle, frame, road, lane, s, v, length, lateral, fitted, piece, run, begin, end, rate_hz)
    return track, flickers


def _numbers(breaks: BoolArray) -> IntArray:
    """Number of each row's part (n,), between breaks (n - 1,)."""
    return np.append(0, np.cumsum(breaks))


def _smoothed(lane: IntArray, piece: IntArray, second: int) -> tuple[IntArray, int]:
    """Lanes (n,), by the median of two seconds where one came back within a second, and how often it did."""
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


class Scene:
    """Positions of all vehicles at the moments of some rows."""

    def __init__(self, track: Track, chosen: BoolArray) -> None:
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
        """Rows (m,) of the next vehicles ahead of and behind the centres of some, in the lane ``side``; -1 for none."""
        spot = self._spot[rows] + side
        i = np.searchsorted(self._place, spot * self._span + self._s[rows], side="right")
        ahead = self._at[np.minimum(i, self._at.size - 1)]
        behind = self._at[np.maximum(i - 1, 0)]
        return (
            np.where((i < self._at.size) & (self._spot[ahead] == spot), ahead, -1),
            np.where((i > 0) & (self._spot[behind] == spot), behind, -1),
        )

    def states(self, rows: IntArray, side: int, fit_range: FitRange) -> States:
        """States of some rows (m,) towards the lane ``side``."""
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
        return States(leader, r1, track.rate(leader, rows), fits, follows, behind, r2, r2dot, ttc_s, at_risk)


class States(NamedTuple):
    """States of rows (m,) towards the lane on one side."""

    leader: IntArray
    """Its row, or -1."""
    r1: FloatArray
    r1dot: FloatArray
    fits: BoolArray
    """Whether the speed is within the fit range."""
    follows: BoolArray
    """Whether R1 is within the fit range."""
    behind: BoolArray
    """Both, and vehicles do not overlap."""
    r2: FloatArray
    r2dot: FloatArray
    ttc_s: FloatArray
    at_risk: BoolArray
    """Behind a leader, nobody alongside, and the road behind in view."""


def durations_s(track: Track, rows: IntArray) -> FloatArray:
    """Time (s) that each of some rows (m,) stands for: the part of its run that is nearest to it."""
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


def slopes(track: Track, rows: IntArray) -> FloatArray:
    """Slope (m/s²) of a line through the speeds of the second that begins at each of some rows (m,)."""
    since = np.arange(track.second + 1) - track.second / 2
    weights = since / (since @ since) * track.rate_hz
    slopes = np.zeros(rows.size)
    for i, weight in enumerate(weights):
        slopes += weight * track.v[rows + i]
    return slopes


def noise_of(track: Track) -> float:
    """Standard deviation (m/s²) of slopes by white noise, from third differences, to which motion adds little."""
    same = track.piece[3:] == track.piece[:-3]
    third = np.diff(track.v, 3)[same]
    since = np.arange(track.second + 1) - track.second / 2
    return float(np.sqrt(third @ third / max(third.size, 1) / 20.0 / (since @ since)) * track.rate_hz)
