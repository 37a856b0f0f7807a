"""Vehicles of a recording, their neighbours, and how they accelerate."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harness.fitting.recording import Recording
from harness.vocabulary import BoolArray, FloatArray, IntArray

IN_VIEW_M = 100.0
"""Where so much of the road behind is in view and empty, nobody is behind."""
V_MIN_MPS, V_MAX_MPS, R1_MAX_M = 20.0, 40.0, 115.0
"""Range of the states that laws are fitted to: that of the shipped environments."""


class Scene:
    """Positions of all vehicles at the moments of some rows."""

    def __init__(self, track: Recording, chosen: BoolArray) -> None:
        rows = np.flatnonzero(np.isin(track.frame, np.unique(track.frame[chosen])))
        lanes = track.lane - track.lane.min() + 1
        frames = track.frame - track.frame.min()
        self._track = track
        self._spot = (track.road * (frames.max() + 1) + frames) * (lanes.max() + 2) + lanes
        self._s = track.s - track.s.min()
        self._span = float(self._s.max() + 1.0)
        place = self._spot[rows] * self._span + self._s[rows]
        order = np.argsort(place, kind="stable")
        self._place, self._at = place[order], rows[order]

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

    def states(self, rows: IntArray, side: int) -> dict[str, Any]:
        """States of some rows (m,) towards the lane ``side``: columns (m,), and what else holds of them.

        ``leads`` is whether somebody does; speed ``fits``, and R1 (``follows``), the range of the laws; ``behind`` is
        both, without overlap; ``at_risk`` that nobody is alongside, too, with the road behind in view.
        """
        track = self._track
        leader, _ = self.neighbours(rows, 0)
        r1 = track.gap(leader, rows)
        fits = (track.v[rows] >= V_MIN_MPS) & (track.v[rows] <= V_MAX_MPS)
        follows = (leader >= 0) & (r1 <= R1_MAX_M)
        behind = follows & fits & (r1 > 0.0)
        ahead, after = self.neighbours(rows, side)
        r2, r2dot = track.gap(rows, after), track.rate(rows, after)
        ttc_s = np.full(rows.size, np.inf)
        closing = r2dot < 0.0
        ttc_s[closing] = r2[closing] / -r2dot[closing]
        in_view = (after >= 0) | (track.s[rows] - track.view[0, track.road[rows]] >= IN_VIEW_M)
        at_risk = behind & (r2 > 0.0) & (track.gap(ahead, rows) > 0.0) & in_view
        columns = {"v_mps": track.v[rows], "r1_m": r1, "r1dot_mps": track.rate(leader, rows)}
        columns |= {"r2_m": r2, "r2dot_mps": r2dot, "ttc_s": ttc_s}
        return columns | {"leads": leader >= 0, "fits": fits, "follows": follows, "behind": behind, "at_risk": at_risk}


def durations_s(track: Recording, rows: IntArray) -> FloatArray:
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


def slope_weights(track: Recording, window_s: float = 1.0) -> FloatArray:
    """Weights of the values of some time that give the slope (1/s) of a line through them."""
    frames = round(window_s * track.rate_hz)
    since = np.arange(frames + 1) - frames / 2
    return np.asarray(since / (since @ since) * track.rate_hz)


def slopes(track: Recording, rows: IntArray) -> FloatArray:
    """Slope (m/s²) of a line through the speeds of the second that begins at each of some rows (m,)."""
    slopes = np.zeros(rows.size)
    for i, weight in enumerate(slope_weights(track)):
        slopes += weight * track.v[rows + i]
    return slopes


def noise_of(track: Recording, window_s: float = 1.0) -> float:
    """Standard deviation (m/s²) of slopes by white noise, from third differences, to which motion adds little.

    Speeds are off by a step's uniform error, too, where they are rounded: their smallest change is that step.
    """
    same = track.piece[3:] == track.piece[:-3]
    third = np.diff(track.v, 3)[same]
    change = np.abs(np.diff(track.v)[np.diff(track.piece) == 0])
    step = float(np.quantile(np.append(change[change > 1e-6], 0.0), 0.01, method="higher"))
    sd = max(np.sqrt(third @ third / max(third.size, 1) / 20.0), step / math.sqrt(12.0))
    return float(sd * np.linalg.norm(slope_weights(track, window_s)))
