"""What the laws of traffic are fitted to, taken from the trajectories of one recording.

States are taken at whole seconds, as they were recorded. The acceleration of a second is the slope of a line through
all speeds in it: exact if the acceleration is held for that second, and with less than half of the noise variance of
the difference of two speeds.

A lane change is a lasting change of ``lane`` to the next one; returns within a second are smoothed away. The likelihood
of a hazard is a sum over crossings and an integral over time: the last row before a crossing gives its state, and each
row stands for the time nearest to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from harness.errors import TrajectoryError
from harness.fitting.recording import ONE_CLOCK, Recording
from harness.fitting.table import Mapping
from harness.fitting.tracks import R1_MAX_M, Scene, durations_s, noise_of, slopes
from harness.vocabulary import BoolArray, FloatArray, IntArray, RecordArray


def _dtype(*names: str) -> np.dtype[np.void]:
    return np.dtype([("vehicle", np.int64), *((name, np.float64) for name in names)])


_RISKS = _dtype("duration_s", "v_mps", "r1_m", "r1dot_mps", "r2_m", "r2dot_mps", "ttc_s")
KINDS = {
    "free": _dtype("v_mps", "acceleration_mps2"),
    "following": _dtype("v_mps", "r1_m", "r1dot_mps", "acceleration_mps2"),
    "initial": _dtype("v_mps", "r1_m", "r1dot_mps"),
    "at_risk": np.dtype([*_RISKS.descr, ("changes", np.bool_)]),
    "leads": _dtype("lead_s", "lateral_speed_mps"),
}
"""Kinds of `Observations`."""

INITIAL_EVERY_S = 20
CLOSING_TTC_S = 8.0
LONGEST_LEAD_S = 10.0
SEEN_BEFORE_S = 4.5
"""Crossings seen in their lane for less give no lead: long leads would be missed more often."""
LEVEL_S = 0.5
"""Motion that begins this soon after the first row may have begun before it."""
LATERAL_WINDOW_S = 0.5
"""Half of the time over which a slope gives the lateral speed at a crossing."""
STRAIGHT_MPS = 0.1
JUMP_M = 1.5
"""Between two frames nobody drives so far across [assumed]."""
OVERLAP_M = -0.5
"""Gaps below are more than measurement error."""
MOST_OVERLAPPING = 0.005
MOST_OUTSIDE = 0.5
FEWEST_CHANGES = 20
LEAST_CLOSING_S = 1.0
OTHER_SIDE = 10.0
"""If vehicles close in this many times as long on the other side, that side must be meant."""


class BesideCounts(NamedTuple):
    """Counts of vehicles beside the target lane, by which all recordings are judged together."""

    vehicles: int = 0
    driven_s: float = 0.0
    """At any speed."""
    outside_s: float = 0.0
    """At speeds outside the fit range."""
    followed_s: float = 0.0
    overlapping_s: float = 0.0
    """Of that, behind a leader that overlaps."""
    flickers: int = 0
    changes: int = 0
    """Lane changes to the target lane."""
    changes_other: int = 0
    """Those to the other side."""
    used: int = 0
    """Of those, behind a leader within the fit range and beside nobody."""
    odd: int = 0
    """Lane changes without lateral motion, or within one frame."""
    closing_s: float = 0.0
    """Whole seconds at risk with a time to collision below 8 s."""
    closing_other_s: float = 0.0
    """The same on the other side."""
    turned: int = 0
    """Directions of recordings in which it is nearly always on the other side."""

    @classmethod
    def of(cls, observations: Iterable[Observations]) -> BesideCounts:
        """Sum over recordings."""
        summed: list[Any] = [sum(counts) for counts in zip(*(each.tally for each in observations), strict=True)]
        return cls(*summed)


@dataclass(frozen=True)
class Observations:
    """Observations of one recording, within the fit range, of vehicles in lanes beside a target lane.

    Gaps are bumper to bumper (m), rates leader minus follower (m/s); ``vehicle`` numbers the vehicles of the recording.
    """

    recording: str
    free: RecordArray
    """Accelerations of one second of vehicles without a leader within the fit range."""
    following: RecordArray
    """State behind the leader, and acceleration of the second that begins there."""
    initial: RecordArray
    """State behind a leader every 20 s of a vehicle, from its first on."""
    at_risk: RecordArray
    """One row per second behind a leader with nobody alongside in the target lane; ``duration_s`` is the time that it
    stands for. ``ttc_s`` is R2/-R2dot, infinite where nobody is behind or closes in; R2 and R2dot are infinite and 0
    where nobody is behind. A row that ``changes`` is the state of a crossing to the target lane."""
    leads: RecordArray
    """Time from onset of lateral motion to crossing, and lateral speed at it; empty without lateral positions. Leads
    above 4 s may be lower limits."""
    noise_mps2: float
    """Standard deviation of ``acceleration_mps2`` by white measurement noise."""
    tally: BesideCounts


def observe(track: Recording) -> Observations:
    """Observations of one recording, not yet judged (`require_enough`)."""
    n = track.second
    changes = np.flatnonzero(track.crosses(-1) & track.fitted)
    chosen = track.fitted & (track.frame % n == 0)
    other_side_rows = np.flatnonzero(chosen & track.has_lane(1))
    chosen[changes] = True
    rows = np.flatnonzero(chosen & track.has_lane(-1))
    on_second = track.frame[rows] % n == 0
    scene = Scene(track, chosen)
    state, other_side = scene.states(rows, -1), scene.states(other_side_rows, 1)
    duration_s = durations_s(track, rows)

    second = on_second & track.same_run(rows, n)
    acceleration = np.full(rows.size, np.nan)
    acceleration[second] = slopes(track, rows[second])
    in_view = state["leads"] | (track.s[rows] + R1_MAX_M <= track.view[1, track.road[rows]])
    since = track.frame[rows] - track.frame[np.searchsorted(track.vehicle, track.vehicle[rows])]
    crosses = np.isin(rows, changes)
    columns = state | {"vehicle": track.vehicle[rows], "duration_s": duration_s}
    columns |= {"acceleration_mps2": acceleration, "changes": crosses}
    fits, follows, behind, at_risk = (state[name] for name in ("fits", "follows", "behind", "at_risk"))
    near = track.road[rows[on_second & at_risk & (state["ttc_s"] < CLOSING_TTC_S)]]
    far = track.road[other_side_rows[other_side["at_risk"] & (other_side["ttc_s"] < CLOSING_TTC_S)]]
    closing, elsewhere = (np.bincount(of_road, minlength=track.road.max() + 1) for of_road in (near, far))
    leads, odd = _leads(track, rows[crosses & fits])
    overlaps = follows & (state["r1_m"] < OVERLAP_M)
    tally = BesideCounts(
        vehicles=np.unique(track.vehicle[rows]).size,
        driven_s=float(duration_s.sum()),
        outside_s=float(duration_s[~fits].sum()),
        followed_s=float(duration_s[follows].sum()),
        overlapping_s=float(duration_s[overlaps].sum()),
        flickers=track.flickers,
        changes=changes.size,
        changes_other=int(np.count_nonzero(track.crosses(1) & track.fitted)),
        used=int((at_risk & crosses).sum()),
        odd=odd,
        closing_s=float(near.size),
        closing_other_s=float(far.size),
        turned=int((elsewhere > OTHER_SIDE * np.maximum(closing, LEAST_CLOSING_S)).sum()),
    )
    return Observations(
        track.name,
        _records("free", columns, second & fits & ~follows & in_view),
        _records("following", columns, second & behind),
        _records("initial", columns, on_second & behind & (since // n % INITIAL_EVERY_S == 0)),
        _records("at_risk", columns, at_risk),
        leads,
        noise_of(track),
        tally,
    )


def _records(kind: str, columns: dict[str, RecordArray], inside: BoolArray) -> RecordArray:
    """Rows of some columns (n,) that are ``inside`` (n,)."""
    out = np.empty(int(inside.sum()), KINDS[kind])
    for name in KINDS[kind].names or ():
        out[name] = columns[name][inside]
    return out


# -- lateral motion --


def _leads(track: Recording, crossings: IntArray) -> tuple[RecordArray, int]:
    """Leads of some crossings (rows before them), and how many are `BesideCounts.odd`.

    The onset is the bend of a line, level before and straight from there to the crossing, fitted to the lateral
    positions: the law's motion at constant lateral speed. Where none is seen, the lead is the time that was searched,
    at least `SEEN_BEFORE_S`.
    """
    leads, odd = [], 0
    for row in crossings:
        window = round(LATERAL_WINDOW_S * track.rate_hz)
        near = np.arange(max(row - window + 1, 0), min(row + window + 1, track.run.size))
        near = near[(track.piece[near] == track.piece[row]) & np.isfinite(track.lateral[near])]
        reach = np.arange(max(row - round(LONGEST_LEAD_S * track.rate_hz), 0), row + 1)
        reach = reach[(track.run[reach] == track.run[row]) & np.isfinite(track.lateral[reach])]
        if near.size < window or reach.size < 2 * window:
            continue
        before_s = (reach - row - 0.5) / track.rate_hz
        at_s = near / track.rate_hz
        at_s -= at_s.mean()
        speed = at_s @ track.lateral[near] / (at_s @ at_s)
        jumps = np.abs(np.diff(track.lateral[near])).max() > JUMP_M
        odd += int(jumps or abs(speed) < STRAIGHT_MPS)
        if before_s[0] <= -SEEN_BEFORE_S:
            onset = _onset(before_s, track.lateral[reach])
            lead_s = -onset if onset - before_s[0] >= LEVEL_S else -before_s[0]
            leads.append((track.vehicle[row], lead_s, abs(speed)))
    return np.array(leads, KINDS["leads"]), odd


def _onset(time_s: FloatArray, lateral: FloatArray) -> float:
    """Bend of the best line that is level, then straight."""
    rises = np.maximum(time_s - time_s[:-2, None], 0.0)
    rises -= rises.mean(axis=1, keepdims=True)
    explained = (rises @ lateral) ** 2 / (rises * rises).sum(axis=1)
    return float(time_s[np.argmax(explained)])


# -- is it enough? --


def require_enough(observations: Sequence[Observations], where: str, mapping: Mapping) -> BesideCounts:
    """Refuse recordings that are too few, or that were read wrongly by the ``mapping``; the sum of their counts.

    Raises `TrajectoryError`: a rule is broken; it says which, and by which recording most; ``where`` names the files.
    """
    total = BesideCounts.of(observations)

    def refuse(words: str, expected: str, mend: str, column: str = "", most: str = "") -> TrajectoryError:
        largest = max(observations, key=lambda each: float(getattr(each.tally, most or "used")))
        if most and len(observations) > 1 and getattr(largest.tally, most) > 0.5 * getattr(total, most):
            name = largest.recording
            words, mend = f"{words}; most of it in recording {name}", f"{mend} Or leave it out: --leave-out '{name}'."
        return TrajectoryError(f"{where}, {column}" if column else where, words, expected, mend)

    side = f"Give {'--no-mirror' if mapping.mirror else '--mirror'}, or number `lanes` from the other side."
    overlapping, outside = total.overlapping_s / (total.followed_s or 1.0), total.outside_s / (total.driven_s or 1.0)
    hours = total.driven_s / 3600.0
    needed = f"some {hours * FEWEST_CHANGES / total.used:.2g} such hours are needed" if total.used else "they are rare"
    to, other = ("left", "right") if mapping.mirror else ("right", "left")
    closing = f"for {total.closing_s:.0f} s, and for {total.closing_other_s:.0f} s in that to the {other}"
    rules: list[tuple[bool, str, str, str, str, str]] = [
        (total.driven_s == 0.0, "no vehicle with another lane beside it, on the side where vehicles close in",
         "lanes 0, 1, …", f"Check the columns of lanes and vehicles. {side}", "lane", ""),
        (overlapping > MOST_OVERLAPPING, f"vehicles that overlap in {overlapping:.1%} of the time",
         f"at most {MOST_OVERLAPPING:.1%}",
         f"Set origin: front (or rear) in a mapping, or check lengths. {ONE_CLOCK}", "", "overlapping_s"),
        (total.flickers > max(total.changes, FEWEST_CHANGES),
         f"lanes that come back within a second {total.flickers:,} times, against {total.changes:,} lane changes",
         "fewer", "Smooth lanes, or take them from lateral positions.", "lane", "flickers"),
        (total.odd > 0.5 * total.changes,
         f"{total.odd:,} of {total.changes:,} lane changes in a jump, or without lateral motion",
         "lane and lateral_m of the same time", "Shift one of them, or leave out lateral_m.", "lane", "odd"),
        (outside > MOST_OUTSIDE, f"{outside:.0%} of the time at speeds outside the fit range",
         f"at most {MOST_OUTSIDE:.0%}", "Use recordings of flowing traffic: laws are fitted at 20 to 40 m/s.",
         "speed_mps", "outside_s"),
        (total.closing_s < max(LEAST_CLOSING_S, total.closing_other_s / OTHER_SIDE),
         f"vehicles that close in from behind in the lane to the {to} (TTC < {CLOSING_TTC_S:g} s) {closing}",
         f"most of it in the lane to the {to}",
         side if total.closing_other_s > total.closing_s else "Use recordings in which vehicles overtake.", "lane", ""),
        (total.used < FEWEST_CHANGES,
         f"{total.used} lane changes to the {to} behind a leader within the fit range (of {total.changes} in "
         f"all; to the {other} {total.changes_other}), in {hours:.1f} vehicle-hours beside that lane",
         f"at least {FEWEST_CHANGES}, ahead of vehicles that close in there",
         f"Add recordings: {needed}." if total.changes_other < FEWEST_CHANGES or total.changes else
         f"Vehicles close in to the {to}, and change to the {other}: number lanes as they lie.", "", ""),
    ]  # fmt: skip
    for broken, *problem in rules:
        if broken:
            raise refuse(*problem)
    return total
