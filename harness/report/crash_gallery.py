"""The worst crashes: a row of the table for each, and of those that were traced a time-space diagram.

The diagram shows where LV, BV and AV were, in a frame that moves with BV's initial speed, and how fast.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes

from harness.records.reader import read_traces, stored_columns
from harness.report.number_format import decimal, number
from harness.report.plot_style import HALF_WIDTH_IN, INK, VEHICLE_COLOURS, Plot, new_figure, note
from harness.report.run_folder import RunFolder, floats
from harness.report.summary import Crash, RunSummary
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M
from harness.vocabulary import VEHICLES, FloatArray

SHOWN_PER_RANKING = 3
SECONDS_BEFORE_CUT_IN = 2.0
NAME_HEIGHT = 0.11
"""Least distance of two names beside the speed panel, as a share of its height."""


@dataclass(frozen=True)
class GalleryRow:
    """One crash in the table: why it is there, how to see it again, and its diagram if it was traced."""

    crash: Crash
    reason: str
    share_of_estimate: float
    component: str
    command: str
    plot: Plot | None


def crash_gallery(run: RunFolder, summary: RunSummary) -> list[GalleryRow]:
    """Hardest impacts first, then the largest weights (of shells: the outermost) that are not among them.

    Traced crashes go first where some of the worst have no trace: a diagram is worth more than a rank.
    """
    rankings = [(summary.hardest.crashes, "impact")]
    if summary.from_shells:
        rankings.append((summary.outermost.crashes, "outermost"))
    elif not summary.all_weights_one:
        rankings.append((summary.heaviest.crashes, "weight"))
    episodes = {crash.episode for ranked, _ in rankings for crash in ranked}
    lateral = ["lateral_m"] if "lead_steps" in stored_columns(run.path) else []
    traces = read_traces(run.path, episodes, ["episode", "step", "vehicle", "lane", "x_m", "v_mps", *lateral])
    traced = set() if traces is None else set(traces.column("episode").unique().to_pylist())
    reasons: dict[Crash, list[str]] = {}
    for ranked, reason in rankings:
        chosen = sorted(enumerate(ranked, 1), key=lambda item: item[1].episode not in traced)[:SHOWN_PER_RANKING]
        for rank, crash in sorted(chosen, key=lambda item: item[0]):
            reasons.setdefault(crash, []).append(f"{reason} no. {rank}")
    total = float(summary.log10_weight_crash.weight.sum())
    return [
        GalleryRow(
            crash=crash,
            reason=", ".join(why),
            share_of_estimate=crash.weight / total if total > 0.0 else math.nan,
            component=component_name(run, crash.component),
            command=f"harness replay {run.typed} {crash.episode}",
            plot=_diagram(run, summary, crash, traces) if crash.episode in traced else None,
        )
        for crash, why in reasons.items()
    ]


def component_name(run: RunFolder, component: int) -> str:
    """Name the shell of an episode, or the importance function it followed, of which the forced cut-in is the first."""
    if component < 0:
        return "–"
    names = ["forced", *run.campaign.surrogates] if run.shells is None else [s.shell for s in run.shells.shells]
    return names[component] if component < len(names) else str(component)


def _diagram(run: RunFolder, summary: RunSummary, crash: Crash, traces: pa.Table) -> Plot:
    worth = f"weight {number(crash.weight)}"
    if summary.from_shells:
        worth = f"in the shell {component_name(run, crash.component)}, adding {number(crash.weight)} to the rate"
    return time_space_plot(crash, _tracks(traces, crash.episode), worth=worth)


@dataclass(frozen=True)
class Track:
    """One vehicle's motion; all of shape (n_steps,): time (s), front bumper (m), speed (m/s), lane (0 right).

    The front bumper is in a frame that moves with BV's initial speed. ``lateral_m`` is how far the vehicle has come
    over, zeros where cut-ins are one step.
    """

    time_s: FloatArray
    front_m: FloatArray
    v_mps: FloatArray
    lane: FloatArray
    lateral_m: FloatArray

    @property
    def onset_s(self) -> float | None:
        """When it begins to move sideways; None if it does not, or that takes no time."""
        moved = self.lateral_m > 0.0
        return float(self.time_s[max(int(np.argmax(moved)) - 1, 0)]) if moved.any() else None

    def front_at(self, time_s: float) -> float:
        """Front bumper (m) at one time."""
        return float(np.interp(time_s, self.time_s, self.front_m))

    def speed_at(self, time_s: float) -> float:
        """Speed (m/s) at one time."""
        return float(np.interp(time_s, self.time_s, self.v_mps))


def _tracks(traces: pa.Table, episode: int) -> dict[str, Track]:
    """Tracks of an episode by vehicle."""
    rows = traces.filter(pc.equal(traces.column("episode"), episode)).sort_by("step")
    of = {name: rows.filter(pc.equal(rows.column("vehicle").cast(pa.string()), name)) for name in VEHICLES}
    frame_mps = of["BV"].column("v_mps")[0].as_py()
    tracks = {}
    for vehicle, part in of.items():
        step, x, v, lane = (floats(part.column(name)) for name in ("step", "x_m", "v_mps", "lane"))
        over = floats(part.column("lateral_m")) if "lateral_m" in part.column_names else np.zeros(v.shape)
        tracks[vehicle] = Track(STEP_S * step, x - frame_mps * STEP_S * step, v, lane, over)
    return tracks


def time_space_plot(crash: Crash, tracks: dict[str, Track], *, worth: str) -> Plot:
    """Positions in a frame that moves with BV's initial speed, and speeds, with cut-in and crash marked.

    ``worth`` ends the caption: what the crash means for the estimate.
    """
    onset_s = tracks["BV"].onset_s
    figure = new_figure(HALF_WIDTH_IN, 4.7 if onset_s is None else 5.7)
    position, speed, *lateral = figure.subplots(
        2 if onset_s is None else 3, 1, sharex=True, height_ratios=(3, 2) if onset_s is None else (3, 2, 1)
    )
    for vehicle, track in tracks.items():
        _draw_positions(position, vehicle, track)
        speed.plot(track.time_s, track.v_mps, color=VEHICLE_COLOURS[vehicle])
    for axes in (position, speed, *lateral):
        axes.axvline(crash.cut_in_time_s, color=INK, linewidth=0.9, linestyle=(0, (4, 3)))
    place = ("data", "axes fraction")
    note(position, "cut-in", (crash.cut_in_time_s, 0.0), (-4, 5), xycoords=place, ha="right", color=INK, fontsize=8)
    position.plot(
        [crash.crash_time_s], [tracks["AV"].front_at(crash.crash_time_s)], "X", color=INK, markersize=9, clip_on=False,
        zorder=5,
    )  # fmt: skip
    ends = [tracks[vehicle].speed_at(crash.crash_time_s) for vehicle in ("BV", "AV")]
    speed.plot([crash.crash_time_s] * 2, ends, color=INK, linewidth=1.4, clip_on=False, zorder=4)
    _label(position, speed, crash, tracks)
    came = "" if onset_s is None else _draw_lateral(speed, lateral[0], tracks["BV"], onset_s, crash)
    alt = (
        f"Time-space diagram of episode {crash.episode}: BV cuts in at {decimal(crash.cut_in_time_s)} s, "
        f"{decimal(crash.cut_in_r2_m)} m before the AV; the AV hits it at {decimal(crash.crash_time_s)} s with "
        f"{decimal(crash.impact_speed_mps)} m/s."
    )
    caption = (
        f"R2 = {decimal(crash.cut_in_r2_m)} m and R2dot = {decimal(crash.cut_in_r2dot_mps)} m/s at the cut-in, crash "
        f"{decimal(crash.crash_time_s - crash.cut_in_time_s)} s later; {came}{worth}."
    )
    return Plot(f"crash-{crash.episode:09d}", figure, alt, caption)


def _draw_lateral(above: Axes, axes: Axes, bv: Track, onset_s: float, crash: Crash) -> str:
    """How far BV has come over, from the onset on; returns what the caption says of it."""
    axes.plot(bv.time_s, bv.lateral_m, color=VEHICLE_COLOURS["BV"])
    for panel in above.figure.axes:
        panel.axvline(onset_s, color=INK, linewidth=0.9, linestyle=(0, (1, 2)))
    place = ("data", "axes fraction")
    note(axes, "onset", (onset_s, 1.0), (-4, -10), xycoords=place, ha="right", color=INK, fontsize=8)
    axes.set_ylabel("BV over, m")
    axes.set_xlabel(above.get_xlabel())
    above.set_xlabel("")
    axes.set_xlim(min(axes.get_xlim()[0], onset_s - 0.5), axes.get_xlim()[1])
    return f"BV came over for {decimal(crash.cut_in_time_s + STEP_S - onset_s)} s before; "


def _draw_positions(axes: Axes, vehicle: str, track: Track) -> None:
    """Draw the vehicle as a band from rear to front bumper; paler while it is on the left lane."""
    rear, colour = track.front_m - VEHICLE_LENGTH_M, VEHICLE_COLOURS[vehicle]
    for lane, alpha in ((1, 0.28), (0, 0.62)):
        on_lane = track.lane == lane
        # A band drawn over the mask alone would leave a gap of one step at the lane change.
        on_lane = on_lane | np.r_[False, on_lane[:-1]] if lane == 1 else on_lane
        axes.fill_between(track.time_s, rear, track.front_m, where=on_lane, color=colour, alpha=alpha, linewidth=0)
    axes.plot(track.time_s, track.front_m, color=colour, linewidth=1.2)


def _label(position: Axes, speed: Axes, crash: Crash, tracks: dict[str, Track]) -> None:
    start = max(min(crash.cut_in_time_s - SECONDS_BEFORE_CUT_IN, crash.crash_time_s - 4.0), 0.0)
    end = crash.crash_time_s + 0.06 * (crash.crash_time_s - start)
    position.set_xlim(start, end)
    _fit_height(position, tracks, start, crash.crash_time_s)
    _name_vehicles(position, tracks, start)
    position.set_title(f"Episode {crash.episode:,}: impact at {decimal(crash.impact_speed_mps)} m/s")
    position.set_ylabel(f"position in a frame\nmoving at {tracks['BV'].v_mps[0]:.1f} m/s, m")
    _name_speeds(speed, tracks, crash.crash_time_s)
    speed.set_ylabel("speed, m/s")
    speed.set_xlabel("time, s")
    for axis in (speed.xaxis, speed.yaxis, position.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")


def _fit_height(axes: Axes, tracks: dict[str, Track], start: float, end: float) -> None:
    """Fit AV and BV; an LV far ahead may leave the panel rather than flatten what matters."""
    lv, bv, av = (
        tracks[vehicle].front_m[(tracks[vehicle].time_s >= start) & (tracks[vehicle].time_s <= end)]
        for vehicle in VEHICLES
    )
    low, high = float(min(bv.min(), av.min())) - VEHICLE_LENGTH_M, float(max(bv.max(), av.max()))
    high = max(high, min(float(lv.max()), high + 1.5 * (high - low)))
    margin = 0.07 * (high - low)
    axes.set_ylim(low - margin, high + 2.0 * margin)


def _name_vehicles(axes: Axes, tracks: dict[str, Track], start: float) -> None:
    """Name each band at its left end; an LV beyond the panel is named at the panel's edge."""
    top = axes.get_ylim()[1]
    for vehicle, track in tracks.items():
        front = track.front_at(start)
        text, place, offset, va = vehicle, front, (5, 4), "bottom"
        if front > top:
            text, place, offset, va = f"{vehicle}, {front - top:.0f} m further", top, (5, -3), "top"
        note(axes, text, (start, place), offset, va=va, color=VEHICLE_COLOURS[vehicle], fontweight="bold")


def _name_speeds(axes: Axes, tracks: dict[str, Track], end: float) -> None:
    """Name each line right of the panel, at its height at the crash; names of nearly equal speeds move apart."""
    low, high = axes.get_ylim()
    heights = {vehicle: track.speed_at(end) for vehicle, track in tracks.items()}
    lowest = -math.inf
    for vehicle in sorted(heights, key=lambda name: heights[name]):
        lowest = max((heights[vehicle] - low) / (high - low), lowest + NAME_HEIGHT)
        style = {"color": VEHICLE_COLOURS[vehicle], "fontweight": "bold", "va": "center"}
        note(axes, vehicle, (1.0, lowest), (4, 0), xycoords="axes fraction", annotation_clip=False, **style)
