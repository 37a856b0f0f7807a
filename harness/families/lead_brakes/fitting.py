"""Braking of vehicles ahead in trajectories: how often with 3 m/s² or more, and how hard.

A braking is where a deceleration of 1 m/s² is exceeded without a break, and its peak is the hardest in it; it counts
where it first reaches 3 m/s², if somebody follows then. Speeds are those of rows, of which single wrong ones are left
out by a running median; decelerations are slopes over half a second where speeds are precise, else over a second, in
which brakings that are shorter look gentler than they are.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from harness.families.following.fitting import FollowingFitter, Numbers, Seen, fitted_number, followed, most_of_one
from harness.families.lead_brakes.family import LEAD_BRAKES
from harness.fitting.recording import Recording
from harness.fitting.tracks import noise_of, slope_weights
from harness.vocabulary import BoolArray, FloatArray, IntArray, RecordArray

LOWEST_MPS2 = 3.0
"""Lowest peak of the shipped law."""
RELEASED_MPS2 = 1.0
GROWS_MPS2 = 0.02
"""A deceleration that grows by more from row to row is not held [assumed]."""
MEDIAN_S = 0.4
"""Time over which speeds are replaced by their median [assumed]."""
SHORT_S, PRECISE_MPS2 = 0.5, 0.05
"""A slope over so short a time is taken if its noise is below [assumed]."""
MOST_NOISE_MPS2 = 0.1
"""Noise of decelerations above which nothing is counted [assumed]: the hardest slope of a braking is too hard by as
much."""
MOST_UPWARD = 0.1
"""Share of speeding up so hard above which brakings are errors as well [assumed]: errors that neighbouring rows share,
as where positions were smoothed, are no noise from row to row."""
EVENT = np.dtype([("peak_mps2", np.float64), ("ended", np.bool_)])


class BrakingFitter(FollowingFitter):
    """See `FollowingFitter`."""

    family, events = LEAD_BRAKES, f"brakings of {LOWEST_MPS2:g} m/s² or more"

    def seen(self, track: Recording) -> Seen:
        deceleration, known = decelerations(track, SHORT_S if noise_of(track, SHORT_S) < PRECISE_MPS2 else 1.0)
        following = followed(track)
        row, events = brakings(deceleration, known, track.piece)
        counts = following.behind[row] >= 0
        events = events[counts]
        speeds_up, _ = brakings(-deceleration, known, track.piece)
        n_up = int((following.behind[speeds_up] >= 0).sum())
        hours = float((following.follows & known[following.ahead]).sum()) / track.rate_hz / 3600.0
        if (noise := noise_of(track)) > MOST_NOISE_MPS2:
            why = f"noise of {noise:.2g} m/s² in decelerations: at most {MOST_NOISE_MPS2:g} tell brakings from errors"
        elif n_up > max(1.0, MOST_UPWARD * events.size):
            why = f"{n_up} vehicles speed up by {LOWEST_MPS2:g} m/s² or more, and {events.size} brake so: errors"
        else:
            return Seen(hours, events, of_one=most_of_one(track.vehicle[row[counts]]))
        return Seen(0.0, events[:0], why)

    def numbers(self, events: RecordArray) -> Numbers:
        scale, se = tail_scale(events["peak_mps2"], events["ended"])
        return {"braking": {"peak_scale_mps2": fitted_number(scale, se)}}


def decelerations(track: Recording, window_s: float) -> tuple[FloatArray, BoolArray]:
    """Deceleration (n,) in m/s² around each row, and whether it is known: not at the ends of tracks."""
    width = 2 * round(0.5 * MEDIAN_S * track.rate_hz) + 1
    weights = slope_weights(track, window_s)
    reach = weights.size // 2 + width // 2
    speeds = ndimage.median_filter(track.v, width, mode="nearest")
    deceleration = -ndimage.correlate1d(speeds, weights, mode="nearest")
    row = np.arange(track.v.size)
    first, last = np.maximum(row - reach, 0), np.minimum(row + reach, row.size - 1)
    return deceleration, (row - first == reach) & (last - row == reach) & (track.piece[first] == track.piece[last])


def brakings(hard: FloatArray, known: BoolArray, piece: IntArray) -> tuple[IntArray, RecordArray]:
    """Rows (k,) in which decelerations (n,) first reach the lowest peak, and what they are: `EVENT`.

    One that still grows where its track ends has a peak of at least the hardest seen, and has not ``ended``; one that
    begins beyond the lowest peak is none.
    """
    braking = known & (hard >= RELEASED_MPS2)
    same_piece = np.diff(piece) == 0
    goes_on = np.append(False, braking[1:] & braking[:-1] & same_piece)
    first = np.flatnonzero(braking & ~goes_on)
    last = np.flatnonzero(braking & ~np.append(goes_on[1:], False))
    rows, events = [], []
    for begin, end in zip(first.tolist(), last.tolist(), strict=True):
        part, cut_off = hard[begin : end + 1], begin == 0 or not known[begin - 1]
        if part.max() >= LOWEST_MPS2 and not (cut_off and part[0] >= LOWEST_MPS2):
            rows.append(begin + int(np.argmax(part >= LOWEST_MPS2)))
            events.append((part.max(), part[-1] <= part[:-1].max(initial=0.0) + GROWS_MPS2))
    return np.array(rows, np.int64), np.array(events, EVENT)


def tail_scale(peak_mps2: FloatArray, ended: BoolArray) -> tuple[float, float]:
    """Maximum-likelihood scale (m/s²) of exponential peaks (k,) above the lowest, and its standard error.

    Where braking had not ``ended``, the peak is at least the one seen. The law's cells have the exponential's own
    probabilities, so that nothing is lost by not counting in them.
    """
    scale = float((peak_mps2 - LOWEST_MPS2).sum()) / max(int(ended.sum()), 1)
    return scale, scale / math.sqrt(max(int(ended.sum()), 1))
